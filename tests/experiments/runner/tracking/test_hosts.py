"""Whom the dashboard answers: its own address and port, and no name that leads there."""

import pytest
from mlflow.server.security_utils import is_allowed_host_header

from experiments.runner.tracking import dashboard

OWN = ("127.0.0.1:5000", "localhost:5000", "[::1]:5000")

OTHERS = (
    "192.168.evil.com",
    "192.168.evil.com:5000",
    "10.evil.com:5000",
    "172.16.evil.com",
    "fd00:evil",
    "localhost",
    "127.0.0.1",
    "localhost:5001",
    "localhost:5000.evil.com",
    "localhost:evil.com",
    "127.0.0.1:5000.evil.com",
    "0.0.0.0:5000",
    "LOCALHOST.evil.com:5000",
    "evil.com",
    "*",
    "",
)


@pytest.mark.parametrize("host", OWN)
def test_its_own_address_is_answered(host: str) -> None:
    assert is_allowed_host_header(dashboard.allowed_hosts(5000), host)


@pytest.mark.parametrize("host", OTHERS)
def test_no_other_name_is(host: str) -> None:
    assert not is_allowed_host_header(dashboard.allowed_hosts(5000), host)


def test_the_port_may_be_left_out_where_browsers_do() -> None:
    allowed = dashboard.allowed_hosts(80)
    assert is_allowed_host_header(allowed, "localhost")
    assert is_allowed_host_header(allowed, "localhost:80")
    assert not is_allowed_host_header(allowed, "192.168.evil.com")


def test_a_port_that_is_none_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert dashboard.main(["--port", "99999"]) == 2
    assert "--port = 99999, expected 0 to 65535" in capsys.readouterr().err
