"""From a case to its moduli: the generic valve, the personalised one, and what is known of both.

The chain of one case. The model is built from the reference frame, its chordae and the tracked
boundary. What is not known besides the moduli (pressure, rest lengths and stiffness of the chordae,
a rigid displacement between the tracked boundary and the leaflets) is estimated with a prior, or
left fixed, as each unknown says. Frames that are held out are predicted, never shown.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
