"""Compiling with numba, as everything in this package does it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

from numba import njit

F = TypeVar("F", bound=Callable[..., object])


def compiled(function: F) -> F:
    """Compile when first called, and keep that on disk.

    What is kept is named after the module, too: it refers to classes of this package by name, and
    where somebody else's module is called `sim` this package has another one.
    """
    function.__qualname__ = f"{function.__module__}.{function.__qualname__}"
    return cast(F, njit(cache=True)(function))
