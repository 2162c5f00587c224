"""``mvest simulate volume``: a simulated echo volume over time, and its truth next to it."""

import inspect
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException

from experiments.common.building.closure import mechanics_of, template_of
from experiments.common.config import plain, register
from experiments.common.places import CONF
from experiments.common.progress import PartBar
from experiments.common.schema import defaults_of, from_words
from experiments.console import Parser
from mvest.cases.from_images.measures import write_landmarks, write_surfaces
from mvest.errors import ConfigurationError
from mvest.exchange.volumes import sequence_path, write_sequence_nrrd
from mvest.files import write_atomically
from mvest.imaging.simulator.acquisition import Acquisition, draw_probe
from mvest.imaging.simulator.simulate import simulate_volume, true_sequence
from mvest.quantities import Angle, Count, Length, Modulus, Seed
from mvest.simulation.motion import DrawnValve, MotionSettings, close_in_motion

SUFFIX = ".seq.nrrd"

CONFIGURED = ("valve", "mechanics")  # groups of the configuration with the valve and its mechanics


@dataclass(frozen=True, slots=True)
class SimulatedVolumeOptions:
    """The valve and its image.

    Attributes
    ----------
    moduli : tuple of float
        MPa, along the fibres of the anterior and the posterior leaflet.
    frames : int
        From the open to the closed valve, both included.
    seed : int
        Of the pose of the probe, the heart around the valve, speckle and noise.
    distance_mm, tilt_deg : (float, float)
        Ranges of the distance from the probe to the valve, and of the angle of the valve's axis to
        the line of sight.
    acquisition : Acquisition
        The scanner: acquisition.voxel_mm=1, acquisition.gain_db=6 and others.
    """

    moduli: tuple[Modulus, Modulus] = (6.23, 2.09)
    frames: Count = 4
    seed: Seed = 3
    distance_mm: tuple[Length, Length] = (35.0, 75.0)
    tilt_deg: tuple[Angle, Angle] = (0.0, 25.0)
    acquisition: Acquisition = field(default_factory=Acquisition)


def simulate_command(words: Sequence[str]) -> int:
    """``mvest simulate volume OUT.seq.nrrd [NAME=VALUE ...]``; exit status."""
    about = f"{__doc__}\n\nvalve=NAME and mechanics... as in `mvest run`, and:"
    options = inspect.getdoc(SimulatedVolumeOptions)
    parser = Parser(
        "mvest simulate",
        f"{about}\n\n{options}\n\n{defaults_of(SimulatedVolumeOptions)}",
        "mvest simulate volume mine.seq.nrrd valve=prolapse moduli=[5,1.8] seed=7",
        {
            "what": {"choices": ["volume"], "type": str},
            "target": {"metavar": "OUT", "help": f"file that ends in {SUFFIX}"},
            "options": {"nargs": "*", "metavar": "NAME=VALUE", "type": str},
        },
    )
    parsed = parser.parse_intermixed_args(list(words))
    began = time.monotonic()
    volume, truth = write_simulated_volume(parsed.target, parsed.options)
    print(
        f"wrote {volume}: a simulated volume, of nobody, in {time.monotonic() - began:.1f} s\n"
        f"its truth: {truth}\nnext: mvest volume {volume} --check"
    )
    return 0


def write_simulated_volume(target: Path, words: Sequence[str]) -> tuple[Path, Path]:
    """Simulate a volume and write it; returns the paths of volume and truth.

    ``words`` are options NAME=VALUE. Next to ``NAME.seq.nrrd``, the folder ``NAME_truth`` has
    ``truth.json``, the surfaces of all frames, and the landmarks of the open and the closed frame.
    No estimate reads it.

    Raises an `MvestError` if a name is unknown, a value inadmissible, or the valve does not close.
    """
    sequence_path(target)
    configured = [word for word in words if word.partition("=")[0].split(".")[0] in CONFIGURED]
    own = [word for word in words if word not in configured]
    options = from_words("simulate", SimulatedVolumeOptions, own, CONFIGURED)
    register()
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            values = plain(compose("config", ["experiment=imaging", *configured]))
    except HydraException as error:
        raise ConfigurationError(str(error).partition("\n")[0]) from error
    template, mechanics = template_of(values), mechanics_of(values)
    moduli = dict(zip(("E_f.anterior", "E_f.posterior"), options.moduli, strict=True))
    motion = MotionSettings(frames=options.frames, held_pressure=(), held_relaxation=())
    probe = draw_probe(
        np.random.default_rng([options.seed, 2]),
        options.acquisition,
        distance_mm=options.distance_mm,
        tilt_deg=options.tilt_deg,
    )
    with PartBar("closure of the valve and its echo", 2, "part") as bar:
        valve = close_in_motion(DrawnValve("simulated", template, moduli, mechanics), motion)
        bar.step()
        volume = simulate_volume(valve, options.acquisition, probe, options.seed)
        bar.step()
    target.parent.mkdir(parents=True, exist_ok=True)
    truth = target.with_name(target.name.removesuffix(SUFFIX) + "_truth")
    truth.mkdir(exist_ok=True)
    true = true_sequence(valve, probe)
    facts = {
        "simulated": True,
        "command": " ".join(["mvest simulate volume", target.name, *words]),
        "moduli_MPa": moduli,
        "pressure_mmHg": mechanics.protocol.pressure_mmHg,
        "open_frame": 0,
        "closed_frame": options.frames - 1,
        "times_s": valve.times.tolist(),
        "seed": options.seed,
    }
    write_surfaces(truth, true)
    for frame in (0, options.frames - 1):
        write_landmarks(truth / f"valve_{frame:04d}.mrk.json", true, frame)
    write_atomically(truth / "truth.json", json.dumps(facts, indent=1) + "\n")
    return write_sequence_nrrd(target, volume), truth
