"""Personalisation: from a case to its moduli, with their uncertainty.

The model of a case is built from the reference frame, its chordae and the tracked boundary.
Nuisances (pressure, rest lengths and stiffness of the chordae, a rigid displacement between tracked
boundary and leaflets) are estimated with priors or fixed. Held-out frames are only predicted.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
