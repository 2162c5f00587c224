"""A signal that asks to stop is never lost, whatever Python was doing when it came."""

import os
import signal
import time
import weakref

import pytest

from experiments.console import ASKING, Interruption, interruptible, raised
from tests.processes import linux


@pytest.fixture(autouse=True)
def _handlers():
    """Whoever was asked to stop listens no more; these tests go on."""
    before = {number: signal.getsignal(number) for number in ASKING}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


class Referent:
    pass


class Closing:
    """Something whose destructor a signal interrupts."""

    def __init__(self, number: int) -> None:
        self.number = number

    def __del__(self) -> None:
        send(self.number)


def send(number: int) -> None:
    os.kill(os.getpid(), number)
    time.sleep(0)  # the handler has run


def in_a_callback(number: int) -> None:
    referent = Referent()
    kept = weakref.ref(referent, lambda _: send(number))
    del referent
    assert kept() is None


@linux
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
@pytest.mark.parametrize("drop", [in_a_callback, Closing])
def test_a_signal_that_python_drops_comes_again(drop, number, capsys):
    @interruptible
    def command() -> int:
        drop(number)
        time.sleep(60)
        return 0

    assert command() == 128 + number
    assert "Exception ignored" not in capsys.readouterr().err


def test_one_that_is_not_dropped_is_raised_once():
    @raised()
    def stopped() -> None:
        try:
            send(signal.SIGTERM)
        finally:
            send(signal.SIGTERM)

    with pytest.raises(Interruption) as found:
        stopped()
    assert found.value.status == 143
