"""A biomechanical model that is a program of its own, behind the filters.

``contract`` is the program's command and the files through which it is asked and answers, ``model``
all of it as an observation model of :mod:`mvest.estimation`. ``README.md`` beside this file is the
contract for those who write the program.
"""
