"""What the estimated valve would do under conditions in which it was not observed.

A scenario changes the pressure, narrows the annulus or clips the leaflets together; the closed
valve under it is computed at the estimate and at samples of its posterior, so that every measure
comes with the uncertainty of the estimate.

* ``scenarios``: what is changed, as value objects, and the model under it;
* ``stress``, ``measures``: what is told of a closed valve;
* ``posterior``: samples of the estimate, and what is said of a sampled number;
* ``predict``: all of it together.
"""

from mvest.scenarios.measures import MEASURES, Measured, measure_closed
from mvest.scenarios.posterior import Spread, posterior_samples, spread_of
from mvest.scenarios.predict import PredictedScenario, Sample, predict_scenario
from mvest.scenarios.scenario import Annuloplasty, Clip, Scenario, model_under
from mvest.scenarios.stress import PeakStress, peak_stress, principal_cauchy

__all__ = [
    "MEASURES",
    "Annuloplasty",
    "Clip",
    "Measured",
    "PeakStress",
    "PredictedScenario",
    "Sample",
    "Scenario",
    "Spread",
    "measure_closed",
    "model_under",
    "peak_stress",
    "posterior_samples",
    "predict_scenario",
    "principal_cauchy",
    "spread_of",
]
