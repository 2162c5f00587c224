"""Predicts an estimated valve under conditions in which it was not observed.

A scenario changes the pressure, narrows the annulus or clips the leaflets together. The closed
valve is computed at the estimate and at samples of its posterior.
"""
