"""Signatures: what each effect of the catalogue would add to the torque of this recording.

A signature is the change of the predicted torque per unit of a template's coefficient, at the
model as it stands, by finite differences of the same stages that predict torque anywhere else.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from adapter.effects import CATALOGUE
from adapter.effects.active import Active
from adapter.effects.base import (
    ALL,
    BASE,
    FLANGE,
    LATE,
    LINK,
    ArmDynamics,
    BodyEffect,
    Effect,
    Motion,
    MotionEffect,
    Parameter,
    SensorEffect,
    Template,
    TorqueEffect,
    Values,
    on_joint,
)
from adapter.effects.by_joint import JointSignals
from adapter.effects.catalogue import HELD
from adapter.effects.law import CURVE_NM, CURVES, DEGREE, LAWS, PIECES, WEIGHTS, Curve, Law, splines
from adapter.effects.torque import added, bodies, moved_links, sensors
from adapter.gap.hand import ANYWHERE, Hand
from adapter.gap.result import UNEXPLAINED
from adapter.gap.signals import Signals, regressor_of
from adapter.model.spatial import Array

PATTERN_SHARE = 0.7  # of what a pattern explains: an effect that explains so much goes first
STEP = 0.02  # of a coefficient's typical size, for the differences


@dataclass(frozen=True, eq=False)
class Candidate:
    """One way in which the model may be incomplete.

    Attributes:
        effect: of the catalogue; template: how its coefficients are read.
        joint: from 0; -1 where the effect has none.
        columns: places of its signatures in the table of all signatures.
        log_odds: ln of what it is worth before the data where it acts all the time.
        slides: whether its joint does.
    """

    effect: Effect
    template: Template
    joint: int
    columns: tuple[int, ...]
    log_odds: float = 0.0
    slides: bool = False

    @property
    def key(self) -> tuple[str, int]:
        """Effect and joint."""
        return self.effect.name, self.joint

    @property
    def units(self) -> dict[str, str]:
        """Unit of each parameter."""
        return self.effect.units(self.slides)

    @property
    def columns_are_theta(self) -> bool:
        """Whether its coefficients are, or stand for, inertial parameters of a link."""
        return self.effect.is_theta

    def possible(self, x: Array, interval_s: tuple[float, float]) -> bool:
        """Whether physics allows these coefficients (k,) at these times.

        What the hand puts down is a load less from then on.
        """
        put_down = self.effect is HELD and np.isfinite(interval_s[0])
        return put_down or self.effect.possible(self.template.decode(x))

    @property
    def theta(self) -> Array:
        """(k, 10) inertial parameters of its link per unit of each coefficient."""
        return np.eye(10) if self.template.theta is None else self.template.theta

    @property
    def prior_std(self) -> Array:
        """(k,) of its coefficients."""
        return np.array(self.template.prior_std)


@dataclass(frozen=True, eq=False)
class Stages:
    """What a model predicts on a recording, stage by stage, at the motion's rate.

    Attributes:
        signals: the recording.
        links: motion of the links, with the model's arm.
        rigid: (m, n) torque of the bodies; total: with what acts at the joints; sensed: as the
            sensors read it.
        has_bodies: whether some effects are on bodies.
    """

    signals: Signals
    links: Motion
    rigid: Array
    total: Array
    sensed: Array
    has_bodies: bool

    @cached_property
    def bare(self) -> Array:
        """(m, n) torque of the arm alone, without effects on its bodies."""
        links = self.links
        return links.arm.torque(links.q, links.dq, links.ddq) if self.has_bodies else self.rigid

    @property
    def unmoved(self) -> bool:
        """Whether the links move as the joint sensors say."""
        return self.links.q is self.signals.motion.q

    def low_regressor(self, link: int | None = None, gate: Array | None = None) -> Array:
        """(c, k, n) regressor in the band: of one link (from 0) or all, while a gate is open."""
        own = slice(None) if link is None else slice(10 * link, 10 * link + 10)
        if self.unmoved and gate is None:
            return self.signals.low_regressor[own]

        def made(rows: slice) -> Array:
            Y = regressor_of(self.links, rows)[:, :, own]
            return Y if gate is None else Y * gate[rows, :, None]

        return np.moveaxis(self.signals.low_of(made), 2, 0)


def stages_of(
    signals: Signals, effects: Sequence[Active], arm: ArmDynamics | None = None
) -> Stages:
    """Evaluate an arm (that of the recording's motion where None is given) with effects."""
    motion = signals.motion if arm is None else replace(signals.motion, arm=arm)
    links = moved_links(motion, effects)
    if links is not motion:
        links = signals.banded(links)
    rigid = bodies(links, effects)
    total = added(links, rigid, effects)
    has_bodies = any(isinstance(active.effect, BodyEffect) for active in effects)
    return Stages(signals, links, rigid, total, sensors(links, total, effects), has_bodies)


def slides(arm: ArmDynamics, joint: int) -> bool:
    """Whether a joint (from 0, or -1 for none) slides."""
    return joint >= 0 and arm.slides[joint]


def places(effect: Effect, n: int) -> tuple[int, ...]:
    """Joints (from 0) where an effect may be; -1 where it has none of its own."""
    if effect.scope in (FLANGE, BASE):
        return (-1,)
    return (-1, *range(n)) if effect.scope == ALL else tuple(range(n))


def templates(effect: Effect, hand: Hand, q: Array | None = None) -> tuple[Template, ...]:
    """Ways to look for an effect on an arm with this hand, on a joint at angles q (m,) rad."""
    if effect is HELD:
        return hand.templates()
    if q is None:
        return effect.templates()
    return effect.templates_over(float(q.min()), float(q.max()))


def signatures(
    at: Stages,
    joints: Sequence[int],
    extra: Sequence[tuple[Effect, int, Template]] = (),
    hand: Hand = ANYWHERE,
) -> tuple[Array, list[Candidate]]:
    """Every signature in the band, and what each belongs to.

    Args:
        at: the model as it stands on a recording.
        joints: (from 0) that move; effects of others cannot be told.
        extra: further effects, each with its joint and how it is looked for.
        hand: where a load is.

    Returns:
        (c, k, n) N m per unit of the coefficient; candidates. The first 10 n signatures are
        those of θ.
    """
    arm, n, seconds = at.links.arm, at.links.arm.n, float(np.ptp(at.links.t))
    tables, candidates, size = [at.low_regressor()], [], 10 * n
    ways = [
        (effect.over(seconds), joint, template)
        for effect in CATALOGUE.values()
        for joint in places(effect, n)
        if joint < 0 or effect.scope == LINK or joint in joints
        if not (effect.turns and slides(arm, joint))
        for template in templates(effect, hand, at.links.q[:, joint] if joint >= 0 else None)
    ]
    ways += extra
    for effect, joint, template in ways:
        on_slide = slides(arm, joint)
        if on_slide and not isinstance(effect, Pattern | Law):  # of these it is known by torque
            template = effect.on_sliding(template)
        if effect.is_theta and template.theta is None:
            k = 10 * (joint if joint >= 0 else n - 1)
            columns = tuple(range(k, k + 10))
        else:
            tables.append(_signatures(at, effect, template, joint))
            columns = tuple(range(size, size + len(template.prior_std)))
            size += len(columns)
        odds = prior_log_odds(effect, joint, n, len(templates(effect, hand)))
        if joint >= 0:
            values = template.decode(np.array(template.prior_std))
            odds += effect.log_odds_over(values, float(np.ptp(at.links.q[:, joint])))
        candidates.append(Candidate(effect, template, joint, columns, odds, on_slide))
    return np.concatenate(tables), candidates


def _signatures(at: Stages, effect: Effect, template: Template, joint: int) -> Array:
    """(c, k, n) of one effect; those that hang on the measured motion alone are kept."""
    if template.theta is not None:
        return np.tensordot(template.theta, at.low_regressor(joint % at.links.arm.n), 1)
    if isinstance(effect, TorqueEffect) and not effect.by_load and at.unmoved:
        key = effect.name, template.label, joint
        return at.signals.once(key, lambda: _differences(at, effect, template, joint))
    return _differences(at, effect, template, joint)


def _differences(at: Stages, effect: Effect, template: Template, joint: int) -> Array:
    """(c, k, n) change of the torque per unit of each coefficient, from zero on."""
    if isinstance(effect, Pattern):
        basis = effect.basis(at.links, at.rigid, joint)
        table = np.zeros((basis.shape[1], *at.signals.tau.shape))
        table[:, :, joint] = at.signals.low(basis).T
        return table
    own = joint if isinstance(effect, TorqueEffect | SensorEffect) else -1
    out = []
    for i, std in enumerate(template.prior_std):
        x = np.zeros(len(template.prior_std))
        x[i] = std if template.chord else STEP * std
        change = _change(at, effect, joint, template.decode(x)) / x[i]
        out.append(at.signals.low_on(change, own))
    return np.array(out)


def _change(at: Stages, effect: Effect, joint: int, values: dict) -> Array:
    """(m, n) by how much an effect changes the torque."""
    links = at.links
    if isinstance(effect, TorqueEffect):
        return effect.torque(links, at.rigid, joint, values)
    if isinstance(effect, SensorEffect):
        # friction that was named is late as well, but would make a gain look like friction
        tau = at.total if effect.form == LATE else at.rigid
        return effect.measured(links, tau, joint, values) - tau
    if isinstance(effect, MotionEffect):
        moved = effect.link_side(links, at.rigid, joint, values)
        return links.arm.torque(moved.q, moved.dq, moved.ddq) - at.bare
    return bodies(links, (Active(effect, joint, values),)) - at.bare


SLOW_PIECES = 10  # over time
LINE_HZ = (0.15, 9.0)
SHARPENED, FINE = 12, 40  # rounds in which a line's frequency is sharpened; steps either way


class Pattern(TorqueEffect):
    """A torque on one joint, linear in basis functions of the arm's signals.

    Args:
        label: tells patterns apart; depends_on: signals that it follows ("dq3"), own joint first.
        basis: motion and rigid torque to basis functions (m, k) at the joint.
        count: k.
        curve: the effect that it is, where it is one.
    """

    title = "something that is not in the catalogue"
    log_odds = -7.0

    def __init__(
        self,
        label: str,
        depends_on: tuple[str, ...],
        basis: Callable[[Motion, Array, int], Array],
        count: int,
        curve: Curve | None = None,
    ) -> None:
        self.name = f"{UNEXPLAINED}:{label}"  # type: ignore[misc]
        self.parameters = (Parameter("x", "N m", count=count),)  # type: ignore[misc]
        self.depends_on, self.basis, self._count = depends_on, basis, count
        self.curve = curve
        self.by_load = any(name.startswith("tau") for name in depends_on)  # type: ignore[misc]

    def templates(self) -> tuple[Template, ...]:
        """All its coefficients at once."""
        return (Template((CURVE_NM,) * self._count, lambda x: {"x": np.asarray(x)}),)

    def torque(self, motion: Motion, tau: Array, joint: int, values: Values) -> Array:
        """Coefficients times basis."""
        return on_joint(motion, joint, self.basis(motion, tau, joint) @ np.asarray(values["x"]))


def patterns(joint: int) -> tuple[Pattern, ...]:
    """What the torque on a joint (from 0) may follow by no formula: its signals, or time."""
    over_time = Pattern("t", ("t",), _over_time, SLOW_PIECES + DEGREE)
    return (*(_free(curve, joint + 1) for curve in CURVES.values()), over_time)


def _free(curve: Curve, k: int) -> Pattern:
    """A curve on the k-th joint (from 1), over the range of each recording."""

    def basis(motion: Motion, tau: Array, joint: int) -> Array:
        x = signal_of(curve.signal, motion, tau, joint)
        weight = WEIGHTS[curve.weight](JointSignals(x, motion.dq[:, joint], x))
        return np.asarray((weight * np.array(splines(x, float(x.min()), float(x.max())))).T)

    depends_on = (f"{curve.signal}{k}", *([f"dq{k}"] if curve.weight else []))
    return Pattern(f"{curve.name} {k}", depends_on, basis, PIECES + DEGREE, curve)


def laws(stages: Sequence[Stages], joint: int) -> list[tuple[Law, int, Template]]:
    """Every law that the torque on a joint (from 0) may have, at each setting that is tried.

    How large a law may well be is known of its torque, not of its coefficient.
    """
    out, seen = list[tuple[Law, int, Template]](), ranges(stages, joint)
    kept = {effect.in_files for effect in CATALOGUE.values()}  # by another name
    for law in LAWS.values():
        if law.by > stages[0].links.arm.n or law.by == joint + 1 or law.name in kept:
            continue
        setting = law.expression.setting
        if law.turns and slides(stages[0].links.arm, joint):
            continue
        low, high = seen[setting.within if setting else ""]
        tried = [low + share * (high - low) for share in setting.tried] if setting else [1.0]
        for template in map(law.at, tried):
            rms = np.sqrt(np.mean([_power(at, law, template, joint) for at in stages]))
            std = CURVE_NM / max(float(rms), 1e-6)
            scaled = (std,) * len(template.prior_std)
            out.append((law, joint, replace(template, prior_std=scaled)))
    return out


def ranges(stages: Sequence[Stages], joint: int) -> dict[str, tuple[float, float]]:
    """What a joint's (from 0) signals were seen between, by the name that a setting has for it."""
    q = np.concatenate([at.links.q[:, joint] for at in stages])
    most = max(float(np.abs(at.rigid[:, joint]).max()) for at in stages)
    return {"": (0.0, 1.0), "q": (float(q.min()), float(q.max())), "|tau|": (0.0, most)}


def _power(at: Stages, law: Law, template: Template, joint: int) -> float:
    """Mean square of a law's torque on a joint where its first coefficient is one."""
    values = template.decode(np.eye(len(template.prior_std))[0])

    def compute() -> Array:
        return np.asarray(np.mean(law.on(at.links, at.rigid, joint, values) ** 2))

    if law.by_load or not at.unmoved:
        return float(compute())
    return float(at.signals.once(("power", law.name, template.label, joint), compute))


def line(hz: float) -> Pattern:
    """A sine in time."""

    def basis(motion: Motion, tau: Array, joint: int) -> Array:
        angle = 2.0 * np.pi * hz * motion.t
        return np.column_stack([np.sin(angle), np.cos(angle)])

    return Pattern(f"t at {hz:.2f} Hz", ("t",), basis, 2)


def line_hz(residual: Array, rate_hz: float) -> float | None:
    """The frequency of a sine in time that stands out of a residual (k,), if one does."""
    power = np.abs(np.fft.rfft(residual * np.hanning(len(residual)))) ** 2
    f = np.fft.rfftfreq(len(residual), 1.0 / rate_hz)
    inside = (f > LINE_HZ[0]) & (f < LINE_HZ[1])
    peak = int(np.argmax(np.where(inside, power, 0.0)))
    near = power[max(peak - 20, 1) : peak + 20]
    if power[peak] < 30.0 * np.median(near):  # a spectral line must stand out so much
        return None
    # the top of the parabola through the peak's logarithms
    a, b, c = np.log(power[peak - 1 : peak + 2] + 1e-300)
    return float(f[peak] + 0.5 * (a - c) / (a - 2 * b + c) * (f[1] - f[0]))


def sharpened(hz: float, residual: Array, t: Array, width_hz: float) -> float:
    """A frequency as well as all stretches of a residual (k,) at t (k,) s tell it together.

    Args:
        width_hz: within which it is looked for, first in steps that the neighbouring stretches
            bridge, then in finer and finer ones.
    """
    for span_s in np.geomspace(4.0 / width_hz, max(float(np.ptp(t)), 4.0 / width_hz), SHARPENED):
        used = t <= t[0] + span_s
        near = hz + width_hz * np.linspace(-1.0, 1.0, 2 * FINE + 1)
        phase = np.exp(-2j * np.pi * np.outer(near, t[used]))
        hz = float(near[np.argmax(np.abs(phase @ residual[used]))])
        width_hz = min(width_hz, 1.0 / span_s)
    return hz


def signal_of(name: str, motion: Motion, tau: Array, joint: int) -> Array:
    """(m,) a joint's "q", "dq", "ddq" or rigid "tau"."""
    return np.asarray(tau[:, joint] if name == "tau" else getattr(motion, name)[:, joint])


def _over_time(motion: Motion, tau: Array, joint: int) -> Array:
    """Splines (m, SLOW_PIECES + 3) of time."""
    t = motion.t
    return np.array(splines(t, float(t[0]), float(t[-1]), SLOW_PIECES)).T


def simpler_wins(simple: tuple[Candidate, float], other: tuple[Candidate, float]) -> bool:
    """Whether `simple` is the simpler of two candidates, and explains (chi2) all but as much.

    Its finer form must add a share to what an effect explains, and a pattern must explain
    clearly more than an effect of the catalogue.
    """
    (a, mine), (b, theirs) = simple, other
    if isinstance(b.effect, Pattern):
        beside = a.joint in (b.joint, -1) and not isinstance(a.effect, Pattern)
        return beside and mine > PATTERN_SHARE * theirs
    share = dict(b.effect.simpler).get(a.effect.form)
    return share is not None and a.joint == b.joint and theirs < (1.0 + share) * mine


def is_finer(fine: Candidate, simple: Candidate) -> bool:
    """Whether a candidate is a finer form of another on the same joint."""
    alike = fine.joint == simple.joint and not isinstance(fine.effect, Pattern)
    return alike and simple.effect.form in dict(fine.effect.simpler)


def log_odds(c: Candidate, timed: bool = False, passing: bool = False) -> float:
    """ln of what a candidate is worth before the data, the ways to look for it included."""
    odds = c.log_odds
    if c.effect.passing and not passing:
        odds -= 60.0  # what pushes for a whole recording is rather weight or a tilted base
    if timed or passing:
        odds += c.effect.log_odds_of_start
    return float(odds)


def prior_log_odds(effect: Effect, joint: int, n: int, ways: int) -> float:
    """Of one effect of all, at one joint of n, in one of so many ways to look for it."""
    odds = effect.log_odds - np.log(len(CATALOGUE)) - np.log(ways)
    if joint >= 0:
        odds -= np.log(n)
        if effect.scope == ALL:
            odds -= 4.0  # signals of one bus are late together, not one joint's alone
    return float(odds)
