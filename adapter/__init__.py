"""An arm that learns its own body: kinematics λ, inertias θ, and what a model of it lacks.

Everything here works on recordings (files) and on arrays; nothing is loaded before it is used.

>>> import adapter
>>> panda = adapter.load_model("panda")
>>> log = adapter.read_log("recordings/panda_nominal_6s.mcap")
>>> adapter.learn(log, panda, every=10).lam.shape
(7, 6)
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from adapter.shadowed import keep_apart, own_name

if TYPE_CHECKING:  # for type checkers and editors; at run time `__getattr__` finds the same
    from adapter.discovery import Discovery
    from adapter.effects.kept import with_kept
    from adapter.gap.result import GapResult
    from adapter.model.self_model import SelfModel
    from adapter.realtime import Snapshot, SnapshotReader
    from adapter.runs.library import (
        FilteredSignals,
        Learner,
        LearnResult,
        discover,
        export,
        filtered,
        find_gap,
        inverse_dynamics,
        keep_law,
        learn,
        load_model,
        make_log,
        read_log,
        regressor,
    )
    from adapter.signals.told import Told
    from drivers.files.mcap import Log

keep_apart()  # before anything asks for `drivers` or `sim`

# name -> the module that has it, loaded when the name is first asked for
_FROM = {
    "load_model": "adapter.runs.library",
    "read_log": "adapter.runs.library",
    "make_log": "adapter.runs.library",
    "learn": "adapter.runs.library",
    "Learner": "adapter.runs.library",
    "inverse_dynamics": "adapter.runs.library",
    "regressor": "adapter.runs.library",
    "filtered": "adapter.runs.library",
    "find_gap": "adapter.runs.library",
    "keep_law": "adapter.runs.library",
    "with_kept": "adapter.effects.kept",
    "discover": "adapter.runs.library",
    "export": "adapter.runs.library",
    "SnapshotReader": "adapter.realtime",
    # what they take and return
    "SelfModel": "adapter.model.self_model",
    "Log": "drivers.files.mcap",
    "Told": "adapter.signals.told",
    "LearnResult": "adapter.runs.library",
    "FilteredSignals": "adapter.runs.library",
    "GapResult": "adapter.gap.result",
    "Discovery": "adapter.discovery",
    "Snapshot": "adapter.realtime",
}

__all__ = [
    "Discovery",
    "FilteredSignals",
    "GapResult",
    "LearnResult",
    "Learner",
    "Log",
    "SelfModel",
    "Snapshot",
    "SnapshotReader",
    "Told",
    "discover",
    "export",
    "filtered",
    "find_gap",
    "inverse_dynamics",
    "keep_law",
    "learn",
    "load_model",
    "make_log",
    "read_log",
    "regressor",
    "with_kept",
]


def __getattr__(name: str) -> Any:
    if name not in _FROM:
        raise AttributeError(f"module 'adapter' has no attribute '{name}'")
    value = getattr(import_module(own_name(_FROM[name])), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
