"""Records of virtual patients whose estimates are off by a known offset of the logarithm."""

from collections.abc import Iterator

import numpy as np

from mvest.personalisation.calibration import MeasuredFor
from mvest.problem.record import EstimateRecord, Unknown

MODULI = ("E_f.anterior", "E_f.posterior")
PRIOR = {"E_f.anterior": 6.23, "E_f.posterior": 2.09}


def patients(
    rng: np.random.Generator,
    n: int,
    measured_for: MeasuredFor,
    offset: tuple[float, float] = (0.0, 0.25),
) -> Iterator[EstimateRecord]:
    """Records of estimates whose truth is higher by an offset of the logarithm."""
    for seed in range(n):
        V = np.array([[0.04, 0.015], [0.015, 0.03]])
        x = 0.4 * rng.standard_normal(2)
        truth = x + np.array(offset) + rng.multivariate_normal([0, 0], V)
        moduli = tuple(
            Unknown(
                name=name,
                prior_mean=PRIOR[name],
                prior_std=0.5 * PRIOR[name],
                truth=PRIOR[name] * float(np.exp(t)),
                estimate=PRIOR[name] * float(np.exp(z)),
            )
            for name, t, z in zip(MODULI, truth, x, strict=True)
        )
        about = {
            "measured_for": measured_for.model_dump(),
            "patients": 0,
            "why": "",
            "parameters": MODULI,
            "log_estimate": x.tolist(),
            "log_covariance": V.tolist(),
        }
        yield EstimateRecord(
            case=f"patient_{seed}",
            seed=seed,
            status="converged",
            reason="",
            unknowns=moduli,
            details={"calibration": (about,)},
        )
