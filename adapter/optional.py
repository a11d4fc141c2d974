"""Libraries that only some commands need, each in an extra: loaded, or missed in one sentence."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from adapter.errors import MeansError

EXTRAS = {  # module -> what it is called, and the extra that brings it
    "coal": ("coal", "motion"),
    "cyclonedds": ("Eclipse Cyclone DDS", "ros"),
    "distributed": ("Dask distributed", "cluster"),
    "foxglove": ("foxglove-sdk", "live"),
    "fsspec": ("fsspec", "cluster"),
    "gymnasium": ("Gymnasium", "gymnasium"),
    "mujoco": ("MuJoCo", "mujoco"),
    "pxr": ("usd-core", "usd"),
    "pyarrow": ("PyArrow", "tables"),
    "pybullet": ("PyBullet", "sim"),
    "sklearn": ("scikit-learn", "experiment"),
}


def missing(module: str | None) -> str | None:
    """What to do where a module is not installed; None where it is of no extra."""
    if module is None or module.split(".")[0] not in EXTRAS:
        return None
    name, extra = EXTRAS[module.split(".")[0]]
    return f"{name} is not installed: pip install 'panda-adapter[{extra}]'"


def load(module: str) -> Any:
    """A module of `EXTRAS`, loaded without what it prints by itself. Raises MeansError."""
    if sys.modules.get(module) is not None:
        return sys.modules[module]
    try:
        with _unheard():
            return import_module(module)
    except ModuleNotFoundError as error:
        sentence = missing(error.name)
        if sentence is None:
            raise
        raise MeansError(sentence) from None


@contextmanager
def _unheard() -> Iterator[None]:
    """What C code prints meanwhile goes nowhere: PyBullet tells when it was built."""
    flush = ctypes.CDLL(None).fflush
    for stream in filter(None, (sys.stdout, sys.stderr)):
        stream.flush()
    flush(None)
    kept = {number: os.dup(number) for number in (1, 2)}
    try:
        with open(os.devnull, "wb") as nowhere:
            for number in kept:
                os.dup2(nowhere.fileno(), number)
        yield
    finally:
        flush(None)
        for number, copy in kept.items():
            os.dup2(copy, number)
            os.close(copy)
