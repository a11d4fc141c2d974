"""Parse, dispatch, and turn every expected failure into one sentence and an exit code."""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any, NamedTuple

from adapter.cli import (
    diff_options,
    discover_options,
    excite_options,
    files_options,
    fleet_options,
    gap_options,
    load_options,
    replay_options,
    results_options,
    run_options,
    sim,
)
from adapter.cli.exit_codes import ExitCode, listed
from adapter.errors import MeansError, ModelWarning
from adapter.experiments import arguments as experiments
from adapter.runs.terminal import complain, program_version, warn
from drivers.interface import DriverError, NotReady


class Command(NamedTuple):
    """What declares its options and may set `check`, one line of help, what carries it out.

    `run_by` is loaded by name, after the command line was found right: most bring libraries that
    take a second to load. `tests/house` reads this table, too.
    """

    declare: Callable[[argparse.ArgumentParser], None]
    words: str
    run_by: str
    may_end: tuple[ExitCode, ...] = ()  # beside what every command may


COMMANDS = {  # in the order of --help
    "run": Command(run_options.declare, "learn live", "adapter.cli.run:run", tuple(ExitCode)),
    "plan": Command(
        run_options.declare_plan,
        "where run would move the arm",
        "adapter.cli.plan:run",
        (ExitCode.NOT_READY,),
    ),
    "excite": Command(
        excite_options.declare,
        "design a motion that teaches most, or that tells effects apart",
        "adapter.cli.excite:run",
    ),
    "replay": Command(
        replay_options.declare,
        "learn from a recording",
        "adapter.cli.replay:run",
        (ExitCode.NOTHING_LEARNED,),
    ),
    "gap": Command(gap_options.declare, "find what a model lacks", "adapter.cli.gap:run"),
    "fleet": Command(
        fleet_options.declare,
        "one model per arm from many recordings",
        "adapter.cli.fleet:run",
        (ExitCode.NOTHING_LEARNED,),
    ),
    "load": Command(
        load_options.declare,
        "what the hand carries, to type into the robot",
        "adapter.cli.load:run",
    ),
    "diff": Command(
        diff_options.declare, "two models of one arm, joint by joint", "adapter.cli.diff:run"
    ),
    "discover": Command(
        discover_options.declare,
        "find the tree of a robot from the motion of its links",
        "adapter.cli.discover:run",
    ),
    "sim": Command(
        sim.declare, "simulated hardware behind real wire protocols", "adapter.cli.sim:run"
    ),
    "import": Command(
        files_options.declare_import,
        "turn tables into a recording",
        "adapter.cli.files:run_import",
    ),
    "export": Command(
        results_options.declare_export,
        "write a model file as URDF",
        "adapter.cli.results:run_export",
    ),
    "report": Command(
        results_options.declare_report,
        "make the HTML page of a run again",
        "adapter.cli.results:run_report",
    ),
    "recover": Command(
        files_options.declare_recover,
        "mend a recording that was cut",
        "adapter.cli.files:run_recover",
    ),
    "info": Command(
        files_options.declare_info,
        "what is in a recording or a model file",
        "adapter.cli.files:run_info",
    ),
    "experiment": Command(
        experiments.experiment,
        "rerun the paper's experiments",
        "adapter.experiments.command:run",
    ),
    "bench": Command(
        experiments.bench, "time the update beside its rivals", "adapter.experiments.benchmark:run"
    ),
}


def build_parser() -> argparse.ArgumentParser:
    """The command line; what it returns carries `command` and `check`, which may raise."""
    parser = argparse.ArgumentParser(
        prog="adapter",
        description="Lets a torque-sensed arm learn its own body while it moves.",
        epilog=f"adapter COMMAND --help tells more. {listed(ExitCode)}",
    )
    parser.add_argument("--version", action="version", version=program_version())
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, command in COMMANDS.items():
        part = commands.add_parser(name, help=command.words)
        part.set_defaults(check=lambda args: None)
        command.declare(part)
        part.epilog = " ".join(filter(None, (part.epilog, listed(command.may_end))))
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    args = build_parser().parse_args(arguments)
    warnings.showwarning = _show_warning  # type: ignore[assignment]
    try:
        args.check(args)
        module, _, function = COMMANDS[args.command].run_by.partition(":")
        return int(getattr(import_module(module), function)(args))
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
        return ExitCode.INTERRUPTED


def _show_warning(message: Any, category: type[Warning], *where: Any) -> None:
    if issubclass(category, ModelWarning):
        warn([str(message)])


if __name__ == "__main__":
    sys.exit(main())
