"""A biomechanical model that is a program of its own, behind the filters.

``process`` starts a program and stops it in time, ``contract`` is the files through which it is
asked and answers, ``differences`` the derivatives of a program that gives none, ``model`` all of it
as an observation model of :mod:`mvest.estimation`. ``README.md`` beside this file is the contract
for those who write the program.
"""

from mvest.external.contract import (
    Answer,
    Request,
    read_answer,
    read_points,
    read_request,
    write_answer,
    write_points,
    write_request,
)
from mvest.external.differences import Differences
from mvest.external.model import ProcessModel
from mvest.external.process import Command, Ending

__all__ = [
    "Answer",
    "Command",
    "Differences",
    "Ending",
    "ProcessModel",
    "Request",
    "read_answer",
    "read_points",
    "read_request",
    "write_answer",
    "write_points",
    "write_request",
]
