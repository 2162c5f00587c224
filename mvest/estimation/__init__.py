"""What the filter is: functions and arrays, never a valve.

A model is any function from parameters to a `Prediction`; a filter is settings that can be called
on a model, a prior, an observation and its noise, and returns an `Estimate`. Names are the
textbook's: parameters m, covariance P, process noise Q, observation noise R, Jacobian H, innovation
covariance S, gain K.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
