"""What the estimated valve would do under conditions in which it was not observed.

A scenario changes the pressure, narrows the annulus or clips the leaflets together; the closed
valve under it is computed at the estimate and at samples of its posterior, so that every measure
comes with the uncertainty of the estimate.

* ``scenarios``: what is changed, as value objects, and the model under it;
* ``stress``, ``measures``: what is measured of a closed valve;
* ``posterior``: samples of the estimate, and what is said of a sampled number;
* ``predict``: all of it together.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
