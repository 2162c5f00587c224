"""Patient-specific stiffness of the mitral leaflets, estimated from their observed motion.

These are the public names, each loaded on first use. All others are in the subpackages.

* A valve: `Template`, `TemplateParameters`, `Valve`; `structured_mesh` fills its leaflets.
* A closed valve from moduli: `ClosureModel` with `MechanicsSettings`, `TissueSettings` and a
  `ClosureProtocol`; `run_gate` tests whether its closed state is unique.
* Moduli from a closed valve: `simulate_observation`, `estimate` for a `Problem`; a filter
  (`PaperFilter`, `ExtendedFilter`, `IteratedFilter`, `UnscentedFilter`, `EnsembleFilter`,
  `ImportanceFilter`) from a `Gaussian` prior, in coordinates `Identity` or `Log`, for any model
  that returns a `Prediction`; `identifiability`.
* A patient: `read_case`, `write_case`, `ValveCase`; `personalise` estimates its moduli, by
  `default_settings` or `PersonaliseSettings` with every `Prior`, and `report` writes the page.
* Images: `detect_in_volume` with `ImagedSettings` makes a case of a volume; `read_volume` with its
  `Modality`, `detect_valve` with the `default_model`.
* Mechanics without a valve: `simulate_body`, `TransverselyIsotropic`.
* `MvestError`, the base class of all errors that a user can cause; `units`.

Data flow in one direction: `imaging` turns volumes into a `valve`, `mechanics` moves the valve
under pressure (`closure`), `estimation` finds the parameters of the observed motion (`problem`,
`personalise`), and `reporting` turns estimates into tables and figures.

Inside the library lengths are mm, times s, masses tonne, forces N and stresses MPa.
"""

import lazy_loader

from mvest._compiling import choose_cache

__version__ = "0.1.0"

choose_cache()
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
