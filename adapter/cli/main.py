"""Parse, dispatch, and turn every expected failure into one sentence and an exit code."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from adapter.cli.arguments import build_parser
from adapter.errors import MeansError, ModelWarning
from adapter.runs.terminal import console
from drivers.interface import DriverError

EXIT_WRONG_USE, EXIT_NO_MEANS, EXIT_INTERRUPTED = 2, 5, 130
# What carries a command out. Loaded by name, after the command line was found right: most of
# these bring libraries that take a second to load. `tests/house` reads this table, too.
RUN_BY = {
    "run": "adapter.cli.run:run",
    "replay": "adapter.cli.replay:run",
    "gap": "adapter.cli.gap:run",
    "load": "adapter.cli.load:run",
    "diff": "adapter.cli.diff:run",
    "discover": "adapter.cli.discover:run",
    "sim": "adapter.cli.sim:run",
    "import": "adapter.cli.files:run_import",
    "export": "adapter.cli.results:run_export",
    "report": "adapter.cli.results:run_report",
    "recover": "adapter.cli.files:run_recover",
    "info": "adapter.cli.files:run_info",
    "experiment": "adapter.experiments.command:run",
    "bench": "adapter.experiments.benchmark:run",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    args = build_parser().parse_args(arguments)
    warnings.showwarning = _show_warning  # type: ignore[assignment]
    try:
        args.check(args)
        module, _, function = RUN_BY[args.command].partition(":")
        return int(getattr(import_module(module), function)(args))
    except MeansError as error:
        console.print(f"[red]error:[/] {error}", soft_wrap=True)
        return EXIT_NO_MEANS
    except (DriverError, ValueError, OSError) as error:
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
