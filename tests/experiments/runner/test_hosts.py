"""Whom the dashboard answers: its own address and port, and no name that leads there."""

import socket

import pytest
from mlflow.server.security_utils import is_allowed_host_header

from experiments.cli import main
from experiments.runner import tracking
from mvest.errors import InputError

OWN = ("127.0.0.1:5000", "[::1]:5000", "mvest.localhost:5000")
OTHERS = ("192.168.evil.com:5000", "localhost:5001", "localhost:5000.evil.com", "*", "")


@pytest.mark.parametrize("host", OWN + OTHERS)
def test_its_own_address_alone_is_answered(host: str) -> None:
    assert is_allowed_host_header(tracking.allowed_hosts(5000), host) is (host in OWN)


def test_a_port_that_is_none_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dashboard", "--port", "99999"]) == 2
    assert "--port = 99999, expected 0 to 65535" in capsys.readouterr().err


def test_a_port_that_is_taken_is_refused() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with (
            pytest.raises(InputError, match=f"port {port} cannot be used"),
            tracking.serving("sqlite://", port),
        ):
            pytest.fail("it cannot serve there")
