"""The console command ``mvest``.

Exit status as in ``experiments.run``: 0 done; 1 no estimate; 2 the request is wrong (one line says
how); 130, 143 or 129 stopped by Ctrl-C, SIGTERM or SIGHUP.
"""

from __future__ import annotations

import difflib
import pkgutil
import re
import resource
import shutil
import sys
import textwrap
from argparse import Namespace
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

from experiments.common.places import EXPERIMENTS
from experiments.console import Parser, interruptible
from mvest import __version__
from mvest.errors import ConfigurationError, InputError

NUMBA_SETTINGS = Path(".numba_config.yaml")
"""A file that would make numba load compiled code from a folder of its choice."""

LEAST_GB = 1.2
"""Address space that loading the libraries takes; with less they fail in many ways."""

CHECK = "only read, check and draw it, in seconds, and say what an estimate would be able to tell"
EXAMPLES = {"own-valve": "examples/case", "volume": "examples/volume.seq.nrrd"}
OVERRIDES = "settings as in `mvest run`, for example seed=2 or imaged.pressure_mmHg=120"


@interruptible
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command on its arguments, those of the command line by default; the exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    command, rest = (given[0], given[1:]) if given else ("--help", [])
    if NUMBA_SETTINGS.exists():
        raise InputError(f"{NUMBA_SETTINGS}: numba would obey this file; start from another folder")
    if command in ("-h", "--help", "--version"):
        print(f"mvest {__version__}" if command == "--version" else _help())
        return 0
    if command not in COMMANDS:
        close = difflib.get_close_matches(command, COMMANDS, n=1)
        hint = f"did you mean {close[0]}?" if close else f"known: {', '.join(COMMANDS)}"
        raise ConfigurationError(f"{command}: no such command; {hint}")
    _, run = COMMANDS[command]
    return int(pkgutil.resolve_name(run)(rest)) if isinstance(run, str) else run(rest)


def _help() -> str:
    about = "Leaflet stiffness of a mitral valve, from how the valve is seen to close."
    lines = [f"  mvest {name:<10} {text}" for name, (text, _) in COMMANDS.items()]
    more = "mvest COMMAND --help says more of each; mvest --version says which one this is."
    return "\n".join([about, "", *lines, "", more])


def _parsed(command: str, rest: list[str], **arguments: dict[str, Any]) -> Namespace:
    """The arguments of a command, which are folders unless they say otherwise."""
    parser = Parser(f"mvest {command}", description=COMMANDS[command][0])
    for name, how in arguments.items():
        parser.add_argument(name, **{"type": Path, "metavar": "FOLDER", **how})
    return parser.parse_args(rest)


def _list(rest: list[str]) -> int:
    _parsed("list", rest)
    print(listing(experiments_in(EXPERIMENTS), shutil.get_terminal_size().columns))
    return 0


def _tables(rest: list[str]) -> int:
    from experiments.results.published import regenerate

    results = _parsed("tables", rest, folder={"nargs": "?", "default": "results"}).folder
    print(*regenerate(results), sep="\n")
    return 0


def _table(rest: list[str]) -> int:
    from experiments.results.estimates import write_estimates

    file = {"metavar": "FILE", "help": "NAME.csv or NAME.parquet"}
    parsed = _parsed("table", rest, folder={"help": "of runs, or results/"}, target=file)
    print(*write_estimates(parsed.folder, parsed.target), sep="\n")
    return 0


def _collect(rest: list[str]) -> int:
    from experiments.runner.sweep import collect_sweep

    return collect_sweep(_parsed("collect", rest, folder={}).folder)


def _sync(rest: list[str]) -> int:
    """Bring MLflow to the state of folders of outputs."""
    from experiments.runner.tracking import sync

    some = {"nargs": "*", "help": "outputs if none"}
    folders: list[Path] = _parsed("sync", rest, folders=some).folders or [Path("outputs")]
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"{folder}: there is no such folder")
    return max(sync(folder) for folder in folders)


def _dashboard(rest: list[str]) -> int:
    """Serve MLflow's pages until it is interrupted."""
    import webbrowser

    from experiments.common.schema import validated
    from experiments.runner.tracking import last_sweep, serving
    from mvest.quantities import within

    port = {"default": 5000, "type": int, "metavar": "PORT", "help": "5000; 0: a free one"}
    outputs = {"nargs": "?", "default": "outputs"}
    parsed = _parsed("dashboard", rest, outputs=outputs, **{"--port": port})
    validated(Annotated[int, within(0, 65_535, "", "ports; 0: a free one")], parsed.port, "--port")
    try:
        place, page, title = last_sweep(parsed.outputs)
        with serving(place, parsed.port) as (address, server):
            print(f"{title}: {address}{page}", flush=True)
            webbrowser.open(address + page)
            return server.wait()
    except KeyboardInterrupt:
        return 0


def _worker(rest: list[str]) -> int:
    """Run a shard of a sweep; what becomes of its jobs is recorded, and no failure of this."""
    from experiments.runner.engine import execute
    from experiments.runner.plan import Plan

    shard = {"default": "1/1", "type": str, "metavar": "I/N", "help": "I from 1 to N"}
    folder = {"help": "of the sweep, in outputs/"}
    parsed = _parsed("worker", rest, folder=folder, **{"--shard": shard})
    found = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", parsed.shard)
    first, step = (int(found[1]), int(found[2])) if found else (0, 0)
    if not 1 <= first <= step:
        raise ConfigurationError(
            f"shard {parsed.shard}, expected I/N with I from 1 to N, for example 2/8"
        )
    plan = Plan.read(parsed.folder, look=False)
    # Every N-th job of the list, whatever is done: no two shards share one.
    jobs = plan.jobs[first - 1 :: step]
    ended = [execute(job, plan.written_ns) for job in jobs]
    failed = sum(not record.converged for record in ended)
    print(f"shard {parsed.shard}: {len(jobs)} jobs, {failed} without an estimate")
    return 0


