"""The console command ``mvest``.

Exit status as in ``experiments.run``: 0 done; 1 no estimate; 2 the request is wrong (one line says
how); 130, 143 or 129 stopped by Ctrl-C, SIGTERM or SIGHUP.
"""

import difflib
import pkgutil
import re
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mvest
from experiments.common.places import CONF, EXPERIMENTS
from experiments.console import Parser, interruptible
from mvest.errors import ConfigurationError, InputError

# A file that would make numba load compiled code from any folder.
NUMBA_SETTINGS = Path(".numba_config.yaml")
WIDTH = 100  # characters of a line of help


@dataclass(frozen=True, slots=True)
class Command:
    """One command of ``mvest``."""

    #: for the help
    about: str
    example: str
    run: str  #: full name of a function that returns an exit status, or paths to print
    #: arguments of the function, see `Parser`; None: it gets the words themselves
    arguments: dict[str, dict[str, Any]] | None = None

    def __call__(self, name: str, words: list[str]) -> int:
        """Run the command of that name; returns the exit status."""
        if self.arguments is None:
            return int(pkgutil.resolve_name(self.run)(words))
        example = f"mvest {name} {self.example}".rstrip()
        parser = Parser(f"mvest {name}", self.about, example, self.arguments)
        # Imported after the arguments were checked: some of these modules take seconds.
        parsed = vars(parser.parse_intermixed_args(words))
        result = pkgutil.resolve_name(self.run)(**parsed)
        if isinstance(result, int):
            return result
        print(*result, sep="\n")
        return 0


@interruptible
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command on its arguments, by default those of the command line; the exit status."""
    name, *words = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if NUMBA_SETTINGS.exists():
        raise InputError(f"{NUMBA_SETTINGS}: numba would obey this file; start from another folder")
    if name in ("-h", "--help", "--version"):
        print(f"mvest {mvest.__version__}" if name == "--version" else _help())
        return 0
    if name not in COMMANDS:
        close = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"did you mean {close[0]}?" if close else f"known: {', '.join(COMMANDS)}"
        raise ConfigurationError(f"{name}: no such command; {hint}")
    return COMMANDS[name](name, words)


def _help() -> str:
    about = "Leaflet stiffness of a mitral valve, from how the valve is seen to close."
    lines = [f"  mvest {name:<10} {command.about}" for name, command in COMMANDS.items()]
    more = "mvest COMMAND --help lists its options and an example; mvest --version the version."
    return "\n".join([about, "", *lines, "", more])


def list_experiments() -> list[str]:
    """Every experiment and its sentence, in two columns."""
    sentences = experiments_in(EXPERIMENTS)
    first = max(map(len, sentences)) + 2
    form = textwrap.TextWrapper(WIDTH, subsequent_indent=" " * first)
    return [form.fill(name.ljust(first) + text) for name, text in sentences.items()]


def completion(shell: str) -> list[str]:
    """A completion script with the words of all commands."""
    cases = []
    for name, command in COMMANDS.items():
        words = ["--help", *(one for one in command.arguments or () if one.startswith("-"))]
        if name == "run":
            words += ["-m", *(f"{group}={one}" for group, of in groups().items() for one in of)]
        if name in ("import", "export"):
            found = (Path(mvest.__file__).parent / "exchange" / f"{name}ing").glob("*.py")
            words += [one.stem for one in found if f"def {name}_{one.stem}(" in one.read_text()]
        words += ["volume"] if name == "simulate" else []
        words += ["bash", "zsh"] if name == "completion" else []
        cases.append(f'    {name}) words="{" ".join(words)}" ;;')
    start = "autoload -U +X bashcompinit && bashcompinit\n" if shell == "zsh" else ""
    return [start + SCRIPT.format(commands=" ".join(COMMANDS), cases="\n".join(cases))]


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


def own_valve(path: Path, check: bool, overrides: list[str]) -> int:
    """Run the experiment of a case folder."""
    if path.is_file():
        raise InputError(
            f"{path}: a file, expected a folder with case.yaml; for a volume over time: "
            f"mvest volume {path}"
        )
    return _run_path("experiment=own_valve", "case", path, check, overrides)


def volume(path: Path, check: bool, overrides: list[str]) -> int:
    """Run the experiment of a volume over time."""
    return _run_path("experiment=volume", "volume", path, check, overrides)


def _run_path(experiment: str, setting: str, path: Path, check: bool, overrides: list[str]) -> int:
    for override in overrides:
        if "=" not in override:
            raise ConfigurationError(f"{override}: expected NAME=VALUE; one path at a time")
    checked = ["check=true"] if check else []
    return run_command([experiment, f"{setting}={quoted(str(path))}", *checked, *overrides])


def quoted(text: str) -> str:
    """Any text as Hydra's grammar takes it literally."""
    doubled = re.sub(r"(\\+)(?='|$)", r"\1\1", text)
    return "'" + doubled.replace("'", r"\'").replace("${", r"\${") + "'"


