"""A biomechanical model that is a program of its own, behind the filters.

``process`` runs a program, ``contract`` is the files through which it is asked and answers,
``model`` all of it as an observation model of :mod:`mvest.estimation`, with derivatives by
differences of a program that gives none. ``README.md`` beside this file is the contract for those
who write the program.
"""
