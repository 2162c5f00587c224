"""PostgreSQL as the tracking store, with eight processes writing at once."""

import json
import os
import pwd
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from experiments.common.records.record import read_record
from experiments.runner.compared import HANDFUL, metrics
from tests.experiments.runner.test_tracking import make_config, make_job
from tests.places import ROOT

pytestmark = pytest.mark.slow

PROCESSES, JOBS = 8, 10

UPLOAD = """
import json
import sys
from pathlib import Path
from experiments.runner.tracking import log_run
config, *jobs = sys.argv[1:]
for job in jobs:
    log_run(Path(job), json.loads(config))
"""


def program(name: str) -> str:
    """PostgreSQL's own programs are seldom on the path."""
    places = sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    found = shutil.which(name, path=os.pathsep.join([os.environ["PATH"], *map(str, places)]))
    if found is None:
        pytest.skip(f"PostgreSQL's {name} is not installed (Debian: apt install postgresql)")
    return found


@pytest.fixture
def place() -> Iterator[Path]:
    """A folder that may be given to another account: pytest's own are closed to all others."""
    with tempfile.TemporaryDirectory(prefix="mvest-postgres-") as folder:
        yield Path(folder)


@pytest.fixture
def server(place) -> Iterator[str]:
    """A throw-away cluster on the loopback address: its address for MLflow."""
    pytest.importorskip("psycopg", reason="the extra postgres is not installed")
    initdb, pg_ctl = program("initdb"), program("pg_ctl")
    account: dict = {}
    if os.getuid() == 0:
        # The server refuses to run as root.
        try:
            user = pwd.getpwnam("postgres")
        except KeyError:
            pytest.skip("PostgreSQL runs under an account of its own, and there is no postgres")
        os.chown(place, user.pw_uid, user.pw_gid)
        account = {"user": user.pw_uid, "group": user.pw_gid, "extra_groups": []}
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    data, options = place / "data", f"-p {port} -k {place} -c listen_addresses=127.0.0.1"

    def run(*command: str) -> None:
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=place, **account)

    run(initdb, "-D", str(data), "-U", "mlflow", "-A", "trust", "-E", "UTF8", "--no-sync")
    run(pg_ctl, "-D", str(data), "-o", options, "-l", str(place / "log"), "-w", "start")
    try:
        yield f"postgresql+psycopg://mlflow@127.0.0.1:{port}/postgres"
    finally:
        run(pg_ctl, "-D", str(data), "-m", "immediate", "stop")


def test_eight_processes_lose_nothing(server, tmp_path) -> None:
    config = make_config(tmp_path, tracking={"enabled": True, "uri": server})
    jobs = [
        make_job(tmp_path, f"p{process}j{job}", config)
        for process in range(PROCESSES)
        for job in range(JOBS)
    ]
    # Also the tables are made by whoever comes first, with the others waiting.
    uploads = [
        subprocess.Popen(
            [sys.executable, "-c", UPLOAD, json.dumps(config), *map(str, jobs[k::PROCESSES])],
            cwd=ROOT,
            stderr=subprocess.PIPE,
            text=True,
        )
        for k in range(PROCESSES)
    ]
    said = [upload.communicate(timeout=300)[1] for upload in uploads]
    assert [upload.returncode for upload in uploads] == [0] * PROCESSES, said

    import psycopg

    address = server.replace("+psycopg", "")
    with psycopg.connect(address) as connection:

        def count(query: str) -> int:
            return connection.execute(query).fetchone()[0]

        runs = PROCESSES * JOBS
        assert count("select count(*) from experiments where name = 'debug'") == 1
        assert count("select count(*) from runs where status = 'FINISHED'") == runs
        found = connection.execute("select value from tags where key = 'folder'").fetchall()
        assert sorted(name for (name,) in found) == sorted(job.name for job in jobs)
        numbers = metrics(read_record(jobs[0] / "result.json"))
        for table, expected in (
            ("params", len(HANDFUL) - 2),
            ("metrics", len(numbers)),
        ):
            each = connection.execute(f"select count(*) from {table} group by run_uuid").fetchall()
            assert [number for (number,) in each] == [expected] * runs, table
