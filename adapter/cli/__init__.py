"""The command `adapter`: the only room that builds drivers, simulators and processes."""

from __future__ import annotations

import os

# Matrices here are small: threads would only cost time, and sums in another order other bits.
# Read by the libraries when they are loaded, hence before anything else is imported.
for _library in ("OMP", "OPENBLAS", "MKL"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

from adapter.cli.main import main  # noqa: E402

__all__ = ["main"]
