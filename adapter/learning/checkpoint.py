"""A learner's whole state in a file, so that a run can go on where another ended."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from adapter.errors import SettingsError
from adapter.learning.learner import OnlineLearner
from adapter.learning.schema_kernels import MotionMoments
from adapter.learning.theta_kernels import Moments
from adapter.model.model_file import whole_file
from adapter.signals.records import LinkMotionKind
from drivers.files.bounded import read_arrays

VERSION = 8
MORE = "schema.more."  # before the names of what some kinds of schema hold

# What each part would not be the same learner without. Everything else follows from the settings.
_STATE = {
    "": (
        *("learned", "refused", "stamp_ns", "theta_started_ns", "theta_converged", "rebuilds"),
        *("_held_from", "_held_to", "_R0", "_p", "_alarm_ns", "_shadow_at", "_since_update"),
        *("_judged", "_rates_known"),
    ),
    "schema": (
        *("R0", "p", "start_lam", "kind", "updates", "information", "identifiable", "certain"),
        *("_inverse", "_may_move", "_distance", "rank", "ranks", "_calm_ns", "_looked_ns"),
        *("converged", "_rough", "_then"),
    ),
    "schema.check": ("misfit", "passed_at", "passed_rank", "turn", "restarts"),
    "schema.moments": MotionMoments._fields,
    "theta": (
        *("x", "mean", "th", "count", "prior", "prior_rhs", "_ranges", "floor", "floor_count"),
        *("spare_in_use", "updates", "effect_spread", "body_spread", "model_variance", "shapes"),
        "rests",
    ),
    "theta.rows": ("place", "share", "base_place"),
    "theta.moments": Moments._fields,
    "theta.newest": ("A", "C"),
    "_shadow": ("A", "C", "counts"),
    "adam": ("first", "second", "rate"),
    "known": ("clock", "memory"),
    "rates": ("rows", "tau", "stamps", "marks", "bends"),
    "change": ("recent", "level", "samples", "_peaks", "_block", "_block_samples", "_armed_at"),
    "schema_trace": ("_rows", "_used", "_offers", "stride"),
    "theta_trace": ("_rows", "_used", "_offers", "stride"),
    "score_trace": ("_rows", "_used", "_offers", "stride"),
}

_NEEDED = (".held", ".changes", "adam.steps")
_FINITE = ("schema.R0", "schema.p", "theta.x", "theta.th", "adam.first", "adam.second")


def save_checkpoint(learner: OnlineLearner, path: str | Path, *, sync: bool = True) -> None:
    """Write a learner's state; an existing file is replaced in one go, or not at all.

    With `sync` it is on the disk afterwards, safe from a power cut and not only from a kill.
    """
    arrays: dict[str, Any] = {"version": VERSION, "about": _about(learner)}
    for part, names in _STATE.items():
        owner = attrgetter(part)(learner) if part else learner
        for name in names if owner is not None else ():
            value = getattr(owner, name)
            if value is not None:
                arrays[f"{part}.{name}"] = value
    for name, state in learner.schema.more_state().items():
        arrays[f"{MORE}{name}"] = state
    size = len(learner._held)
    rows = np.arange(learner._held_from, learner._held_to) % size
    arrays[".held"] = learner._held[rows]
    arrays[".changes"] = np.array(learner.changes, dtype=np.int64)
    arrays["adam.steps"] = learner.adam.steps
    with whole_file(Path(path)) as place, place.open("wb") as file:
        np.savez(file, **arrays)
        file.flush()
        if sync:
            os.fsync(file.fileno())


def load_checkpoint(learner: OnlineLearner, path: str | Path) -> None:
    """Put a fresh learner into the state of a file.

    Raises:
        SettingsError: not a checkpoint, or one of another tree or other settings.
    """
    try:
        arrays = read_arrays(path)
    except (OSError, ValueError) as error:
        raise SettingsError(f"{path}: cannot be read as a checkpoint: {error}") from error
    if int(arrays.get("version", -1)) != VERSION:
        raise SettingsError(f"{path}: not a checkpoint of version {VERSION}")
    if str(arrays.get("about")) != _about(learner):
        both = f"{arrays.get('about')}; here: {_about(learner)}"
        raise SettingsError(f"{path}: is of another robot or other learner settings: {both}")
    lacking = [key for key in (*_NEEDED, *_FINITE) if key not in arrays]
    if lacking:
        raise SettingsError(f"{path}: the checkpoint lacks '{lacking[0]}'")
    for key in _FINITE:
        if arrays[key].dtype.kind not in "fiub" or not np.isfinite(arrays[key]).all():
            raise SettingsError(f"{path}: '{key}' of the checkpoint holds what is no finite number")
    learner._shadow = learner.theta.empty_moments() if "_shadow.A" in arrays else None
    for part, names in _STATE.items():
        owner = attrgetter(part)(learner) if part else learner
        for name in names if owner is not None else ():
            value = arrays.get(f"{part}.{name}")
            if value is None:
                setattr(owner, name, None)
            elif value.ndim and isinstance(getattr(owner, name), np.ndarray):
                getattr(owner, name)[...] = value  # ADAM and the parts share their memory
            else:
                setattr(owner, name, value if value.ndim else value.item())
    learner.schema.kind = LinkMotionKind(learner.schema.kind)
    more = {key.removeprefix(MORE): x for key, x in arrays.items() if key.startswith(MORE)}
    learner.schema.take_state(more)
    size = len(learner._held)
    learner._held[np.arange(learner._held_from, learner._held_to) % size] = arrays[".held"]
    learner.changes[:] = arrays[".changes"].tolist()
    learner.adam.steps = int(arrays["adam.steps"])


def _about(learner: OnlineLearner) -> str:
    settings = dataclasses.asdict(learner.settings)
    about: dict[str, Any] = {"parent": learner.tree.parent, "settings": settings}
    if learner.given:
        about["effects"] = [
            [a.effect.name, a.joint + 1, _plain(a.values), _plain(a.std)] for a in learner.given
        ]
    return json.dumps(about, sort_keys=True)


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters as JSON holds them."""
    return {key: np.asarray(value, dtype=float).tolist() for key, value in values.items()}
