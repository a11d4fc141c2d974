"""Where a model and recordings disagree, which effect is missing, and the model with it.

`find_gap` takes recordings through the stations once, left to right; `Monitor` watches for the
same while an arm is learned. What is asked for is loaded then.

>>> from adapter.gap import find_gap
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # for type checkers and editors; at run time `__getattr__` finds the same
    from adapter.gap.monitor import Monitor
    from adapter.gap.result import Finding, GapResult, Leftover
    from adapter.gap.workflow import GapSettings, find_gap
    from adapter.screening.screen import RecordingFault, RecordingRefused

_FROM = {
    "Finding": "gap.result",
    "GapResult": "gap.result",
    "GapSettings": "gap.workflow",
    "Leftover": "gap.result",
    "Monitor": "gap.monitor",
    "RecordingFault": "screening.screen",
    "RecordingRefused": "screening.screen",
    "find_gap": "gap.workflow",
}

__all__ = [
    "Finding",
    "GapResult",
    "GapSettings",
    "Leftover",
    "Monitor",
    "RecordingFault",
    "RecordingRefused",
    "find_gap",
]


def __getattr__(name: str) -> Any:
    if name not in _FROM:
        raise AttributeError(f"module 'adapter.gap' has no '{name}'")
    return getattr(import_module(f"adapter.{_FROM[name]}"), name)
