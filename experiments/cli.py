"""The console command ``mvest``.

Exit status as in ``experiments.run``: 0 done; 1 no estimate; 2 the request is wrong (one line says
how); 130, 143 or 129 stopped by Ctrl-C, SIGTERM or SIGHUP.
"""

from __future__ import annotations

import difflib
import pkgutil
import re
import sys
import textwrap
from argparse import Namespace
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import mvest
from experiments.common.places import CONF, EXPERIMENTS
from experiments.console import Parser, interruptible
from mvest.errors import ConfigurationError, InputError

NUMBA_SETTINGS = Path(".numba_config.yaml")
"""A file that would make numba load compiled code from any folder."""

WIDTH = 100
"""Characters of a line of help."""


@dataclass(frozen=True, slots=True)
class Command:
    """One command of ``mvest``.

    Attributes
    ----------
    about, example : str
        For the help.
    run : callable or str
        Parsed arguments -> exit status; or the name of a function that gets the words themselves.
    arguments : mapping
        Name -> arguments of `argparse.ArgumentParser.add_argument`.
    """

    about: str
    example: str
    run: Callable[[Namespace], int] | str
    arguments: dict[str, dict[str, Any]] = field(default_factory=dict)

    def parser(self, name: str) -> Parser:
        """The parser of its arguments, which are paths unless they say otherwise."""
        parser = Parser(f"mvest {name}", self.about, f"mvest {name} {self.example}".rstrip())
        for one, how in self.arguments.items():
            path = {} if "action" in how else {"type": Path}
            parser.add_argument(one, **{**path, **how})
        return parser


@interruptible
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command on its arguments, those of the command line by default; the exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    name, rest = (given[0], given[1:]) if given else ("--help", [])
    if NUMBA_SETTINGS.exists():
        raise InputError(f"{NUMBA_SETTINGS}: numba would obey this file; start from another folder")
    if name in ("-h", "--help", "--version"):
        print(f"mvest {mvest.__version__}" if name == "--version" else _help())
        return 0
    if name not in COMMANDS:
        close = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"did you mean {close[0]}?" if close else f"known: {', '.join(COMMANDS)}"
        raise ConfigurationError(f"{name}: no such command; {hint}")
    command = COMMANDS[name]
    if isinstance(command.run, str):
        return int(pkgutil.resolve_name(command.run)(rest))
    return command.run(command.parser(name).parse_intermixed_args(rest))


def _help() -> str:
    about = "Leaflet stiffness of a mitral valve, from how the valve is seen to close."
    lines = [f"  mvest {name:<10} {command.about}" for name, command in COMMANDS.items()]
    more = "mvest COMMAND --help lists its options and an example; mvest --version the version."
    return "\n".join([about, "", *lines, "", more])


def _list(_: Namespace) -> int:
    print(listing(experiments_in(EXPERIMENTS)))
    return 0


def _tables(parsed: Namespace) -> int:
    from experiments.results.published import regenerate

    print(*regenerate(parsed.folder), sep="\n")
    return 0


def _table(parsed: Namespace) -> int:
    from experiments.results.estimates import write_estimates

    print(*write_estimates(parsed.folder, parsed.target), sep="\n")
    return 0


def _collect(parsed: Namespace) -> int:
    from experiments.runner.sweep import collect_sweep

    return collect_sweep(parsed.folder)


def _sync(parsed: Namespace) -> int:
    from experiments.runner.tracking import sync

    for folder in parsed.folders:
        if not folder.is_dir():
            raise InputError(f"{folder}: there is no such folder")
    return max(map(sync, parsed.folders))


def _dashboard(parsed: Namespace) -> int:
    """Serve MLflow's pages until it is interrupted."""
    import webbrowser

    from experiments.common.schema import validated
    from experiments.runner.tracking import last_sweep, serving
    from mvest.quantities import within

    validated(Annotated[int, within(0, 65_535, "", "ports; 0: a free one")], parsed.port, "--port")
    try:
        place, page, title = last_sweep(parsed.folder)
        with serving(place, parsed.port) as (address, server):
            print(f"{title}: {address}{page}", flush=True)
            webbrowser.open(address + page)
            return server.wait()
    except KeyboardInterrupt:
        return 0


def _worker(parsed: Namespace) -> int:
    """Run a shard of a sweep; a failing job is recorded and does not fail the worker."""
    from experiments.runner.engine import execute
    from experiments.runner.plan import Plan

    found = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", parsed.shard)
    first, step = (int(found[1]), int(found[2])) if found else (0, 0)
    if not 1 <= first <= step:
        raise ConfigurationError(
            f"shard {parsed.shard}, expected I/N with I from 1 to N, for example 2/8"
        )
    plan = Plan.read(parsed.folder, look=False)
    # Every N-th job of the list, done or not: no two shards share one.
    jobs = plan.jobs[first - 1 :: step]
    failed = sum(not execute(job, plan.written_ns).converged for job in jobs)
    print(f"shard {parsed.shard}: {len(jobs)} jobs, {failed} without an estimate")
    return 0


