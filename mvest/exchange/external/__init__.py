"""A biomechanical model that is a program of its own, behind the filters.

``contract`` holds the program's command and the files of its requests and responses. ``model`` is
an observation model of :mod:`mvest.estimation` that runs the program. ``README.md`` beside this
file is the contract for those who write the program.
"""
