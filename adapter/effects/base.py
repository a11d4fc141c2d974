"""What a physical effect beside the rigid body is to the rest of the program.

Sign everywhere: tau_measured = tau_rigid(q, dq, ddq) + sum of effects. The torque that a model
predicts is computed in four stages, and every effect belongs to one of them:

    motion   what the joint sensors say -> how the links really move
    body     inertias and gravity of the arm
    torque   what is added at the joints
    sensor   what the torque sensors make of it
"""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache, wraps
from typing import Any, ClassVar, Protocol, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from adapter.effects.by_joint import DRUM_M, ByJoint, JointSignals, smooth_sign
from adapter.effects.phrases import DecidingExperiment, Phrase
from adapter.errors import ModelError
from adapter.model.spatial import Array
from adapter.model.urdf_text import NO_PLACE, Additions
from drivers.errors import choices

Flags = NDArray[np.bool_]
Values = Mapping[str, Any]
Kernel = TypeVar("Kernel", bound=Callable[..., Any])

SMOOTH_HZ = 10.0  # low-pass of motions whose torques are compared as they are
EVEN, PAUSE_STEPS = 1e-3, 10  # share of a step by which even ones differ; most that a pause is

START_ODDS, RARE_START_ODDS = -2.0, -10.0
BODY_STD = (1.0, *[0.1] * 3, *[0.03] * 6)  # of ten inertial parameters: kg, kg m, kg m2

# Forms of friction that turns with the direction of motion, and of lateness; finer ones say which
# they refine.
LEVEL, LEVEL_BY_LOAD, TWO_LEVELS = "one level", "one level by load", "two levels"
LATE = "late"

JOINT, LINK, FLANGE, BASE, ALL = "joint", "link", "flange", "base", "all"


def with_squares(unit: str) -> str:
    """A unit of a file as people write it: kg m² for kg m2."""
    return unit.translate(str.maketrans("234", "²³⁴"))


def of_sliding(unit: str) -> str:
    """The unit of a joint's number where the joint slides: N s/m for N m s/rad, kg for kg m2."""
    return unit.replace("kg m2", "kg").replace("N m", "N").replace("rad", "m")


def on_drum(unit: str) -> float:
    """By which the usual size of a joint's number, of that unit, is multiplied where it slides."""

    def power(part: str) -> int:
        turns = sum(int(x or 1) for x in re.findall(r"rad(\d?)", part))
        return turns - part.count("N m") - 2 * part.count("kg m2")

    above, _, below = unit.partition("/")
    return float(DRUM_M ** (power(above) - power(below)))


@dataclass(frozen=True)
class Parameter:
    """A number that an effect needs: key and unit as in files, and what it may be.

    `grid_share`: of its size, the standard deviation of one that is searched for on a grid.
    """

    key: str
    unit: str
    lower: float = -math.inf
    upper: float = math.inf
    count: int = 1
    optional: bool = False
    grid_share: float = 0.0

    @property
    def written(self) -> str:
        """The unit as people write it: kg m²."""
        return with_squares(self.unit)

    def nearest(self, value: float) -> float:
        """The value, or the bound that it lies beyond."""
        return min(max(value, self.lower), self.upper)


class ArmDynamics(Protocol):
    """The rigid body that an effect acts on; see `physics.rigid_arm.RigidArm`."""

    @property
    def n(self) -> int: ...

    @property
    def theta(self) -> Array: ...

    @property
    def gravity(self) -> Array: ...

    @property
    def slides(self) -> tuple[bool, ...]: ...

    def changed(self, theta: Array | None = None, gravity: Array | None = None) -> ArmDynamics: ...

    def torque(self, q: Array, dq: Array, ddq: Array) -> Array: ...

    def regressor(self, q: Array, dq: Array, ddq: Array) -> Array: ...

    def wrench_torque(self, q: Array, wrench: Array) -> Array: ...


