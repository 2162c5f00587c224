"""Reading volumes over time from the files that scanners and viewers write."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
