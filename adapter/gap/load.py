"""What the hand carries: the load of a recording, as the numbers that a robot asks for.

The payload's ten parameters, friction, offsets and motor inertia of every joint, and the errors of
the documented inertias are fitted together by the search's own least squares (`fit.Fit`: smoothed
motion, coloured noise, priors). With a second recording without the load all but the load is
common to both, so that the arm's own errors cancel.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from adapter.gap.fit import Fit, honest_covariance, place_of, under_own_noise
from adapter.gap.hand import hand_frame
from adapter.gap.long_recording import LongRecording, Survey, is_long, sampling_words
from adapter.gap.nominal import nominal_fit
from adapter.gap.real_arm import SHARES, real_arm
from adapter.gap.signals import RATE_HZ, Recorded
from adapter.gap.weighed import moments_of
from adapter.model.inertia import body_from_theta, move_theta, six_from_tensor, tensor_from_six
from adapter.model.self_model import FixedFrame, SelfModel
from adapter.model.spatial import Array
from adapter.screening.screen import (
    MOVES_DQ,
    Judged,
    cleaned,
    judged,
    moving_joints,
    of_this_robot,
    silent,
    smoothed_rows,
)
from adapter.screening.timing import lateness
from adapter.signals.matching import present
from adapter.signals.validation import GRID_S
from drivers.files.mcap import Log

DOCUMENTED_STD, SHARED_STD = 0.02, 0.2  # of the inertias: alone, and with a log without the load
MOVES_S = 1.0  # of motion, or the arm hardly moves
SHOWN = 3.0  # standard deviations: what is smaller is not there, or not shown
COM_M, INERTIA_SHARE = 0.05, 0.5  # standard deviations above which a number is not shown
STEP, STEP_S = 1e-6, 1.0 / RATE_HZ
DATES = tuple(np.linspace(0.1, 0.9, 9))  # shares of a recording at which the load may change
CLEAR, LEAST_CHANGE_KG = 6.0, 0.05  # standard deviations of a change; what is less is not told


@dataclass(frozen=True, eq=False)
class HandLoad:
    """A body at the hand, in the axes of a frame that rides there.

    Attributes:
        mass: kg; com: (3,) m; inertia: (3, 3) about the centre, kg m², one that a body may have.
        mass_std, com_std, inertia_std: standard deviations, of the same shapes.
        frame: name of the frame.
        left_nm: (n,) rms torque error with the load, N m; before_nm: without.
        notes: what to know of it, a sentence each.
    """

    mass: float
    com: Array
    inertia: Array
    mass_std: float
    com_std: Array
    inertia_std: Array
    frame: str = ""
    before_nm: Array = field(default_factory=lambda: np.zeros(0))
    left_nm: Array = field(default_factory=lambda: np.zeros(0))
    notes: tuple[str, ...] = ()

    @property
    def is_there(self) -> bool:
        """Whether it weighs more than the doubt."""
        return self.mass > SHOWN * self.mass_std

    @property
    def com_shown(self) -> bool:
        """Whether the data tell where its centre is."""
        return self.is_there and bool(self.com_std.max() < COM_M)

    @property
    def inertia_shown(self) -> bool:
        """Whether the data tell its inertia."""
        size = float(np.diagonal(self.inertia).max())
        return self.com_shown and bool(self.inertia_std.max() < INERTIA_SHARE * size)


def find_load(
    log: Log,
    model: SelfModel,
    empty: Log | None = None,
    frame: str | None = None,
    inertia_prior: float | None = None,
) -> HandLoad:
    """The load of a recording.

    Args:
        log: with the load from the first sample on, in motion or at rest.
        model: of the arm; its tool is part of it and not of the load.
        empty: of the same arm without the load; all that is common is not of the load then.
        frame: in whose axes the load is told, see `hand_frame`.
        inertia_prior: by which share the model's inertias may be off, one standard deviation.

    Raises:
        Refusal: another robot, too few samples, units, sign or order of the signals.
        ModelError: no such frame.
    """
    logs, notes = [log] if empty is None else [log, empty], []
    for one in logs:
        model, said = present(model, one.joint_names, one.path.name)
        notes += [*one.warnings, *said]
    riding = hand_frame(model, frame)
    if inertia_prior is None:
        inertia_prior, shares = (DOCUMENTED_STD, SHARES) if empty is None else (SHARED_STD, (1.0,))
    else:
        shares = (1.0,)
    taken = [_taken(one, model) for one in logs]
    notes += [note for x in taken for note in x.notes]
    start = nominal_fit(
        [x.recorded for x in taken], model, inertia_prior, max(x.period_s for x in taken)
    )
    moving = {j for s in start.recordings for j in moving_joints(s.motion.q, s.motion.dq, STEP_S)}
    arm = real_arm(start, sorted(moving & start.heard), (0,), shares)
    whole = taken[0].recorded
    if isinstance(whole, LongRecording) and empty is None:
        known = moments_of(arm.fit, whole)
        arm = replace(arm, fit=arm.fit.at(known.x), known=known)
    fit, at = arm.fit, place_of(arm.fit, 0)
    turn = fit.named[0].candidate.theta
    theta = fit.coefficients[at] @ turn
    covariance = turn.T @ honest_covariance(fit, arm.known)[np.ix_(at, at)] @ turn
    notes += _changed(fit) if taken[0].moves else []
    notes += sampling_words([x.recorded for x in taken])
    before, left = (np.sqrt(np.mean(x.model.residual(0) ** 2, axis=0)) for x in (start, fit))
    found = load_of(theta, covariance, riding)
    return replace(found, before_nm=before, left_nm=left, notes=tuple(dict.fromkeys(notes)))


class _Taken(NamedTuple):
    """A recording as it is fitted, whether the arm moves in it, and notes."""

    recorded: Recorded
    moves: bool
    period_s: float
    notes: list[str]


def _taken(log: Log, model: SelfModel) -> _Taken:
    """Raises RecordingRefused."""
    if not is_long(log):
        own, clock, said = cleaned(log, model)
        moves, torque, more = _judged(own, model)
        recorded = Recorded.of(torque.in_time(own), lateness(clock)).cut()
        return _Taken(recorded, moves, clock.period_s, own.warnings + said + more)
    survey = Survey.of(of_this_robot(log, model))
    part, _, said = cleaned(survey.busiest(log), model)
    moves, torque, more = _judged(part, model)
    long = LongRecording.through(survey.in_time(torque), log.path.name)
    return _Taken(long, moves, survey.clock.period_s, log.warnings + said + more)


def _judged(log: Log, model: SelfModel) -> tuple[bool, Judged, list[str]]:
    """Whether the arm moves, its torques, and notes. Refuses another unit, sign or order.

    Asked of the arm without what is fitted: a load of 90 kg explains N cm.
    """
    smoothed = smoothed_rows(log)
    if float((np.abs(smoothed[1]).max(axis=1) > MOVES_DQ).sum()) * GRID_S < MOVES_S:
        rests = ["the arm hardly moves: static friction in its joints counts as load"]
        return False, Judged(), rests
    dead = silent(log, model.tree.joint_names)
    torque = judged(log, model, smoothed)
    return True, torque, dead + torque.notes


def _changed(fit: Fit) -> list[str]:
    """That the hand's load, the first effect of a fit, clearly is another from some time on."""
    t, found = fit.recordings[0].t, (CLEAR, 0.0, 0.0)
    change = replace(fit.named[0], x=np.zeros(len(fit.named[0].x)), recording=0)
    for share in DATES:
        at = float(t[0] + share * (t[-1] - t[0]))
        trial = fit.with_named([*fit.named, replace(change, interval_s=(at, np.inf))])
        trial, known = under_own_noise(trial)
        place = place_of(trial, len(fit.named))[0]
        mass = float(trial.named[-1].x[0])
        clear = abs(mass) / float(np.sqrt(honest_covariance(trial, known)[place, place]))
        if abs(mass) > LEAST_CHANGE_KG:
            found = max(found, (clear, at, mass))
    clear, at, mass = found
    if not at:
        return []
    return [
        f"the hand holds some {abs(mass):.2g} kg {'more' if mass > 0.0 else 'less'} from about "
        f"{at:.0f} s on, and what is told is of the whole recording; `adapter gap` dates it, "
        "`adapter replay` weighs what is held at the end"
    ]