@dataclass(frozen=True, eq=False)
class Motion:
    """How an arm moves over m instants.

    Attributes:
        t: (m,) s since the recording began, increasing; all alike where rows are `apart`.
        q, dq, ddq: (m, n) rad, rad/s, rad/s².
        arm: the rigid body that moves.
        bands_hz: (n,) above which what the joints' torques hold is noise of the motion; None where
            nobody asked.
        smooth_hz: of the zero-phase low-pass that it has been through; None where what comes of it
            is filtered.
        sharp_q: (m, n) rad, angles in which a reversal is not smoothed; None where q is all there
            is.
    """

    t: Array
    q: Array
    dq: Array
    ddq: Array
    arm: ArmDynamics
    bands_hz: Array | None = None
    smooth_hz: float | None = None
    sharp_q: Array | None = None

    @property
    def apart(self) -> bool:
        """Whether each row is an instant by itself, of which nobody knows what came before."""
        return len(self.t) < 2 or bool(self.t[0] == self.t[-1])

    @property
    def direction(self) -> Array:
        """sign(dq) (m, n), smoothed around rest."""
        return smooth_sign(self.dq, drum=self.drums)

    @property
    def drums(self) -> Array:
        """(n,) DRUM_M of joints that slide, one of others."""
        return np.where(self.arm.slides, DRUM_M, 1.0)

    def moved(self, joint: int, q: Array, dq: Array, ddq: Array) -> Motion:
        """The same with the joint (from 0) displaced by q, dq, ddq (m,)."""
        pairs = (self.q, q), (self.dq, dq), (self.ddq, ddq)
        q, dq, ddq = (own + on_joint(self, joint, extra) for own, extra in pairs)
        return replace(self, q=q, dq=dq, ddq=ddq)

    def inside_band(self, x: Array, joint: int) -> Array:
        """Torque x (m,) of a joint without what lies above its band: further rates are noise."""
        if self.bands_hz is None:
            return x
        band_hz = float(self.bands_hz[joint])
        if band_hz == 0.0:  # nothing of it stands out of the noise
            return np.full_like(x, x.mean())
        return self._below(band_hz, x)

    def as_smooth(self, x: Array) -> Array:
        """An angle x (m,) that jumps, through the low-pass that the motion has been through."""
        return x if self.smooth_hz is None else self._below(self.smooth_hz, x)

    def _below(self, band_hz: float, x: Array) -> Array:
        from scipy.signal import sosfiltfilt  # long to load; no loop needs it

        def below(even: Array, step: float) -> Array:
            if not band_hz * step < 0.5:
                return even
            low_pass = _low_pass(band_hz, round(1.0 / step, 3))
            return np.asarray(sosfiltfilt(low_pass, even))

        return self._evenly(x, below)

    def lagged(self, x: Array, a: float, b: float) -> Array:
        """y (m,) of b y'' + a y' + y = x (m,), settled at the first instant."""
        from scipy.signal import cont2discrete, lfilter, lfilter_zi

        def lag(even: Array, step: float) -> Array:
            poles = np.trim_zeros(np.array([b, a, 1.0]), "f")
            up, down, _ = cont2discrete((np.ones(1), poles), step, "foh")
            start = lfilter_zi(up[0], down) * even[0]
            return np.asarray(lfilter(up[0], down, even, zi=start)[0])

        return self._evenly(x, lag) if a > 0.0 else x

    def _evenly(self, x: Array, made: Callable[[Array, float], Array]) -> Array:
        """A signal x (m,) as a filter makes it of even samples and their step (s)."""
        if self.apart or len(x) < 100:  # instants
            return x
        steps = np.diff(self.t)
        step = float(np.median(steps))
        if np.ptp(steps) < EVEN * step:
            return made(x, step)
        at = np.append(0.0, np.cumsum(np.minimum(steps, PAUSE_STEPS * step)))
        even = np.arange(0.0, at[-1] + step, step)
        return np.interp(at, even, made(np.interp(even, at, x), step))

    def rate(self, x: Array) -> Array:
        """Time derivative of x (m, ...); zero where rows are `apart`."""
        rate = _rate(np.ascontiguousarray(x, dtype=np.float64).reshape(len(x), -1), self.t)
        return np.asarray(rate.reshape(np.shape(x)))


def late_jit(function: Kernel) -> Kernel:
    """Compile a function when it is first called: the catalogue is read by who needs no numba."""

    @cache
    def compiled() -> Any:
        from numba import njit

        return njit(cache=True, error_model="numpy")(function)

    @wraps(function)
    def call(*args: Any) -> Any:
        return compiled()(*args)

    return cast(Kernel, call)


