"""Calls in processes give what calls here give, in order, with their time."""

import math

import pytest

from experiments.studies.imaging.parallel import in_processes


@pytest.mark.parametrize("processes", [1, 2])
def test_results_come_in_order_with_their_time(processes: int) -> None:
    found = list(in_processes(math.hypot, [(3.0, 4.0), (5.0, 12.0), (8.0, 15.0)], processes))
    assert [value for value, _ in found] == [5.0, 13.0, 17.0]
    assert all(seconds >= 0 for _, seconds in found)


def test_arguments_are_taken_as_they_are_needed() -> None:
    taken = []

    def calls():
        for k in range(3):
            taken.append(k)
            yield (float(k), 0.0)

    first = next(iter(in_processes(math.hypot, calls(), 1)))
    assert first[0] == 0.0
    assert taken == [0]
