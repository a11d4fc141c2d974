"""The command `adapter`: the only place that builds drivers, simulators and processes."""

from __future__ import annotations

import os
from collections.abc import Sequence

# Matrices here are small: threads would only cost time, and sums in another order other bits.
# Read by the libraries when they are loaded, hence before anything else is imported.
for _library in ("OMP", "OPENBLAS", "MKL"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    from adapter.cli.main import main as run

    return run(arguments)