@late_jit
def _rate(x: Array, t: Array) -> Array:
    """Slope of x (m, c) at each instant t (m,) of the parabola through it and its neighbours.

    That of a line at both ends; zero where no stamp differs from the ones beside it.
    """
    rows, columns = x.shape
    out = np.zeros((rows, columns))
    for i in range(rows if rows > 1 else 0):
        back, ahead = max(i - 1, 0), min(i + 1, rows - 1)
        before, after = t[i] - t[back], t[ahead] - t[i]
        share = 1.0 if before == 0.0 else 0.0 if after == 0.0 else before / (before + after)
        up = 0.0 if after == 0.0 else share / after
        down = 0.0 if before == 0.0 else (1.0 - share) / before
        for j in range(columns):
            out[i, j] = up * (x[ahead, j] - x[i, j]) + down * (x[i, j] - x[back, j])
    return out


@lru_cache
def _low_pass(band_hz: float, rate_hz: float) -> Array:
    """Second-order sections of a low-pass; the search asks for the same few again and again."""
    from scipy.signal import butter

    return np.asarray(butter(4, band_hz, fs=rate_hz, output="sos"))


@dataclass(frozen=True)
class Template:
    """A way to look for an effect: coefficients in which its signature is all but linear.

    What is not linear (a number of turns, a velocity scale) is fixed in a template; an effect
    has one template for each value worth trying.

    Attributes:
        prior_std: of each coefficient; the prior's mean is zero, where the effect is absent.
        decode: coefficients (k,) to parameters.
        label: what is fixed, for people ("n = 3"); empty where nothing is.
        theta: (k, 10) inertial parameters of its link per unit of each coefficient, of an effect
            `is_theta`; None where its coefficients are these parameters themselves.
        chord: whether its signature is that of effects as large as `prior_std`, not of the least
            ones: for what is not linear near zero.
        linear: whether the torque is, in its coefficients.
    """

    prior_std: tuple[float, ...]
    decode: Callable[[Array], dict[str, Any]]
    label: str = ""
    theta: Array | None = field(default=None, compare=False)
    chord: bool = False
    linear: bool = True


