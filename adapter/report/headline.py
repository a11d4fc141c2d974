"""The first sentences of a run's page: what changed, and what it is worth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from adapter.model.self_model import LAMBDA_DOCUMENTATION as DOCUMENTATION
from adapter.report.learned_panels import refusal, theta_started
from adapter.report.words import (
    NARROW,
    capital,
    is_live,
    missed_words,
    not_learned,
    quantity,
    with_doubt,
)
from adapter.report.worth import Worth, together
from adapter.runs.run_folder import RunData

MOVED_M = 1e-4  # of the hand, from which a measured λ is said to differ from the documentation
MANY_LOADS = 3


def headline(data: RunData, worth: Worth) -> list[str]:
    """At most a handful of short sentences, what is worth most first."""
    if why := refusal(data.figures):
        found = [f"Nothing was learned, since the torques are not those of this arm: {why}"]
    else:
        found = [*_tracking(worth), *_torque(data, worth), *_loads(data, worth)]
        found += _hand(data, worth)
    late = [f"{capital(missed_words(data.figures))}."] if is_live(data.figures) else []
    return [*found, *_trouble(data.figures), *late]


def against(figures: Mapping[str, Any]) -> str:
    """What errors of λ are against: "documentation", or the name of the file that was given."""
    return Path(str(figures["lambda"].get("reference") or DOCUMENTATION)).name


def _tracking(worth: Worth) -> list[str]:
    fall = worth.tracking
    if fall is None or fall.before is None:
        return []
    before, after = (1e3 * together(x) / np.sqrt(len(x)) for x in (fall.before, fall.after))
    return [
        f"The arm follows its path to {quantity(after, 'mrad', 2)} instead of "
        f"{quantity(before, 'mrad')} (rms, all joints), with the feed-forward of the {fall.seen}."
    ]


def _torque(data: RunData, worth: Worth) -> list[str]:
    fall = worth.torque
    if fall is None:
        if not theta_started(data):
            return ["Torque was not learned, because λ (where the joints' frames are) was not."]
        return ["Too little was learned from to say what the learned model is worth."]
    after = _all_joints(fall.after, fall.after_std)
    if fall.before is None:
        return [f"The learned model predicts torque to {after} ({fall.seen})."]
    before = _all_joints(fall.before, fall.before_std)
    if not (fall.better or fall.worse):
        return [
            f"The learned model predicts torque as the documentation does: to {after}, the "
            f"documentation to {before} ({fall.seen})."
        ]
    more = np.square(fall.after) - np.square(fall.before)
    j = int(np.argmin(more) if fall.better else np.argmax(more))  # has most part in it
    first, last = (quantity(x[j], "N m", 2) for x in (fall.before, fall.after))
    worst = f"joint {j + 1} {first} → {last}"
    verb = "fell" if fall.better else "rose"
    return [
        f"The torque error of all joints {verb} from {before} with the documented model to "
        f"{after} with the learned one ({fall.seen}); {worst}."
    ]


def _all_joints(values: Any, std: Any) -> str:
    """All joints together, ± one standard deviation where it is known."""
    size = together(values)
    spread = None if std is None else float(np.sqrt(np.sum((values * std) ** 2))) / max(size, 1e-12)
    return f"{with_doubt(size, spread)} N m".replace(" ", NARROW)


def _loads(data: RunData, worth: Worth) -> list[str]:
    said = [
        f"A load of {with_doubt(mass, std)} kg was noticed at the hand "
        f"{quantity(at_s, 's')} after the first motion."
        for at_s, mass, std in worth.loads
    ]
    if held := data.figures["theta"].get("held"):
        mass = with_doubt(held["m"], held["m_std"])
        said.insert(0, f"The hand carries {mass} kg beside the documented arm from the start.")
    said = [text.replace(" kg", f"{NARROW}kg") for text in said]
    more = len(said) - MANY_LOADS
    return [*said[:MANY_LOADS], *([f"{more} more changes of load follow."] if more > 0 else [])]


def _hand(data: RunData, worth: Worth) -> list[str]:
    """What measured geometry says; nothing where λ only reproduces the documentation."""
    if worth.hand_m is None:
        return []
    std = data.figures["lambda"].get("std") or {}
    turn, shift = std.get("rotation_rad"), std.get("position_m")
    known = ""
    if turn and shift and None not in [*turn, *shift]:
        known = (
            f", each joint's frame known to {quantity(1e3 * max(turn), 'mrad', 2)} and "
            f"{quantity(1e3 * max(shift), 'mm', 2)} (one standard deviation, worst joint)"
        )
    if worth.hand_m < MOVED_M:
        return [f"The joints are where the documentation puts them{known}."]
    return [
        f"The arm is not built as documented: its hand stands "
        f"{quantity(1e3 * worth.hand_m, 'mm', 2)} from where the documentation puts it "
        f"(rms over the run){known}."
    ]


def _trouble(figures: Mapping[str, Any]) -> list[str]:
    fault = figures.get("fault")
    new = len(not_learned(figures))
    said = [f"The run ended early: {fault}."] if fault else []
    if figures["theta"].get("started_s") is not None and not figures["theta"].get("settled", True):
        said.append("What the links weigh (θ) had not converged: do not use this model yet.")
    if not (figures.get("torques") or {}).get("judged", True):
        said.append("Too little moved to tell whether the torques are this arm's.")
    if new:
        said.append(
            f"Something new acts that the learned model does not hold: {new} "
            f"disagreement{'' if new == 1 else 's'}."
        )
    return said
