import pytest

from tests.valve import shapes as simple_shapes


@pytest.fixture(scope="session")
def shapes():
    return simple_shapes