class Effect(ABC):
    """A physical effect: its names, what it needs, how to look for it.

    Attributes:
        name: canonical name; title: for people.
        in_files: what a model's file calls it, so that others can read it; its name where empty.
        scope: what `joints` counts: `JOINT` one joint each, `LINK` the link of that number,
            `FLANGE` and `BASE` none, `ALL` all joints or one.
        parameters: in the order of the catalogue.
        prior_std: how large its coefficient may well be, or each of several; the prior's mean is
            zero. One prior for the search, the learner and the monitor.
        coefficients: their units, where these are not those of the first parameters.
        turns: whether it repeats with turns, and no joint that slides has it.
        phrase: how to say that it is there.
        place: what a joint of a robot's file calls it (`urdf_text`), if it has a name for it.
        shows: what it shows in the experiments of `phrases` that touch it.
        positive: keys of parameters that physics keeps above zero.
        inexact: share of its torque that may be otherwise in truth: an idealised equation.
        band: share of its largest torque that may be otherwise where the joint is slow or rests:
            static friction is a band, and rises as the joint slows down.
        form: of what has finer forms, see `LEVEL`; empty for all else.
        simpler: forms of which it is a finer one, each with the share of the evidence that the
            finer form must add: no gear is exactly as an equation says.
        log_odds: ln of how much more often than the common ones it is met, before any data.
        sudden: whether it does come in mid-recording; a base that tilts or an encoder that
            slips is rarer.
        steady: whether it is there all the time or never.
        passing: whether it comes and goes by itself.
        watched: whether the monitor looks for it while an arm is learned: an effect of a joint
            with `columns`, a body or a wrench at the flange.
        bundled: whether any joint may have it: such effects of one joint hide one another.
        over_angle: whether it is a curve over the joint's angle.
        is_theta: whether its coefficients are the ten inertial parameters of a link.
        by: joint (from 1) by whose signals another has it; 0 by its own.
        instant: which table of `ByJoint` shows it at one instant, and what of it; None for none.
    """

    name: ClassVar[str]
    in_files: ClassVar[str] = ""
    title: ClassVar[str]
    scope: ClassVar[str] = JOINT
    parameters: ClassVar[tuple[Parameter, ...]]
    prior_std: ClassVar[float | tuple[float, ...]]
    coefficients: ClassVar[tuple[str, ...]] = ()
    turns: ClassVar[bool] = False
    phrase: ClassVar[Phrase] = Phrase()
    place: ClassVar[str] = NO_PLACE
    shows: ClassVar[tuple[tuple[DecidingExperiment, str], ...]] = ()
    positive: ClassVar[tuple[str, ...]] = ()
    log_odds: ClassVar[float] = 0.0
    inexact: ClassVar[float] = 0.0
    band: ClassVar[float] = 0.0
    simpler: ClassVar[tuple[tuple[str, float], ...]] = ()
    form: ClassVar[str] = ""
    sudden: ClassVar[bool] = False
    steady: ClassVar[bool] = False
    passing: ClassVar[bool] = False
    watched: ClassVar[bool] = False
    bundled: ClassVar[bool] = False
    over_angle: ClassVar[bool] = False
    is_theta: ClassVar[bool] = False
    by: int = 0
    instant: ClassVar[tuple[str, Callable[[Values], Any]] | None] = None

    @property
    def log_odds_of_start(self) -> float:
        """ln of how often it starts while an arm is being recorded."""
        return START_ODDS if self.sudden else RARE_START_ODDS

    def decode(self, x: Array) -> dict[str, Any]:
        """Coefficients (k,) to parameters; one of each unless an effect says otherwise."""
        return {p.key: float(value) for p, value in zip(self.parameters, x, strict=True)}

    def templates(self) -> tuple[Template, ...]:
        """Ways to look for it; one unless an effect has a nonlinear setting."""
        return (Template(tuple(map(float, np.atleast_1d(self.prior_std))), self.decode),)

    def columns(self, at: JointSignals) -> tuple[Array, ...]:
        """Torque (..., n) on each joint per unit of each coefficient of the first template.

        Only for effects of a joint that are linear.
        """
        return ()

    def reshaped(self, values: Values, ratio: float) -> tuple[Template, ...]:
        """Templates with one of the nonlinear settings in `values` times `ratio` each."""
        return ()

    def over(self, seconds: float) -> Effect:
        """The effect as it is looked for in a recording that lasts so long."""
        return self

    def possible(self, values: Values) -> bool:
        """Whether physics allows these parameters; a fit may ask for others."""
        return all(float(values[key]) > 0.0 for key in self.positive)

    def log_odds_of(self, values: Values) -> float:
        """ln of how much rarer these parameters are met than others of the effect."""
        return 0.0

    def templates_over(self, low: float, high: float) -> tuple[Template, ...]:
        """The same on a joint that was seen between two angles, rad."""
        return self.templates()

    def log_odds_over(self, values: Values, turned: float) -> float:
        """The same where the joint turned by so many rad, of what cannot be told from it."""
        return 0.0

    def learned_from(self, values: Values) -> dict[str, float]:
        """Which effects' learned parameters, its own first, start from what a model tells of it."""
        return {}

    def at_instant(self, sums: ByJoint, joint: int | slice, values: Values) -> bool:
        """Add what one instant shows of the effect to sums; False where it shows nothing.

        `joint` from 0, or all of them.
        """
        if self.instant is not None:
            table, share = self.instant
            getattr(sums, table)[joint] += share(values)
        return self.instant is not None

    def export(self, more: Additions, joint: int, values: Values) -> str | None:
        """Put itself into what a simulator's file holds (joint from 0, -1 without one).

        Returns:
            None where all of it found a place; else what did, `NO_PLACE` where nothing.
        """
        return NO_PLACE

    def check(self, values: Values) -> None:
        """Raises ModelError for a parameter that is missing, unknown or out of range."""
        known = [p.key for p in self.parameters]
        for key in values:
            if key not in known:
                raise ModelError(f"{self.name} has no parameter '{key}'; {choices(key, known)}")
        for p in self.parameters:
            if p.key not in values:
                if p.optional:
                    continue
                raise ModelError(f"{self.name} needs '{p.key}' ({p.unit})")
            given = values[p.key]
            plain = isinstance(given, float) and p.count == 1 and math.isfinite(given)
            if plain and p.lower <= given <= p.upper:
                continue  # nearly all are, and thousands are checked where models are drawn
            try:
                value = np.asarray(given, dtype=float)
            except (TypeError, ValueError):
                value = np.full(p.count, np.nan)
            shape = () if p.count == 1 else (p.count,)
            where = f"{self.name}: '{p.key}'"
            if value.shape != shape or not np.all(np.isfinite(value)):
                wanted = "a finite number" if p.count == 1 else f"{p.count} finite numbers"
                raise ModelError(f"{where} must hold {wanted} ({p.unit}), got {given!r}")
            if np.any(value < p.lower) or np.any(value > p.upper):
                raise ModelError(f"{where} is {given}, outside {p.lower:g} to {p.upper:g}")

    def units(self, slides: bool = False) -> dict[str, str]:
        """Unit of each parameter; of a joint that slides."""
        own = slides and self.scope in (JOINT, ALL)
        return {p.key: of_sliding(p.unit) if own else p.unit for p in self.parameters}

    def on_sliding(self, template: Template) -> Template:
        """A template as it is looked for on a joint that slides."""
        if self.scope != JOINT:
            return template
        units = self.coefficients or [p.unit for p in self.parameters]
        sizes = zip(template.prior_std, units, strict=False)
        return replace(template, prior_std=tuple(std * on_drum(unit) for std, unit in sizes))


