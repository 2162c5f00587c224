"""Patient-specific mitral leaflet stiffness, estimated from how the valve is seen to move.

The public names: what a user needs first, each loaded when it is asked for. What they are made of,
and all the rest, is in the rooms.

* A valve: `Template`, `TemplateParameters`, `Valve`; `structured_mesh` fills its leaflets.
* A closed valve from moduli: `ClosureModel` with `MechanicsSettings`, `TissueSettings` and a
  `ClosureProtocol`; `run_gate` asks whether it can be trusted.
* Moduli from a closed valve: `simulate_observation`, `estimate` for a `Problem`; a filter
  (`PaperFilter`, `ExtendedFilter`, `IteratedFilter`, `UnscentedFilter`, `EnsembleFilter`,
  `ImportanceFilter`) from a `Gaussian` prior, in coordinates `Identity` or `Log`, for any model
  that returns a `Prediction`; `identifiability`.
* A patient: `read_case`, `write_case`, `ValveCase`; `personalise` estimates its moduli, by
  `default_settings` or `PersonaliseSettings` with every `Prior`, and `report` writes the page.
* Images: `detect_in_volume` with `ImagedSettings` makes a case of a volume; `read_volume` with its
  `Modality`, `detect_valve` with the `default_model`.
* Mechanics without a valve: `simulate_body`, `TransverselyIsotropic`.
* `MvestError`, the family of all errors that a user can cause; `units`.

Data flows one way, and the packages are its stations: `imaging` turns volumes into a `valve`,
`mechanics` moves the valve under pressure (`closure`), `estimation` finds the parameters whose
motion is the observed one (`problem`, `personalise`), and `reporting` turns estimates into tables
and figures.

Inside the library lengths are mm, times s, masses tonne, forces N and stresses MPa.
"""

import lazy_loader

from mvest._compiling import choose_cache

__version__ = "0.1.0"

choose_cache()
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
