"""Simulated valves in motion: what detectors learn from and are tested on.

Closures of :mod:`mvest.closure.model`, on anatomies around given ones, as
:class:`mvest.imaging.moving_valve.MovingValve`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