def _completion(parsed: Namespace) -> int:
    """Print a completion script with the words of all commands."""
    cases = []
    for name, command in COMMANDS.items():
        words = ["--help", *(one for one in command.arguments if one.startswith("-"))]
        if name == "run":
            words += ["-m", *(f"{group}={one}" for group, of in groups().items() for one in of)]
        if name in ("import", "export"):
            found = (Path(mvest.__file__).parent / "exchange" / f"{name}ing").glob("*.py")
            words += [one.stem for one in found if f"def {name}_{one.stem}(" in one.read_text()]
        words += ["volume"] if name == "simulate" else []
        words += ["bash", "zsh"] if name == "completion" else []
        cases.append(f'    {name}) words="{" ".join(words)}" ;;')
    start = "autoload -U +X bashcompinit && bashcompinit\n" if parsed.shell == "zsh" else ""
    print(start + SCRIPT.format(commands=" ".join(COMMANDS), cases="\n".join(cases)))
    return 0


SCRIPT = r"""_mvest() {{
  local words="{commands} --help --version" line=${{COMP_LINE:0:COMP_POINT}}
  local word=${{line##* }}
  (( COMP_CWORD > 1 )) && case ${{COMP_WORDS[1]}} in
{cases}
  esac
  COMPREPLY=($(compgen -W "$words" -- "$word"))
  # bash replaces only what follows the last "=".
  [[ $word == *=* && $COMP_WORDBREAKS == *=* ]] && COMPREPLY=("${{COMPREPLY[@]#*=}}")
}}
complete -o default -F _mvest mvest"""


def groups() -> dict[str, list[str]]:
    """Group of the configuration -> its choices."""
    folders = [path for path in sorted(CONF.iterdir()) if path.is_dir() and path.name != "hydra"]
    return {path.name: sorted(one.stem for one in path.glob("*.yaml")) for path in folders}


def run_command(words: list[str]) -> int:
    """``mvest run``: the bare name of an experiment stands for it; the rest is Hydra's."""
    if {"-h", "--help"} & set(words):
        print(_run_help())
        return 0
    from experiments.run import main as application

    before = sys.argv
    sys.argv = ["mvest run", *map(named, words)]
    try:
        return application()
    finally:
        sys.argv = before


def _run_help() -> str:
    chosen = dict(re.findall(r"^  - (\w+): (\w+)$", (CONF / "config.yaml").read_text(), re.M))
    lines = ["usage: mvest run [EXPERIMENT] [GROUP=CHOICE ...] [NAME=VALUE ...] [-m]", ""]
    lines += [COMMANDS["run"].about, "", "groups and choices (default in brackets):"]
    for group, choices in groups().items():
        text = f"{group} [{chosen.get(group, '-')}]: {', '.join(choices)}"
        lines.append(textwrap.fill(text, WIDTH, initial_indent="  ", subsequent_indent="      "))
    return "\n".join([*lines, "", *RUN_OPTIONS])


RUN_OPTIONS = (
    "options:",
    "  -m, --multirun    all combinations of choices separated by commas, as a sweep",
    "  --cfg job         print all settings and their values, without running",
    "  dry_run=true      list what would run, and how long it would take",
    "  check=true        predict how well the moduli could be estimated",
    "  force=true        run finished jobs again",
    "  --hydra-help      further options of Hydra",
    "",
    "example: mvest run -m experiment=table1 seed=1,2,3 observation.noise_mm=0.1,0.5",
)


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


def _one_path(experiment: str, setting: str) -> Callable[[Namespace], int]:
    """A command that runs an experiment on one file or folder."""

    def run(parsed: Namespace) -> int:
        for override in parsed.overrides:
            if "=" not in override:
                raise ConfigurationError(f"{override}: expected NAME=VALUE; one path at a time")
        if setting == "case" and parsed.path.is_file():
            raise InputError(
                f"{parsed.path}: a file, expected a folder with case.yaml; for a volume over time: "
                f"mvest volume {parsed.path}"
            )
        check = ["check=true"] if parsed.check else []
        own = [f"experiment={experiment}", f"{setting}={quoted(str(parsed.path))}"]
        return run_command([*own, *check, *parsed.overrides])

    return run


def quoted(text: str) -> str:
    """Any text as Hydra's grammar takes it literally."""
    doubled = re.sub(r"(\\+)(?='|$)", r"\1\1", text)
    return "'" + doubled.replace("'", r"\'").replace("${", r"\${") + "'"


