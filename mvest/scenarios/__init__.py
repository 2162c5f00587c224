"""What the estimated valve would do under conditions in which it was not observed.

A scenario changes the pressure, narrows the annulus or clips the leaflets together; the closed
valve under it is computed at the estimate and at samples of its posterior, so that every measure
comes with the uncertainty of the estimate.

* ``scenario``: what is changed, as value objects, and the model under it;
* ``measures``: what is measured of a closed valve, and the stress of its leaflets;
* ``predict``: samples of the estimate, and a summary of what is computed at them.
"""