def _application(overrides: list[str]) -> int:
    """Hydra's application, which reads the command line itself."""
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY and limit < LEAST_GB * 2**30:
        raise ConfigurationError(
            f"address space is limited to {limit / 2**30:.2g} GB (ulimit -v), expected at least "
            f"{LEAST_GB:g} GB"
        )
    from experiments.run import main as application

    before = sys.argv
    sys.argv = ["mvest run", *map(named, overrides)]
    try:
        return application()
    finally:
        sys.argv = before


def named(word: str) -> str:
    """A word of `mvest run`; the bare name of an experiment stands for it."""
    if not re.fullmatch(r"[a-z]\w*", word):
        return word
    known = list(experiments_in(EXPERIMENTS))
    if word in known:
        return f"experiment={word}"
    close = [f"experiment={name}" for name in difflib.get_close_matches(word, known, n=1)]
    hint = f"did you mean {close[0]}?" if close else "expected NAME=VALUE; mvest list names them"
    raise ConfigurationError(f"{word}: no such experiment; {hint}")


def _one_file(command: str, metavar: str, experiment: str, setting: str, rest: list[str]) -> int:
    """An experiment on one file or folder."""
    shown = f"for example: mvest {command} {EXAMPLES[command]} --check"
    parser = Parser(f"mvest {command}", description=COMMANDS[command][0], epilog=shown)
    parser.add_argument("path", type=Path, metavar=metavar)
    parser.add_argument("--check", action="store_true", help=CHECK)
    parser.add_argument("overrides", nargs="*", metavar="NAME=VALUE", help=OVERRIDES)
    parsed = parser.parse_intermixed_args(rest)
    for override in parsed.overrides:
        if "=" not in override:
            parser.error(f"{override}: expected NAME=VALUE; one {metavar} at a time")
    if metavar == "FOLDER" and parsed.path.is_file():
        raise InputError(
            f"{parsed.path}: a file, expected a folder with case.yaml; for a volume over time: "
            f"mvest volume {parsed.path}"
        )
    check = ["check=true"] if parsed.check else []
    named = [f"experiment={experiment}", f"{setting}={quoted(str(parsed.path))}"]
    return _application([*named, *check, *parsed.overrides])


def quoted(text: str) -> str:
    """Text as Hydra's grammar takes it literally, whatever characters it has."""
    doubled = re.sub(r"(\\+)(?='|$)", r"\1\1", text)
    return "'" + doubled.replace("'", r"\'").replace("${", r"\${") + "'"


def experiments_in(folder: Path) -> dict[str, str]:
    """Name and first sentence of every experiment: of its leading comment, or else its title."""
    return {path.stem: _sentence(path) for path in sorted(folder.glob("*.yaml"))}


def _sentence(path: Path) -> str:
    lines = path.read_text(encoding="utf-8").splitlines()
    comment = []
    for line in lines:
        if not line.startswith("#"):
            break
        if not line.startswith("# @package"):
            comment.append(line.lstrip("# "))
    if found := re.match(r".+?[.?!](?=\s|$)", " ".join(comment)):
        return found[0]
    title = next((line for line in lines if line.startswith("title:")), "")
    return title.removeprefix("title:").strip().strip("'\"")


def listing(sentences: dict[str, str], width: int) -> str:
    """Experiments and their sentences in two columns, the second one folded to the width."""
    first = max(map(len, sentences), default=0) + 2
    return "\n".join(
        textwrap.fill(
            sentence,
            max(width, first + 40),
            initial_indent=name.ljust(first),
            subsequent_indent=" " * first,
        )
        for name, sentence in sentences.items()
    )


COMMANDS: dict[str, tuple[str, str | Callable[[list[str]], int]]] = {
    "list": ("the experiments, one sentence each", _list),
    "run": (
        "an experiment with Hydra's overrides, -m for a sweep: run experiment=table1 seed=2",
        lambda rest: _application(rest),
    ),
    "own-valve": (
        "moduli of a valve from a case folder",
        lambda rest: _one_file("own-valve", "FOLDER", "own_valve", "case", rest),
    ),
    "volume": (
        "moduli of a valve from a volume over time (NRRD, MetaImage, NIfTI, Philips DICOM)",
        lambda rest: _one_file("volume", "FILE", "volume", "volume", rest),
    ),
    "simulate": (
        "a simulated echo volume and the truth in it: simulate volume OUT.seq.nrrd",
        "experiments.simulated_volume.simulate_command",
    ),
    "import": (
        "a case folder from what another program wrote: import NAME SOURCE CASE",
        "experiments.exchange.import_command",
    ),
    "export": (
        "a case or a result for another program: export NAME SOURCE TARGET",
        "experiments.exchange.export_command",
    ),
    "tables": ("every table, figure and page of results/ again, from the records in it", _tables),
    "table": (
        "all estimates of a folder as one table for statistics: table outputs estimates.csv",
        _table,
    ),
    "worker": (
        "a share of a planned sweep's jobs, under any scheduler: worker FOLDER --shard 2/8",
        _worker,
    ),
    "collect": ("what became of the jobs of a sweep that workers ran", _collect),
    "sync": ("log to MLflow what is on disk and not there: sync outputs", _sync),
    "dashboard": ("MLflow's pages, on the comparison of the last sweep", _dashboard),
}
"""Command -> what it is about, and the function that runs it or, if slow to import, its name."""


if __name__ == "__main__":
    sys.exit(main())
