"""What the hand carries: the load of a recording, as the numbers that a robot asks for.

The payload's ten parameters, friction, offsets and motor inertia of every joint, and the errors of
the documented inertias are fitted together by the search's own least squares (`fit.Fit`: smoothed
motion, coloured noise, priors). With a second recording without the load all but the load is
common to both, so that the arm's own errors cancel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from adapter.effects.active import active_effects
from adapter.effects.base import Effect, Template
from adapter.effects.catalogue import HELD, LEARNED, REAL_ARM_EFFECTS
from adapter.errors import ModelError
from adapter.gap.candidates import Candidate
from adapter.gap.evidence import ORDER, Carried
from adapter.gap.fit import TIMING_STD_S, Fit, Model, Named, theta_prior, under_own_noise
from adapter.gap.screen import cleaned, judge_torque, moving_joints
from adapter.gap.signals import Recorded, prepare
from adapter.gap.timing import TIMING_SHARE, lateness
from adapter.model.inertia import body_from_theta, move_theta, six_from_tensor, tensor_from_six
from adapter.model.self_model import FixedFrame, SelfModel
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm
from adapter.signals.matching import present
from adapter.signals.validation import smooth
from drivers.files.mcap import Log

LOAD_STD = (5.0, *[0.5] * 3, *[0.15] * 6)  # of a load: kg, kg m, kg m2
DOCUMENTED_STD, SHARED_STD = 0.03, 0.2  # of the inertias: alone, and with a log without the load
FLANGES = ("tool0", "flange")  # what makers call the face that a tool is bolted to
SHOWN = 3.0  # standard deviations: what is smaller is not there, or not shown
COM_M, INERTIA_SHARE = 0.05, 0.5  # standard deviations above which a number is not shown
STEP = 1e-6
BLOCK = 25  # samples at 25 Hz: errors of the model last so long, noise does not


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


def hand_frame(model: SelfModel, name: str | None = None) -> FixedFrame:
    """The frame in which the load is told: the flange of the last link, where it has one.

    Args:
        name: of the frame or of the last link; where None, the one called as makers call it, else
            the first that rides on the last link, else the link itself.

    Raises:
        ModelError: nothing of that name rides on the last link; names what does.
    """
    last = model.tree.link_names[-1]
    own = FixedFrame(last, "", last, np.eye(3), np.zeros(3))
    riding = [frame for frame in model.frames if frame.parent == last]
    if name is not None:
        for frame in (own, *riding):
            if frame.name == name:
                return frame
        have = ", ".join(frame.name for frame in (own, *riding))
        raise ModelError(f"no frame '{name}' rides on the last link; have: {have}")
    called = [frame for key in FLANGES for frame in riding if frame.name.endswith(key)]
    return (*called, *riding, own)[0]


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
        notes += said
    riding = hand_frame(model, frame)
    share = inertia_prior or (DOCUMENTED_STD if empty is None else SHARED_STD)
    cleaned_logs = [cleaned(one, model) for one in logs]
    notes += [note for *_, said in cleaned_logs for note in said]
    usable = [(one, lateness(clock), clock.period_s) for one, clock, _ in cleaned_logs]
    start = _prepared(usable, model, share)
    fit, known = under_own_noise(start)
    at = slice(fit.dtheta.size + 1, fit.dtheta.size + 11)
    theta = fit.coefficients[at]
    notes += _judged(usable[0][0], model, theta)
    before, left = (np.sqrt(np.mean(x.model.residual(0) ** 2, axis=0)) for x in (start, fit))
    found = load_of(theta, _covariance(fit, known)[at, at], riding)
    return replace(found, before_nm=before, left_nm=left, notes=tuple(dict.fromkeys(notes)))


def _prepared(logs: Sequence[tuple[Log, float, float]], model: SelfModel, share: float) -> Fit:
    """The documented arm on the smoothed recordings, with all that may be beside it at zero.

    `logs` come with how much later dq is than q and with their sample period, s.
    """
    arm = RigidArm.of(model)
    signals = tuple(prepare(Recorded.of(log, late_s), arm) for log, late_s, _ in logs)
    known = active_effects(model.effects, arm.n)
    return Fit(
        Model(signals, np.zeros_like(arm.theta), named=with_a_load(arm.n), known=known),
        theta_prior(arm.theta, share),
        timing_std_s=max(TIMING_STD_S, TIMING_SHARE * max(period_s for *_, period_s in logs)),
    )


def with_a_load(n: int) -> tuple[Named, ...]:
    """A load in the first recording, then what may be beside it on an arm of n joints, at zero."""
    named = [_named(HELD, LOAD_STD, -1, 0)]
    for name in REAL_ARM_EFFECTS:
        effect = LEARNED[name]
        named += [_named(effect, (effect.prior_std,), j, None) for j in range(n)]
    return tuple(named)


def _judged(log: Log, model: SelfModel, theta: Array) -> list[str]:
    """Refuse torques that even the loaded arm has in another unit, sign or order; notes on rest."""
    smoothed = smooth(1e-9 * (log.stamp_ns - log.stamp_ns[0]), log.q, log.dq, log.tau)
    if not moving_joints(*smoothed[:2]):
        return ["the arm hardly moves: static friction in its joints counts as load"]
    loaded = model.theta.copy()
    loaded[-1] += theta
    loaded_model = replace(model, theta=loaded)
    judge_torque(log, loaded_model, RigidArm.of(loaded_model), smoothed)
    return []


def _named(effect: Effect, std: tuple[float, ...], joint: int, recording: int | None) -> Named:
    """An effect at zero, to be fitted."""
    candidate = Candidate(effect, Template(std, effect.decode), joint, ())
    return Named(candidate, np.zeros(len(std)), recording=recording)


def _covariance(fit: Fit, known: Carried) -> Array:
    """Of all coefficients: by the noise, and no less than by what seconds of the log disagree.

    What a model gets wrong does not average out as noise does. The information of the rows is
    replaced by the spread of the gradients of whole seconds (White 1980, by clusters).
    """
    plain = known.covariance()
    white = known.data - known.x @ known.N
    ends = np.cumsum([(len(s.tau) - ORDER) * s.tau.shape[1] for s in fit.recordings])
    size = BLOCK * fit.n
    cuts = [np.arange(a, b, size) for a, b in pairwise([0, *ends])]
    scores = np.add.reduceat(known.N * white, np.concatenate(cuts), axis=1)
    robust = plain @ (scores @ scores.T + np.diag(known.prior_std**-2.0)) @ plain
    wider = np.sqrt(np.maximum(np.diagonal(robust) / np.diagonal(plain), 1.0))
    return plain * np.outer(wider, wider)


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
