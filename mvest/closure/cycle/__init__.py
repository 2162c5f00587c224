"""The whole cycle of a simulated valve: any number of frames, open to closed and back."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