class MotionEffect(Effect):
    """Makes the measured motion differ from that of the links."""

    @abstractmethod
    def link_side(self, motion: Motion, tau: Array, joint: int, values: Values) -> Motion:
        """Motion of the links behind a measured motion; tau (m, n) is the joint torque."""


class BodyEffect(Effect):
    """Changes inertias or gravity."""

    @abstractmethod
    def body(self, theta: Array, gravity: Array, joint: int, values: Values) -> tuple[Array, Array]:
        """(theta (n, 10), gravity (3,)) with the effect; joint from 0, -1 for the last."""


class TorqueEffect(Effect):
    """Adds torque at the joints.

    Attributes:
        after_sensors: whether it is added to what the torque sensors say, last of all.
        by_load: whether it depends on the rigid torque, and not on the motion alone.
    """

    after_sensors: ClassVar[bool] = False
    by_load: ClassVar[bool] = False

    @abstractmethod
    def torque(self, motion: Motion, tau: Array, joint: int, values: Values) -> Array:
        """(m, n) N m that it adds; tau (m, n) is the rigid torque."""


class SensorEffect(Effect):
    """Makes the measured torque differ from the torque."""

    def low_pass(self, values: Values) -> tuple[float, float] | None:
        """(a s, b s²) of b measured'' + a measured' + measured = tau, if it is that."""
        return None

    @abstractmethod
    def measured(self, motion: Motion, tau: Array, joint: int, values: Values) -> Array:
        """(m, n) N m as the sensors say it, of the torques tau (m, n); joint -1: all joints."""


def on_joint(motion: Motion, joint: int, torque: Array) -> Array:
    """(m, n) with `torque` (m,) on one joint."""
    out = np.zeros_like(motion.q)
    out[:, joint] = torque
    return out


class JointTorque(TorqueEffect):
    """A torque effect that each joint has for itself, by one joint's signals and numbers alone.

    Attributes:
        variables: signals that it follows by no line.
    """

    variables: frozenset[str] = frozenset()

    @abstractmethod
    def law(self, at: JointSignals, values: Values) -> Array:
        """Torque, N m, of the shape of signals, `by` whichever; parameters are as many, or numbers.

        What jumps must be as smooth as `JointSignals.direction`.
        """

    def on(self, motion: Motion, tau: Array, joint: int, values: Values) -> Array:
        """The law (m,) on one joint."""
        k = self.by - 1 if self.by else joint
        q, dq, ddq, own = (x[:, k] for x in (motion.q, motion.dq, motion.ddq, tau))
        numbers = {key: x if np.ndim(x) else float(x) for key, x in values.items()}
        return self.law(JointSignals(q, dq, ddq, own, drum=float(motion.drums[k])), numbers)

    def torque(self, motion: Motion, tau: Array, joint: int, values: Values) -> Array:
        """The law on one joint."""
        return on_joint(motion, joint, self.on(motion, tau, joint, values))

    def at_instant(self, sums: ByJoint, joint: int | slice, values: Values) -> bool:
        """The law itself."""
        assert isinstance(joint, int)
        sums.add_law(self, joint, values)
        return True

    def absent(self, n: int) -> dict[str, Array]:
        """Parameters (n,) each of joints without it; what may not be zero stands at its least."""
        return {
            p.key: np.full(n if p.count == 1 else (n, p.count), np.clip(0.0, p.lower, p.upper))
            for p in self.parameters
        }


