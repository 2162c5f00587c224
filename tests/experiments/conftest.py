"""What every test of the application needs."""

import pytest

from tests.experiments.composed_once import composed_once


@pytest.fixture(autouse=True)
def compiled(monkeypatch):
    """Whatever was compiled before: on a fresh installation a note precedes what is tested here.

    That it is given is tested in processes of their own (``test_first_use.py``).
    """
    monkeypatch.setattr("experiments.common.progress.kernels_are_compiled", lambda: True)


@pytest.fixture(autouse=True, scope="session")
def coarse_pictures():
    """Few dots: what is drawn is the same, and nobody looks at it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mvest.reporting.figures.DPI", 40)
        yield


@pytest.fixture(autouse=True, scope="session")
def configurations_composed_once():
    """Merging what the same choices of groups name takes longer than most that is tested here."""
    with composed_once():
        yield