def experiments_in(folder: Path) -> dict[str, str]:
    """Name of every experiment -> first sentence of its leading comment, or else its title."""
    return {path.stem: _sentence(path) for path in sorted(folder.glob("*.yaml"))}


def _sentence(path: Path) -> str:
    text = path.read_text(encoding="utf-8")
    (comment,) = re.findall(r"\A(?:#.*\n)*", text)
    lines = [line.lstrip("# ") for line in comment.splitlines() if "@package" not in line]
    if found := re.match(r".+?[.?!](?=\s|$)", " ".join(lines)):
        return found[0]
    title = re.search(r"^title: *(.*)$", text, re.M)
    return title[1].strip("'\"") if title else ""


def listing(sentences: dict[str, str]) -> str:
    """Experiments and their sentences in two columns."""
    first = max(map(len, sentences), default=0) + 2
    form = textwrap.TextWrapper(WIDTH, subsequent_indent=" " * first)
    return "\n".join(form.fill(name.ljust(first) + text) for name, text in sentences.items())


def _of(metavar: str, help_: str, **more: Any) -> dict[str, Any]:
    return {"metavar": metavar, "help": help_, **more}


CHECK = "only read, check and draw it, in seconds, and predict how well moduli can be estimated"
SETTINGS = "settings as in `mvest run`, for example seed=2 or imaged.pressure_mmHg=120"
MORE = {
    "--check": {"action": "store_true", "help": CHECK},
    "overrides": _of("NAME=VALUE", SETTINGS, nargs="*", type=str),
}
SWEPT = _of("FOLDER", "of the sweep, in outputs/")

COMMANDS: dict[str, Command] = {
    "list": Command("the experiments, one sentence each", "", _list),
    "run": Command(
        "an experiment with Hydra's overrides; with -m a sweep",
        "table1 seed=2",
        "experiments.cli.run_command",
    ),
    "own-valve": Command(
        "moduli of a valve from a case folder",
        "examples/case --check",
        _one_path("own_valve", "case"),
        {"path": _of("FOLDER", "folder with case.yaml"), **MORE},
    ),
    "volume": Command(
        "moduli of a valve from a volume over time (NRRD, MetaImage, NIfTI, Philips DICOM)",
        "examples/volume.seq.nrrd imaged.pressure_mmHg=120",
        _one_path("volume", "volume"),
        {"path": _of("FILE", "volume over time"), **MORE},
    ),
    "simulate": Command(
        "a simulated echo volume, and the truth in it",
        "volume OUT.seq.nrrd",
        "experiments.simulated_volume.simulate_command",
    ),
    "import": Command(
        "a case folder from files of another program",
        "NAME SOURCE CASE",
        "experiments.exchange.import_command",
    ),
    "export": Command(
        "a case or a result for another program",
        "NAME SOURCE TARGET",
        "experiments.exchange.export_command",
    ),
    "tables": Command(
        "every table, figure and page of results/ again, from the records in it",
        "results",
        _tables,
        {"folder": _of("FOLDER", "of results", nargs="?", default="results")},
    ),
    "table": Command(
        "all estimates of a folder as one table for statistics",
        "outputs estimates.csv",
        _table,
        {
            "folder": _of("FOLDER", "of runs, or results/"),
            "target": _of("FILE", "NAME.csv or NAME.parquet"),
        },
    ),
    "worker": Command(
        "run a share of a planned sweep's jobs, under any scheduler",
        "outputs/sweep_noise --shard 2/8",
        _worker,
        {"folder": SWEPT, "--shard": _of("I/N", "I from 1 to N", default="1/1", type=str)},
    ),
    "collect": Command(
        "collect the results of a sweep that workers ran",
        "outputs/sweep_noise",
        _collect,
        {"folder": SWEPT},
    ),
    "sync": Command(
        "log to MLflow what is on disk and not there",
        "outputs",
        _sync,
        {"folders": _of("FOLDER", "of runs", nargs="*", default=[Path("outputs")])},
    ),
    "dashboard": Command(
        "MLflow's pages, on the comparison of the last sweep",
        "outputs --port 0",
        _dashboard,
        {
            "folder": _of("FOLDER", "of runs", nargs="?", default="outputs"),
            "--port": _of("PORT", "0: a free one", default=5000, type=int),
        },
    ),
    "completion": Command(
        'completion of commands: put eval "$(mvest completion bash)" into ~/.bashrc',
        "bash",
        _completion,
        {"shell": {"type": str, "choices": ["bash", "zsh"], "help": "bash or zsh"}},
    ),
}
"""The commands in the order of the help."""


if __name__ == "__main__":
    sys.exit(main())