def _in_frame(theta: Array, covariance: Array, frame: FixedFrame) -> tuple[Array, Array]:
    """Ten parameters of a load and their covariance in a frame instead of its link's."""
    back = frame.rotation.T, -frame.rotation.T @ frame.position
    turn = move_theta(np.eye(10), *back)  # row i: of a unit of parameter i
    return theta @ turn, turn.T @ covariance @ turn


def _body(theta: Array) -> Array:
    """Mass, centre and the six numbers of the inertia about it (10,)."""
    mass, com, inertia = body_from_theta(theta)
    return np.r_[mass, com, six_from_tensor(inertia)]


def load_of(theta: Array, covariance: Array, frame: FixedFrame) -> HandLoad:
    """A load from its ten parameters (10,) about the last link's origin, and how well it is known.

    Args:
        covariance: (10, 10) of the parameters; frame: in whose axes the load is told.
    """
    theta, covariance = _in_frame(theta, covariance, frame)
    mass, com, inertia = body_from_theta(theta)
    steps = STEP * np.diag(np.sqrt(np.diagonal(covariance)))
    slopes = np.array([(_body(theta + d) - _body(theta - d)) / (2.0 * d.max()) for d in steps])
    std = np.sqrt(np.diagonal(slopes.T @ covariance @ slopes))
    return HandLoad(
        float(mass),
        com,
        _possible(inertia),
        float(std[0]),
        std[1:4],
        tensor_from_six(std[4:]),
        frame.name,
    )


def _possible(inertia: Array) -> Array:
    """The nearest inertia (3, 3) about its centre that a body may have."""
    values, axes = np.linalg.eigh(0.5 * np.trace(inertia) * np.eye(3) - inertia)
    spread = (axes * np.maximum(values, 0.0)) @ axes.T
    return np.asarray(np.trace(spread) * np.eye(3) - spread)
