"""What every process of tests begins with."""

import gc


def pytest_collection_finish() -> None:
    """Take what importing and collecting made out of the garbage collector's rounds.

    It stays until the end, and looking through a million of objects again and again takes longer
    than many a test.
    """
    gc.collect()
    gc.freeze()
