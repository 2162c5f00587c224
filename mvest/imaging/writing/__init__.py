"""Writing what the image step makes: sequences and segmentations for 3D Slicer."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
