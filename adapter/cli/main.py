"""Parse, dispatch, and turn every expected failure into one sentence and an exit code."""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from adapter import optional
from adapter.cli import completion, files_options, model_options, run_options, sim
from adapter.cli.exit_codes import ExitCode, listed
from adapter.cli.parser import Parser
from adapter.errors import MeansError, ModelWarning
from adapter.experiments import arguments as experiments
from adapter.runs.terminal import begin, complain, program_version, show, warn
from drivers.errors import DriverError, NotReady


class Command(NamedTuple):
    """What declares its options and may set `check`, one line of help, what carries it out.

    `run_by` (the function `run` in the file of the command's name where not given) is loaded by
    name, after the command line was found right: most bring libraries that take a second to load.
    Before that `begins`, filled with the arguments, says what is being done. `tests/house` reads
    this table, too.
    """

    declare: Callable[[argparse.ArgumentParser], None]
    words: str
    run_by: str = ""
    may_end: tuple[ExitCode, ...] = ()  # beside what every command may
    begins: str = ""
    simulates: bool = False  # whatever the arguments


COMMANDS = {  # in the order of --help
    "run": Command(
        run_options.declare,
        "learn live",
        may_end=tuple(ExitCode),
        begins="learning live from {driver}",
    ),
    "plan": Command(
        run_options.declare_plan,
        "where run would move the arm",
        may_end=(ExitCode.NOT_READY,),
        begins="planning a motion for {driver}",
    ),
    "excite": Command(
        run_options.declare_excite,
        "design a motion that teaches most, or that tells effects apart",
        begins="designing a motion for {robot}",
    ),
    "replay": Command(
        run_options.declare_replay,
        "learn from a recording",
        may_end=(ExitCode.NOTHING_LEARNED, ExitCode.NOT_CONVERGED),
        begins="learning from {logs}",
    ),
    "gap": Command(
        model_options.declare_gap, "find what a model lacks", begins="comparing {model} with {logs}"
    ),
    "effects": Command(
        model_options.declare_effects,
        "what can be named, and laws of one's own",
        "adapter.cli.files:run_effects",
    ),
    "fleet": Command(
        model_options.declare_fleet,
        "one model per arm from many recordings",
        may_end=(ExitCode.NOTHING_LEARNED,),
        begins="learning one model per arm from {logs}",
    ),
    "load": Command(
        model_options.declare_load,
        "what the hand carries, to type into the robot",
        begins="weighing what the hand carries in {log}",
    ),
    "diff": Command(
        model_options.declare_diff,
        "two models of one arm, joint by joint",
        begins="comparing {first} with {second}",
    ),
    "discover": Command(
        model_options.declare_discover,
        "find the tree of a robot from the motion of its links",
        begins="looking for the tree of the robot in {log}",
    ),
    "sim": Command(
        sim.declare,
        "simulated hardware behind real wire protocols",
        begins="starting a simulated {arm} arm",
        simulates=True,
    ),
    "import": Command(
        files_options.declare_import,
        "turn tables into a recording",
        "adapter.cli.files:run_import",
        begins="reading {sources}",
    ),
    "export": Command(
        files_options.declare_export,
        "write a model for simulators",
        "adapter.cli.results:run_export",
        begins="reading {model}",
    ),
    "report": Command(
        files_options.declare_report,
        "make the HTML page of a run again",
        "adapter.cli.results:run_report",
        begins="making the page of {folder}",
    ),
    "recover": Command(
        files_options.declare_recover,
        "mend a recording that was cut",
        "adapter.cli.files:run_recover",
        begins="mending {file}",
    ),
    "info": Command(
        files_options.declare_info,
        "what is in a recording or a model file",
        "adapter.cli.files:run_info",
        begins="reading {file}",
    ),
    "experiment": Command(
        experiments.experiment,
        "rerun the paper's experiments",
        "adapter.experiments.command:run",
        begins="rerunning the paper's experiments: {names}",
        simulates=True,
    ),
    "bench": Command(
        experiments.bench,
        "compare an update, or learning from a log, with rivals",
        "adapter.experiments.benchmark:run",
        begins="comparing with rivals",
    ),
    "completion": Command(completion.declare, "what a shell needs to complete command lines"),
}


class _Version(argparse.Action):
    """Looks the version up when it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *where: Any) -> None:
        show(program_version())
        parser.exit()


def build_parser() -> Parser:
    """The command line; what it returns carries `command` and `check`, which may raise."""
    parser = Parser(
        prog="adapter",
        description="Lets a torque-sensed arm learn its own body while it moves.",
        epilog=f"adapter COMMAND --help tells more. {listed(ExitCode)}",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="which this is")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, command in COMMANDS.items():
        part = commands.add_parser(name, help=command.words)
        part.set_defaults(check=lambda args: None)
        command.declare(part)
        part.epilog = " ".join(filter(None, (part.epilog, listed(command.may_end))))
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = build_parser()
    completion.complete(parser)
    if not (sys.argv[1:] if arguments is None else arguments):
        parser.print_help()
        return ExitCode.WRONG_USE
    args = parser.parse_args(arguments)
    warnings.showwarning = _show_warning  # type: ignore[assignment]
    try:
        return _carry_out(COMMANDS[args.command], args)
    except ModuleNotFoundError as error:
        sentence = optional.missing(error.name)
        if sentence is None:
            raise
        complain(sentence)
        return ExitCode.NO_MEANS
    except MeansError as error:
        complain(error)
        return ExitCode.NO_MEANS
    except MemoryError:
        complain("there is not enough memory for this")
        return ExitCode.NO_MEANS
    except NotReady as error:
        complain(error)
        return ExitCode.NOT_READY
    except OSError as error:
        complain(f"{error.filename}: {error.strerror}" if error.filename else error)
        return ExitCode.WRONG_USE
    except (DriverError, ValueError) as error:
        complain(error)
        return ExitCode.WRONG_USE
    except KeyboardInterrupt:
        complain("interrupted, before there were results")
        return ExitCode.INTERRUPTED


def _carry_out(command: Command, args: argparse.Namespace) -> int:
    """Check the arguments, say what is being done, do it; returns the exit code."""
    args.check(args)
    if command.begins and not getattr(args, "quiet", False):
        begin(command.begins.format_map({key: _told(x) for key, x in vars(args).items()}))
    if command.simulates:
        optional.load("pybullet")
    run_by = command.run_by or f"adapter.cli.{args.command}:run"
    module, _, function = run_by.partition(":")
    with warnings.catch_warnings(record=args.command in ("gap", "load")) as held:
        try:
            return int(getattr(import_module(module), function)(args))
        finally:  # of the model after the answer, once
            said = [str(x.message) for x in held or () if issubclass(x.category, ModelWarning)]
            warn({text.rpartition("/")[2]: text for text in reversed(said)}.values())


def _told(value: Any) -> Any:
    """An argument in a sentence: files by their names, of many the first."""
    if isinstance(value, list | tuple):
        more = f" and {len(value) - 1} more" * (len(value) > 1)
        return f"{_told(value[0])}{more}" if value else "-"
    if value is None:
        return "the documented arm"
    return value.name if isinstance(value, Path) else value


def _show_warning(message: Any, category: type[Warning], *where: Any) -> None:
    if issubclass(category, ModelWarning):
        warn([str(message)])


if __name__ == "__main__":
    sys.exit(main())
