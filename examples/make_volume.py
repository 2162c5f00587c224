"""A small simulated echo volume of a valve that opens and closes: ``make_volume.py FILE.seq.nrrd``.

The valve is the template with another annulus, closed by the mechanics on a coarse mesh; the volume
has its open frame, two frames on the way, and the closed one under 120 mmHg. Simulated.
"""

import sys
from pathlib import Path

import numpy as np

import mvest
from mvest.exchange.volumes import write_sequence_nrrd
from mvest.imaging.simulator.acquisition import Acquisition, draw_probe
from mvest.imaging.simulator.simulate import simulate_volume, true_sequence
from mvest.simulation.motion import DrawnValve, MotionSettings, close_in_motion
from mvest.valve.anatomy.dimensions import AnnulusDimensions

MODULI = {"E_f.anterior": 6.23, "E_f.posterior": 2.09}
TISSUE = {"anterior": mvest.TissueSettings(2.65), "posterior": mvest.TissueSettings(1.11)}


def make_volume(frames=4, seed=3):
    """The volume and, for comparison, where the valve in it truly is."""
    template = mvest.Template(mvest.TemplateParameters(AnnulusDimensions(34.4, 22.0)))
    settings = MotionSettings(frames=frames, held_pressure=(), held_relaxation=())
    drawn = DrawnValve("example", template, MODULI, mvest.MechanicsSettings(TISSUE))
    valve = close_in_motion(drawn, settings)
    probe = draw_probe(np.random.default_rng(5), tilt_deg=(0.0, 25.0))
    volume = simulate_volume(valve, Acquisition(), probe, seed)
    return volume, true_sequence(valve, probe)


if __name__ == "__main__":
    path = write_sequence_nrrd(Path(sys.argv[1]), make_volume()[0])
    print(f"{path}: try experiment=volume volume={path} imaged.pressure_mmHg=120 check=true")
