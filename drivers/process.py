"""A process of a driver's own, and the memory that the two share."""

from __future__ import annotations

import ctypes
import mmap
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self


class Block(ctypes.Structure):
    """Memory that two processes see; what derives from it names its words.

    Each aligned word is written as a whole. Words that are written one after the other may be
    mixed with the next ones' where somebody reads them meanwhile.
    """

    @classmethod
    def create(cls, more: int = 0) -> tuple[int, Self]:
        """Zeros, with `more` bytes behind them, and the descriptor that a child inherits."""
        fileno = os.memfd_create(cls.__name__)
        os.truncate(fileno, ctypes.sizeof(cls) + more)
        return fileno, cls.of(fileno)

    @classmethod
    def of(cls, fileno: int) -> Self:
        """The same from its descriptor; mapped for as long as this object is there."""
        return cls.from_buffer(mmap.mmap(fileno, 0))


def start_module(
    module: str, told: str, filenos: Sequence[int], **how: Any
) -> subprocess.Popen[bytes]:
    """Run a module of this package in a process of its own; the text `told` is its argument.

    Args:
        module: found wherever this package was found.
        told: on its command line.
        filenos: descriptors that it inherits.
        how: more for `subprocess.Popen`; what it says comes through a pipe.

    Raises OSError.
    """
    root = str(Path(__file__).resolve().parents[1])
    path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.Popen(
        [sys.executable, "-P", "-m", module, told],
        stdout=subprocess.PIPE,
        pass_fds=filenos,
        env={**os.environ, "PYTHONPATH": path},
        **how,
    )
