"""Parse, dispatch, and turn every expected failure into one sentence and an exit code."""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Sequence
from typing import Any

from adapter.cli import bench, discover, experiment, files, gap, replay, run, sim
from adapter.cli.common import UsageError, console, program_version
from adapter.errors import ModelError, ModelWarning, SettingsError
from adapter.realtime.shared import SharedMemoryError
from adapter.realtime.snapshot import SnapshotError
from adapter.realtime.worker import WorkerError
from drivers.interface import DriverError

EXIT_WRONG_USE, EXIT_NO_MEANS, EXIT_INTERRUPTED = 2, 5, 130


def build_parser() -> argparse.ArgumentParser:
    """The whole command line."""
    parser = argparse.ArgumentParser(
        prog="adapter",
        description="Lets a torque-sensed arm learn its own body while it moves.",
        epilog="adapter COMMAND --help tells more",
    )
    parser.add_argument("--version", action="version", version=program_version())
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for part in (run, replay, gap, discover, experiment, sim):
        part.add_parser(commands)
    files.add_parsers(commands)
    bench.add_parser(commands)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    args = build_parser().parse_args(arguments)
    warnings.showwarning = _show_warning  # type: ignore[assignment]
    try:
        return int(args.run(args))
    except (SharedMemoryError, SnapshotError, WorkerError) as error:
        console.print(f"[red]error:[/] {error}", soft_wrap=True)
        return EXIT_NO_MEANS
    except (UsageError, SettingsError, ModelError, DriverError, ValueError, OSError) as error:
        # an OSError names the file or folder that cannot be read or written
        console.print(f"[red]error:[/] {error}", soft_wrap=True)
        return EXIT_WRONG_USE
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED


def _show_warning(message: Any, category: type[Warning], *where: Any) -> None:
    if issubclass(category, ModelWarning):
        console.print(f"[yellow]warning:[/] {message}", soft_wrap=True)


if __name__ == "__main__":
    sys.exit(main())