def comment_of(text: str) -> str:
    """The leading comment of a configuration file."""
    (comment,) = re.findall(r"\A(?:#.*\n)*", text)
    lines = (line[1:].strip() for line in comment.splitlines() if "@package" not in line)
    return " ".join(lines)


def experiments_in(folder: Path) -> dict[str, str]:
    """Name of every experiment -> first sentence of its leading comment, or else its title."""
    found = {}
    for path in sorted(folder.glob("*.yaml")):
        text = path.read_text(encoding="utf-8")
        sentence = re.match(r".+?[.?!](?=\s|$)", comment_of(text))
        title = re.search(r"^title: *(.*)$", text, re.M)
        found[path.stem] = sentence[0] if sentence else title[1].strip("'\"") if title else ""
    return found


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
    "list": Command(
        "the experiments, one sentence each", "", "experiments.cli.list_experiments", {}
    ),
    "run": Command(
        "an experiment with Hydra's overrides; with -m a sweep",
        "table1 seed=2",
        "experiments.cli.run_command",
    ),
    "own-valve": Command(
        "moduli of a valve from a case folder",
        "examples/case --check",
        "experiments.cli.own_valve",
        {"path": _of("FOLDER", "folder with case.yaml"), **MORE},
    ),
    "volume": Command(
        "moduli of a valve from a volume over time (NRRD, MetaImage, NIfTI, Philips DICOM)",
        "examples/volume.seq.nrrd imaged.pressure_mmHg=120",
        "experiments.cli.volume",
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
        "experiments.results.published.regenerate",
        {"results": _of("FOLDER", "of results", nargs="?", default="results")},
    ),
    "results": Command(
        "which published results are stale; with --run, make them anew",
        "volumes --run --shard 1/2",
        "experiments.results.renewal.run_results",
        {
            "studies": _of("STUDY", "of those listed; none: all", nargs="*", type=str),
            "--run": {"action": "store_true", "help": "make what is missing or stale"},
            "--shard": _of("K/N", "only every N-th job, from the K-th on", default="1/1", type=str),
            "--results": _of("FOLDER", "of results", default="results"),
        },
    ),
    "table": Command(
        "all estimates of a folder as one table for statistics",
        "outputs estimates.csv",
        "experiments.results.estimates.write_estimates",
        {
            "folder": _of("FOLDER", "of runs, or results/"),
            "target": _of("FILE", "NAME.csv or NAME.parquet"),
        },
    ),
    "calibrate": Command(
        "a calibration of moduli from the records of virtual patients",
        "results volume_calibration calibration.json",
        "experiments.results.calibrated.calibrate_command",
        {
            "results": _of("FOLDER", "of results"),
            "table": _of("TABLE", "volume_calibration", type=str),
            "target": _of("FILE", "to write, for personal.calibration=FILE"),
        },
    ),
    "worker": Command(
        "run a share of a planned sweep's jobs, under any scheduler",
        "outputs/sweep_noise --shard 2/8",
        "experiments.runner.sweep.run_shard",
        {"folder": SWEPT, "--shard": _of("I/N", "I from 1 to N", default="1/1", type=str)},
    ),
    "collect": Command(
        "collect the results of a sweep that workers ran",
        "outputs/sweep_noise",
        "experiments.runner.sweep.collect_sweep",
        {"folder": SWEPT},
    ),
    "sync": Command(
        "log to MLflow what is on disk and not there",
        "outputs",
        "experiments.runner.tracking.sync",
        {"outputs": _of("FOLDER", "of runs", nargs="?", default="outputs")},
    ),
    "dashboard": Command(
        "MLflow's pages, on the comparison of the last sweep",
        "outputs --port 0",
        "experiments.runner.tracking.dashboard",
        {
            "outputs": _of("FOLDER", "of runs", nargs="?", default="outputs"),
            "--port": _of("PORT", "0: a free one", default=5000, type=int),
        },
    ),
    "completion": Command(
        'completion of commands: put eval "$(mvest completion bash)" into ~/.bashrc',
        "bash",
        "experiments.cli.completion",
        {"shell": {"type": str, "choices": ["bash", "zsh"], "help": "bash or zsh"}},
    ),
}
"""The commands in the order of the help."""


if __name__ == "__main__":
    sys.exit(main())
