"""What the filter is: functions and arrays, never a valve.

A model is any function from parameters to a `Prediction`; a filter is settings that can be called
on a model, a prior, an observation and its noise, and returns an `Estimate`. Names are the
textbook's: parameters m, covariance P, process noise Q, observation noise R, Jacobian H, innovation
covariance S, gain K.
"""

from mvest.estimation.estimate import Estimate, Filter, InnovationSummary, Reason
from mvest.estimation.filters.considered import SchmidtFilter
from mvest.estimation.filters.drift import DriftEstimate, DriftSmoother, FrameModel
from mvest.estimation.filters.ensemble import EnsembleFilter
from mvest.estimation.filters.extended import ExtendedFilter
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.filters.monte_carlo import MonteCarloFilter
from mvest.estimation.filters.paper import PaperFilter
from mvest.estimation.filters.sampler import SamplerSettings
from mvest.estimation.filters.sequential import SequentialEstimate, SequentialFilter
from mvest.estimation.filters.unscented import UnscentedFilter
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.information.consistency import (
    Consistency,
    ZTest,
    chi_square_band,
    consistency,
    lag_one_autocorrelation,
    moran,
    nees,
    zero_mean,
)
from mvest.estimation.information.design import Design, together
from mvest.estimation.information.identifiability import (
    Confounded,
    Identifiability,
    cramer_rao_bound,
    identifiability,
)
from mvest.estimation.information.model_error import shift_by_model_error
from mvest.estimation.information.profile import Profile, profile
from mvest.estimation.noise import NoiseCovariance, ObservationNoise, observation_noise
from mvest.estimation.prediction import ObservationModel, Prediction
from mvest.estimation.trajectory import (
    FrameState,
    Trajectory,
    filter_frames,
    random_walk,
    smooth_frames,
)
from mvest.estimation.transform import Identity, Log, Transform
from mvest.estimation.update import Update, kalman_update

__all__ = [
    "Confounded",
    "Consistency",
    "Design",
    "DriftEstimate",
    "DriftSmoother",
    "EnsembleFilter",
    "Estimate",
    "ExtendedFilter",
    "Filter",
    "FrameModel",
    "FrameState",
    "Gaussian",
    "Identifiability",
    "Identity",
    "InnovationSummary",
    "IteratedFilter",
    "Log",
    "MonteCarloFilter",
    "NoiseCovariance",
    "ObservationModel",
    "ObservationNoise",
    "PaperFilter",
    "Prediction",
    "Profile",
    "Reason",
    "SamplerSettings",
    "SchmidtFilter",
    "SequentialEstimate",
    "SequentialFilter",
    "Trajectory",
    "Transform",
    "UnscentedFilter",
    "Update",
    "ZTest",
    "chi_square_band",
    "consistency",
    "cramer_rao_bound",
    "filter_frames",
    "identifiability",
    "kalman_update",
    "lag_one_autocorrelation",
    "moran",
    "nees",
    "observation_noise",
    "profile",
    "random_walk",
    "shift_by_model_error",
    "smooth_frames",
    "together",
    "zero_mean",
]
