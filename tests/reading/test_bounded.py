import lzma
import zlib
from pathlib import Path

import numpy as np
import pytest

from mvest.errors import GeometryError, InputError
from mvest.reading.bounded import array_of_words, inflate, max_inflated, refusing
from mvest.reading.text import MAX_LINE

PACK = {False: zlib.compress, True: lzma.compress}


@pytest.mark.parametrize("of_lzma", PACK)
def test_what_is_compressed_is_inflated_up_to_a_size(of_lzma: bool) -> None:
    packed = PACK[of_lzma](bytes(5000))
    assert inflate(packed, 5000, of_lzma=of_lzma) == bytes(5000)
    assert inflate(PACK[of_lzma](b""), 0, of_lzma=of_lzma) == b""
    with pytest.raises(InputError, match="more than 4999 bytes"):
        inflate(packed, 4999, of_lzma=of_lzma)
    with pytest.raises(InputError, match="end too early"):
        inflate(packed[:-3], 5000, of_lzma=of_lzma)
    with pytest.raises(InputError, match="damaged"):
        inflate(b"\xff" * 20, 5000, of_lzma=of_lzma)


def test_volumes_that_users_have_may_be_inflated() -> None:
    assert max_inflated(20 * 10**6) >= 200 * 10**6
    assert max_inflated(10**6) <= 10**8
    assert max_inflated(0) == 2**26


def test_numbers_are_decimal() -> None:
    np.testing.assert_array_equal(array_of_words(["1", "-2.5e1"], np.float64), [1, -25])
    for word in ("1_0", "٣", "0x1", "1e", ""):
        with pytest.raises(InputError, match="damaged numbers"):
            array_of_words(["1", word], np.float64)
    with pytest.raises(InputError, match="damaged numbers"):
        array_of_words(["1" + 400 * "0"], np.int64)


@pytest.mark.parametrize(
    ("error", "kind", "words"),
    [
        (GeometryError("open"), GeometryError, "a.stl: open"),
        (RuntimeError("a\n\x1b[31m b"), InputError, "a.stl: damaged or no STL file: a �[31m b"),
        (RecursionError(), InputError, "a.stl: damaged or no STL file: RecursionError"),
        (MemoryError(), InputError, "a.stl: damaged or no STL file: MemoryError"),
        (GeometryError("x" * 1000), GeometryError, "a.stl: x"),
        (GeometryError("/nowhere/a.stl: open"), GeometryError, "a.stl: open"),
    ],
)
def test_everything_becomes_one_line(error: Exception, kind: type, words: str) -> None:
    path = Path("/nowhere/a.stl")
    with pytest.raises(kind) as caught, refusing(path, "STL file"):
        raise error
    message = str(caught.value)
    assert message.startswith(f"/nowhere/{words}")
    assert message.count("nowhere") == 1
    assert len(message.removeprefix("/nowhere/")) <= MAX_LINE


def test_an_interruption_is_let_through() -> None:
    with pytest.raises(KeyboardInterrupt), refusing(Path("a.stl"), "STL file"):
        raise KeyboardInterrupt
