"""The first sentences of a run's page, and whether to trust it: checks, each with a verdict.

What changed, and what it is worth; then each check with the numbers behind it, and their limits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from adapter.gap.phrases import numbered
from adapter.gap.words import finding_parts
from adapter.model.self_model import LAMBDA_DOCUMENTATION as DOCUMENTATION
from adapter.model.self_model import LAMBDA_MEASURED, theta_doubt
from adapter.physics.identifiability import SHOWN_ALONE
from adapter.report.gap_tables import tied
from adapter.report.learned_panels import refusal, theta_started
from adapter.report.words import (
    GOALS,
    NARROW,
    NOT_WATCHED,
    capital,
    count,
    is_live,
    is_simulated,
    missed_words,
    not_learned,
    number,
    quantity,
    small,
    spread,
    with_doubt,
)
from adapter.report.worth import BLOCK_S, SLOW, Worth, slow_share, together
from adapter.runs.run_folder import RunData
from adapter.runs.score import TORQUE_GOAL, counted_from
from adapter.signals.validation import rms_of

MANY_LOADS = 3


def headline(data: RunData, worth: Worth) -> list[str]:
    """At most a handful of short sentences, what is worth most first."""
    if why := refusal(data.figures):
        found = [f"Nothing was learned, since the torques are not those of this arm: {why}"]
    else:
        found = [*_lacks(data, worth), *_torque(data, worth), *_tracking(worth)]
        found += [*_loads(data, worth), *_hand(data, worth)]
    real = is_live(data.figures) and not is_simulated(data.figures)  # a simulated arm waits
    late = [f"{capital(missed_words(data.figures))}."] if real else []
    return [*found, *_trouble(data.figures), *late]


def against(figures: Mapping[str, Any]) -> str:
    """What errors of λ are against: "documentation", or the name of the file that was given."""
    return Path(str(figures["lambda"].get("reference") or DOCUMENTATION)).name


def _lacks(data: RunData, worth: Worth) -> list[str]:
    """What the documentation has otherwise, the most first; nothing where it has all of it."""
    parts, bodies, fall = finding_parts(worth.lacks), worth.bodies_nm, worth.torque
    if fall is not None and bodies is not None and (bodies > fall.after).any():
        j = int(np.argmax(bodies))
        size = quantity(bodies[j], data.documented.tree.unit("N m", "N", j), 2)
        parts.insert(0, f"links weigh otherwise, by up to {size} of torque (joint {j + 1})")
    return [f"This arm is not as documented: {'; '.join(map(tied, parts))}."] if parts else []


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
    tree = data.documented.tree
    after = _all_joints(fall.after, fall.after_std, tree.unit("N m", "N"))
    if fall.before is None:
        return [f"The learned model predicts torque to {after} ({fall.seen})."]
    before = _all_joints(fall.before, fall.before_std, tree.unit("N m", "N"))
    if not (fall.better or fall.worse):
        both = f"to {after}, the documentation to {before} ({fall.seen})"
        return [f"The learned model predicts torque as the documentation does: {both}."]
    more = np.square(fall.after) - np.square(fall.before)
    j = int(np.argmin(more) if fall.better else np.argmax(more))  # has most part in it
    first, last = (quantity(x[j], tree.unit("N m", "N", j), 2) for x in (fall.before, fall.after))
    worst = f"joint {j + 1} {first} → {last}"
    verb = "fell" if fall.better else "rose"
    return [
        f"The torque error of all joints {verb} from {before} with the documented model to "
        f"{after} with the learned one ({fall.seen}); {worst}."
    ]


def _all_joints(values: Any, std: Any, unit: str) -> str:
    """All joints together, ± one standard deviation where it is known."""
    size = together(values)
    spread = None if std is None else float(np.sqrt(np.sum((values * std) ** 2))) / max(size, 1e-12)
    return f"{with_doubt(size, spread)} {unit}".replace(" ", NARROW)


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
    if worth.hand_m < 1e-4:
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
        many = f"{new} disagreement{'' if new == 1 else 's'}"
        said.append(f"Something new acts that the learned model does not hold: {many}.")
    return said


GOOD, LOOK, BAD = "good", "look", "bad"  # verdicts
LEFT = "Torque not explained"


@dataclass(frozen=True)
class Check:
    """One reason to trust or to doubt: its verdict, what was looked at, what was seen."""

    verdict: str
    name: str
    words: str


def checks(data: RunData, worth: Worth) -> list[Check]:
    """All that the run allows, in the order in which they matter."""
    figures = data.figures
    found = [_unseen(data, worth), _left(data), _parameters(data), _frames(data)]
    if why := refusal(figures):
        found = [Check(BAD, "Torques of this arm", why)]
    found += [_learner(data), _new(figures), _feedforward(figures), _timing(figures)]
    found.append(_samples(figures))
    return [check for check in found if check is not None]


def _unseen(data: RunData, worth: Worth) -> Check | None:
    """Whether what was learned holds on rows that the fit had not seen."""
    fall = worth.torque
    if fall is None:
        nothing = Check(BAD, "On data not learned from", "nothing to judge by")
        return nothing if theta_started(data) else None
    fit = np.array(data.figures["theta"]["torque_rmse_nm"], float)
    ratio, unit = fall.after / np.maximum(fit, 1e-12), data.documented.tree.unit("N m", "N")
    said = (
        f"the worst joint's torque error, {fall.seen}, is {number(ratio.max(), 2)} times that of "
        f"the fit (joint {int(np.argmax(ratio)) + 1}): {spread(fall.after, unit)} rms by joint"
    )
    if fall.worse:
        return Check(BAD, "On data not learned from", f"{said}; worse than the documentation")
    if not data.figures["theta"].get("validation_torque_rmse_nm"):
        said += "; no recording was held out"
    return Check(GOOD if ratio.max() < 1.5 else LOOK, "On data not learned from", said)


def _left(data: RunData) -> Check | None:
    """How much of the torque stays unexplained, and whether it is like noise."""
    left = data.figures["theta"].get("torque_rmse_nm")
    if not left or not theta_started(data):
        return None
    size = rms_of([data.score_signals()[3]]).value
    share = 100.0 * np.array(left) / np.maximum(size, 1e-12)
    unexplained = spread(left, data.documented.tree.unit("N m", "N"))
    said = f"{unexplained} rms by joint, {spread(share, '%')} of the torque that acted"
    slow = slow_share(data)
    if slow is None:
        return Check(LOOK, LEFT, f"{said}; too short to tell whether it is noise")
    j = int(np.argmax(slow))
    most = f"{100.0 * slow[j]:.0f} % of it on joint {j + 1}"
    if slow[j] <= SLOW:
        said += f"; like noise: at most {most} lasts over {BLOCK_S:g} s"
        return Check(GOOD, LEFT, f"{said}; adapter gap holds it against the sensors' own noise")
    which = [int(k) + 1 for k in np.flatnonzero(slow > SLOW)]
    joints = f"joint{'s' if len(which) > 1 else ''} {numbered(which)}"
    most = f"{'up to ' if len(which) > 1 else ''}{most}"
    why = "something acts that no learned effect explains"
    said += f"; not noise on {joints}: {most} lasts over {BLOCK_S:g} s, {why}"
    return Check(LOOK, LEFT, said)


def _parameters(data: RunData) -> Check | None:
    theta = data.figures["theta"]
    if not theta_started(data):
        said = "θ was not learned: it waits until λ has settled, and λ had not"
        return Check(BAD, "Inertias and friction", said)
    rank, every = theta.get("base_parameters"), 10 * data.n
    alone = data.theta_shown > SHOWN_ALONE
    said = f"torques show {rank} combinations of {every} inertial parameters, "
    said += f"{int(alone.sum())} of them on their own"
    at, goal = theta.get("converged_s"), f"{TORQUE_GOAL:g} × the error of batch least squares"
    if at is None:
        if not theta.get("settled", True):
            doubt = theta_doubt(data.model) or "it had not converged"
            return Check(BAD, "Inertias and friction", f"{said}; θ: {doubt}")
        said += f"; the prequential error did not stay within {goal}"
        return Check(LOOK, "Inertias and friction", said)
    after = quantity(at, "s", 2)
    said += f"; within {goal} from {after} after {counted_from(data.figures)} on"
    return Check(GOOD, "Inertias and friction", said)


def _frames(data: RunData) -> Check:
    schema = data.figures["lambda"]
    rank, every = schema.get("identifiable_rank"), 6 * data.n
    start, at = counted_from(data.figures), schema.get("converged_s")
    goal = against(data.figures) if data.reference is not None else "documentation"
    turn, shift = schema.get("rotation_error_rad"), schema.get("position_error_m")
    off = ""
    if data.reference is not None and turn and shift and None not in [*turn, *shift]:
        worst = f"{small(1e3 * max(turn), 'mrad')} and {small(1e3 * max(shift), 'mm')}"
        what = "the documentation" if goal == "documentation" else goal
        off = f", off {what} by {worst} on the worst joint"
    shown = f"motion shows {rank} of {every} directions of λ"
    if schema.get("source") == LAMBDA_MEASURED:
        when = f"did not stay within {GOALS}"
        if at is not None:
            when = f"within {GOALS} from {quantity(at, 's', 2)} after {start} on"
        verdict = LOOK if at is None else GOOD
        return Check(verdict, "Where the joints are", f"measured; {shown}; {when}{off}")
    if at is None:
        said = f"λ was to reproduce the documentation but did not stay within {GOALS}{off}"
        return Check(BAD, "Where the joints are", said)
    said = (
        f"reproduces the documentation ({shown}; after {quantity(at, 's', 2)}{off}): no "
        "measurement of this arm, which needs sensors on its links"
    )
    return Check(GOOD, "Where the joints are", said)


def _learner(data: RunData) -> Check | None:
    restarts = data.figures["lambda"].get("restarts")
    if not restarts:
        return None
    said = f"joints' frames started anew {restarts} time{'' if restarts == 1 else 's'}, out of "
    return Check(GOOD, "On its way", f"{said}wrong valleys of the error")


def _new(figures: Mapping[str, Any]) -> Check | None:
    new = figures.get("disagreements")
    if new is None:
        return Check(LOOK, "New disagreements", NOT_WATCHED)
    if left := not_learned(figures):
        return Check(BAD, "New disagreements", f"{len(left)}, listed among the warnings")
    if new:
        said = f"{len(new)}, of a load that the model holds since it was noticed"
        return Check(GOOD, "New disagreements", said)
    return Check(GOOD, "New disagreements", "none: nothing new began during the run")


def _feedforward(figures: Mapping[str, Any]) -> Check | None:
    """That the learned model was to help the controller and did not get to."""
    tracking = figures.get("tracking") or {}
    helped = (tracking.get("feedforward") or {}).get("samples")
    if figures.get("feedforward") != "learned" or helped or "feedforward" not in tracking:
        return None
    said = "asked for, but no converged estimate reached the controller before the run ended"
    return Check(LOOK, "Feed-forward", said)


def _timing(figures: Mapping[str, Any]) -> Check | None:
    """Deadlines that were missed, and by whose fault."""
    if not is_live(figures):
        return None
    timing = figures.get("timing") or {}
    missed = figures.get("missed_deadlines") or 0
    deadlines = max(int(figures["samples"]) + missed, 1)
    said = missed_words(figures)
    loop, plant = (timing.get(key) or {} for key in ("loop_us", "plant_us"))
    if loop.get("p50") is not None:
        said += f"; our work takes {quantity(loop['p50'], 'µs')} a tick, p99 "
        said += quantity(loop.get("p99"), "µs")
    if plant.get("p50") is not None:
        said += (
            f", beside it the physics of the simulated arm {quantity(plant['p50'], 'µs')}, p99 "
            f"{quantity(plant.get('p99'), 'µs')}, which waits where it is late: nothing is lost"
        )
    share = missed / deadlines
    bad = share >= 1e-2 and not is_simulated(figures)
    verdict = GOOD if share < 1e-3 else BAD if bad else LOOK
    return Check(verdict, "Timing", said)


def _samples(figures: Mapping[str, Any]) -> Check:
    samples, learned = int(figures["samples"]), int(figures["learned"])
    said = f"{count(learned)} of {count(samples)} learned from"
    if learned > samples:  # it went on from a checkpoint
        said = f"{count(learned)} learned from, most before this run's {count(samples)}"
    lost = figures.get("unrecorded") or 0
    if lost:
        said += f"; {count(lost)} are missing in the recording"
    gaps = len(figures.get("gaps") or [])
    if gaps:
        said += f"; {gaps} gap{'' if gaps == 1 else 's'} in the stamps"
    bad = not learned or lost or learned < 0.95 * samples
    return Check(LOOK if bad and learned else BAD if bad else GOOD, "Samples", said)