class LearnedEffect(Effect):
    """One that the learner can carry beside θ: one parameter per joint in which it is linear.

    Attributes:
        learned: number of that parameter in `parameters`.
        shape_key, shapes: a parameter in which it is not linear, and the rising values that have
            a column each in the learner, which chooses one between them; none where there is none.
        step: a usual size of the parameter, for ADAM.
        rate: which of the rates of the model's torque its one column is; None for none.
    """

    learned: ClassVar[int] = 0
    shape_key: ClassVar[str] = ""
    shapes: ClassVar[tuple[float, ...]] = ()
    step: ClassVar[float] = 1.0
    rate: ClassVar[int | None] = None

    @property
    def by_rates(self) -> bool:
        """Whether it depends on rates of the model's torque."""
        return self.rate is not None

    @property
    def key(self) -> str:
        """Name of the parameter."""
        return self.parameters[self.learned].key

    @property
    def unit(self) -> str:
        """Unit of the parameter."""
        return self.parameters[self.learned].unit

    @property
    def learned_std(self) -> float:
        """How large the parameter may well be."""
        return float(np.atleast_1d(self.prior_std)[self.learned])

    def drums(self, slides: Sequence[bool]) -> Array:
        """(n,) by which its usual sizes are multiplied on joints of which some slide."""
        return np.where(slides, on_drum(self.unit), 1.0)

    @abstractmethod
    def basis(self, at: JointSignals) -> tuple[Array, ...]:
        """Torque per unit of the parameter, of the signals' shape: for each of `shapes`, or one."""

    def shares(self, shape: Array) -> Array:
        """(K, ...) how far each of `basis` acts where the other parameter is `shape`."""
        return np.ones((1, *np.shape(shape)))

    def torque_per_unit(self, at: JointSignals, shape: Array) -> Array:
        """Torque per unit of the parameter where the other one is `shape` (NaN without one)."""
        parts = zip(self.shares(shape), self.basis(at), strict=True)
        return np.asarray(sum(share * column for share, column in parts))

    def learned_from(self, values: Values) -> dict[str, float]:
        """Its own parameter, but of what follows the load: the learner knows no rigid torque."""
        return {} if getattr(self, "by_load", False) else {self.name: float(values[self.key])}

    def learned_as(self, value: float, shape: float) -> tuple[str, dict[str, float]]:
        """Name and all parameters of what was learned."""
        known = {self.key: value, self.shape_key: shape}
        return self.name, {p.key: known.get(p.key, 0.0) for p in self.parameters}


class LinearEffect(LearnedEffect, JointTorque):
    """A torque effect with one parameter per joint in which it is linear: its law is its column.

    The learner has those that do not depend on the rigid torque, see `catalogue.LEARNED`.
    """

    prior_std: ClassVar[float]

    @abstractmethod
    def column(self, at: JointSignals) -> Array:
        """Torque per unit of the parameter, of the signals' shape."""

    def basis(self, at: JointSignals) -> tuple[Array, ...]:
        """The one column."""
        return (self.column(at),)

    columns = basis

    def law(self, at: JointSignals, values: Values) -> Array:
        """Parameter times column."""
        return np.asarray(values[self.key] * self.column(at))

    def export(self, more: Additions, joint: int, values: Values) -> str | None:
        """The parameter, in the place that a joint has for it."""
        return more.at_joint(self.place, joint, values[self.key])


def polar(x: Array) -> tuple[float, float]:
    """Size and phase of x[0] sin + x[1] cos = size sin(. + phase)."""
    return float(np.hypot(x[0], x[1])), float(np.arctan2(x[1], x[0]))
