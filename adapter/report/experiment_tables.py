"""Tables of the experiments' page: the paper's figures beside ours, and the learners."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adapter.experiment.results import AtlasResults, Learned, Stated
from adapter.report.experiment_words import (
    SETS,
    ours_text,
    percent,
    scientific,
    sentences,
    with_unit,
)
from adapter.report.tables import Table
from adapter.report.words import JOIN, NARROW, NOTHING

NOT_STATED = "not stated"


def stated_table(items: Sequence[Stated]) -> Table | None:
    """What the paper states, what we measured, what differs; None without any."""
    rows = [[item.what, item.paper or NOT_STATED, ours_text(item), item.note] for item in items]
    return Table(["", "Paper states", "We measured", "Remark"], rows) if rows else None


def learner_table(atlas: AtlasResults) -> Table | None:
    """A row per learner and set: errors, and how long it trained; None without any."""
    if not atlas.learners:
        return None
    heads = ["Learner", "Joints", "Training", "Set", "Median", "99th percentile", "RMSE"]
    units = ["", "", "", "", "eq. 20", "eq. 20", "by joint, N m"]
    rows = []
    for learner in atlas.learners:
        known = [s for s in SETS if s in learner.median or s in learner.rmse] or [NOTHING]
        for name in known:
            first = name == known[0]
            row = [learner.name, _joints(learner), with_unit(learner.train_s, "s", 3)]
            rows.append(
                [
                    *(row if first else [""] * len(row)),
                    name,
                    percent(learner.median.get(name)),
                    percent(learner.p99.get(name)),
                    _spread(learner.rmse.get(name)),
                ]
            )
    return Table(heads, rows, units)


def tuning_rows(atlas: AtlasResults) -> list[tuple[str, str, str]]:
    """Name, title and how it was tuned, of each learner."""
    return [(x.name, x.title.rstrip("."), sentences(x.tuning)) for x in atlas.learners]


def _joints(learner: Learned) -> str:
    known = {len(x) for x in (*learner.rmse.values(), *learner.boxes.values())}
    return str(max(known)) if known else NOTHING


def _spread(values: np.ndarray | None) -> str:
    """Smallest to largest over the joints."""
    finite = np.asarray([] if values is None else values, dtype=float)
    finite = finite[np.isfinite(finite)]
    if not len(finite):
        return NOTHING
    low, high = scientific(float(finite.min())), scientific(float(finite.max()))
    return low if low == high else f"{low}{NARROW}–{JOIN}{NARROW}{high}"
