"""A biomechanical model that is a program of its own, behind the filters.

``process`` starts a program and stops it in time, ``contract`` is the files through which it is
asked and answers, ``differences`` the derivatives of a program that gives none, ``model`` all of it
as an observation model of :mod:`mvest.estimation`. ``README.md`` beside this file is the contract
for those who write the program.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
