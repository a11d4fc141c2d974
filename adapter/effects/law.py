"""Laws in closed form of what no effect of the catalogue is: one term of a small grammar each.

A law is a coefficient times an expression of the joint's own signals, or of another joint's. The
expression is its name, so that a file that holds it can be read by whoever has not seen it found.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from adapter.effects import base as base
from adapter.effects.base import Array, JointSignals, Values
from adapter.effects.phrases import SPEEDS, STILL, TURN, Phrase
from adapter.model.urdf_text import CUBIC_DRAG, DRAG, NO_PLACE, Additions

LAW, AT = "law: ", " at "  # begins the name of a law that has no other; goes before its setting
LOG_ODDS, SETTING_NATS = -7.0, 3.0  # what has no name is rarer; the price of a setting
CURVE_NM = 0.3  # of a curve's coefficients, and of a law's torque
EDGES = tuple(np.linspace(0.05, 0.95, 19))  # shares of a range in which something begins
BY, MOST_JOINTS = "ⱼ", 32


SIGNALS = {  # powers of the units that they have
    "q": {"rad": 1},
    "dq": {"rad": 1, "s": -1},
    "ddq": {"rad": 1, "s": -2},
    "tau": {"N m": 1},
}


def _unit(powers: Mapping[str, int]) -> str:
    """A unit as files have it: N m s2/rad2."""

    def product(sign: int) -> str:
        parts = [(f"({x})" if " " in x else x, sign * p) for x, p in powers.items() if sign * p > 0]
        own = [x.strip("()") if p == 1 else f"{x}{p}" for x, p in parts]
        return " ".join(own)

    above, below = product(1), product(-1)
    return f"{above or 1}/{below}" if below else above


@dataclass(frozen=True)
class Setting:
    """The one number of an expression in which it is not linear.

    Attributes:
        key, unit, size, lower: of it: as it is written, its usual size, the least it may be.
        tried: values; shares of a range where it lies `within` one: "q", or "|tau|" from zero on.
        wave: whether it is the n of a factor sin(n q + phase).
    """

    key: str
    unit: str
    tried: tuple[float, ...]
    within: str = ""
    size: float = 1.0
    lower: float = -np.inf
    wave: bool = False


EDGE = Setting("a", "rad", EDGES, within="q")
PLAY = Setting("a", "N m", EDGES, within="|tau|", size=10.0, lower=0.0)
BEND = Setting("a", "N m", tuple(np.geomspace(0.1, 3.0, 12)), "|tau|", size=10.0, lower=0.1)
# a power below 1 is friction that falls with speed
POWER = Setting("p", "", (1.25, 1.5, 1.75, 2.25, 2.5, 2.75), lower=1.0)
WAVE = Setting("n", "per turn", tuple(map(float, range(1, 21))), wave=True)


@dataclass(frozen=True)
class Expression:
    """How a torque depends on signals, apart from its size.

    Attributes:
        text: as people write it; `BY` stands for the number of another joint, whose signals it has.
        powers: of its signals, for the coefficient's unit.
        term: of the signals and the setting, where there is one.
        setting: that it has.
        drags: whether it is friction by speed alone, which takes energy or is none.
        place: what a joint of a robot's file calls it (`urdf_text`), if it has a name for it.
    """

    text: str
    powers: Mapping[str, int]
    term: Callable[[JointSignals, Array], Array]
    setting: Setting | None = None
    drags: bool = False
    place: str = NO_PLACE

    @property
    def unit(self) -> str:
        """Of its coefficient: N m over the signals' units to their powers."""
        total = Counter({"N m": 1})
        for name, power in self.powers.items():
            total.subtract({unit: own * power for unit, own in SIGNALS[name].items()})
        return _unit(total)


def _above(at: JointSignals, a: Array) -> Array:
    return np.maximum(at.q - a, 0.0)


def _below(at: JointSignals, a: Array) -> Array:
    return np.maximum(a - at.q, 0.0)


def _deadband(at: JointSignals, a: Array) -> Array:
    return np.asarray(np.sign(at.tau) * np.maximum(np.abs(at.tau) - a, 0.0))


def _power(at: JointSignals, p: Array) -> Array:
    return np.asarray(np.sign(at.dq) * np.abs(at.dq) ** p)


def _grammar() -> tuple[Expression, ...]:
    """Every expression that is tried."""
    out = [
        Expression("dq |dq|", {"dq": 2}, lambda at, _: at.dq * np.abs(at.dq), None, True, DRAG),
        Expression("dq³", {"dq": 3}, lambda at, _: at.dq**3, None, True, CUBIC_DRAG),
        Expression("|dq|", {"dq": 1}, lambda at, _: np.abs(at.dq)),
        Expression("dq²", {"dq": 2}, lambda at, _: at.dq**2),
        Expression("sign(dq) |dq|^p", {}, _power, POWER, drags=True),
        Expression("q²", {"q": 2}, lambda at, _: at.q**2),
        Expression("(q - a)³", {"q": 3}, lambda at, a: (at.q - a) ** 3, EDGE),
        Expression("max(q - a, 0)", {"q": 1}, _above, EDGE),
        Expression("max(a - q, 0)", {"q": 1}, _below, EDGE),
        Expression("max(q - a, 0)²", {"q": 2}, lambda at, a: _above(at, a) ** 2, EDGE),
        Expression("max(a - q, 0)²", {"q": 2}, lambda at, a: _below(at, a) ** 2, EDGE),
        Expression("ddq |ddq|", {"ddq": 2}, lambda at, _: at.ddq * np.abs(at.ddq)),
        Expression("tau |tau|", {"tau": 2}, lambda at, _: at.tau * np.abs(at.tau)),
        Expression("tau²", {"tau": 2}, lambda at, _: at.tau**2),
        Expression("tau³", {"tau": 3}, lambda at, _: at.tau**3),
        Expression("sign(tau) max(|tau| - a, 0)", {"tau": 1}, _deadband, PLAY),
        Expression("tanh(tau/a)", {}, lambda at, a: np.tanh(at.tau / a), BEND),
        Expression("tau² sign(dq)", {"tau": 2}, lambda at, _: at.tau**2 * at.direction),
        Expression("dqⱼ", {"dq": 1}, lambda at, _: at.dq),
        Expression("sign(dqⱼ)", {}, lambda at, _: at.direction),
        Expression("dqⱼ |dqⱼ|", {"dq": 2}, lambda at, _: at.dq * np.abs(at.dq)),
        Expression("tauⱼ", {"tau": 1}, lambda at, _: at.tau),
        Expression("tauⱼ |tauⱼ|", {"tau": 2}, lambda at, _: at.tau * np.abs(at.tau)),
    ]
    out += _over_angle("sign(dq)", {}, lambda at: at.direction)
    return (*out, *_over_angle("dq", {"dq": 1}, lambda at: at.dq))


def _over_angle(
    text: str, powers: Mapping[str, int], friction: Callable[[JointSignals], Array]
) -> tuple[Expression, ...]:
    """Friction that depends on the angle."""
    once, twice = {**powers, "q": 1}, {**powers, "q": 2}
    return (
        Expression(f"{text} q", once, lambda at, _: friction(at) * at.q),
        Expression(f"{text} q²", twice, lambda at, _: friction(at) * at.q**2),
        Expression(f"{text} max(q - a, 0)", once, lambda at, a: friction(at) * _above(at, a), EDGE),
        Expression(f"{text} max(a - q, 0)", once, lambda at, a: friction(at) * _below(at, a), EDGE),
        Expression(f"{text} sin(n q + phase)", powers, lambda at, _: friction(at), WAVE),
    )


class OverSignals(base.JointTorque):
    """A torque of no catalogue, by signals of one joint, which `variables` names."""

    @property
    def along(self) -> str:
        """The signal over which it is a curve; of what is a kind of friction, not its speed."""
        return next(iter(self.variables - {"dq"}), "dq")

    def curve(self, x: Array, values: Values) -> Array:
        """Torque (k,) over that signal; of what is a kind of friction, at 1 rad/s."""
        q, dq, ddq, tau = (x if key == self.along else np.ones_like(x) for key in SIGNALS)
        return self.law(JointSignals(q, dq, ddq, tau), values)


class Law(OverSignals):
    """A torque c times an expression.

    Args:
        expression: of it.
        by: joint (from 1) whose signals it takes; 0 for its own.
    """

    inexact = 0.02
    steady = True
    shows = ((SPEEDS, "follows its curve"), (STILL, "is gone"), (TURN, "follows its curve"))

    def __init__(self, expression: Expression, by: int = 0) -> None:
        self.expression, self.by, setting = expression, by, expression.setting
        text = expression.text.replace(BY, str(by))
        self.name = self.in_files = f"{LAW}{text}"  # type: ignore[misc]
        self.title = f"torque of c {text}"  # type: ignore[misc]
        self.variables = frozenset(re.findall(r"ddq|dq|tau|q", expression.text))
        self.by_load = "tau" in self.variables  # type: ignore[misc]
        self.positive = ("c",) if expression.drags else ()  # type: ignore[misc]
        self.place = expression.place  # type: ignore[misc]
        self.turns = bool(setting and setting.wave)  # type: ignore[misc]
        self.log_odds = LOG_ODDS - SETTING_NATS * (setting is not None)  # type: ignore[misc]
        own = [base.Parameter("c", expression.unit)]
        own += [base.Parameter(setting.key, setting.unit, lower=setting.lower)] if setting else []
        own += [base.Parameter("phase", "rad")] if setting and setting.wave else []
        self.parameters = tuple(own)  # type: ignore[misc]
        sizes_said = ", ".join(f"{p.key} = {{{p.key}}}" for p in own)
        self.phrase = Phrase(f"{{who}} {{has}} a {{title}}: {sizes_said}", "c")  # type: ignore[misc]

    def templates(self) -> tuple[base.Template, ...]:
        """Its coefficient, or two of a wave, at the first setting that is tried."""
        setting = self.expression.setting
        return (self.at(setting.tried[0] if setting else 1.0),)

    def at(self, value: float) -> base.Template:
        """Its coefficients, of unit prior, where its setting is fixed."""
        setting = self.expression.setting
        fixed = {setting.key: value} if setting else {}
        label = f"{setting.key} = {value:.4g}" if setting else ""
        if not (setting and setting.wave):
            return base.Template((1.0,), lambda x: {"c": float(x[0]), **fixed}, label)

        def decode(x: Array) -> dict[str, Any]:
            size, phase = base.polar(x)
            return {"c": size, **fixed, "phase": phase}

        return base.Template((1.0, 1.0), decode, label)

    def around(self, values: Values, std: float) -> base.Template | None:
        """Its coefficient, and by how much its setting is not as in `values`; None without one.

        `std`: of the coefficient.
        """
        setting = self.expression.setting
        if setting is None or setting.wave:
            return None
        key, middle, lower = setting.key, float(values[setting.key]), setting.lower
        return base.Template(
            (std, setting.size),
            lambda x: {"c": float(x[0]), key: max(middle + float(x[1]), lower)},
            linear=False,
        )

    def export(self, more: Additions, joint: int, values: Values) -> str | None:
        """c, in the place that a joint has for it."""
        return more.at_joint(self.place, joint, values["c"])

    def learned_from(self, values: Values) -> dict[str, float]:
        """c, of the law at its setting, if it is learned."""
        return {} if self.by_load else {_at(self, values): float(values["c"])}

    def law(self, at: JointSignals, values: Values) -> Array:
        """c times the expression."""
        setting = self.expression.setting
        term = self.expression.term(at, np.asarray(values[setting.key] if setting else 0.0))
        if setting and setting.wave:
            term = term * np.sin(values["n"] * at.q + values["phase"])
        return np.asarray(values["c"] * term)


class LearnedLaw(base.LearnedEffect, Law):
    """A law at a setting, if it has one, which is in its name: c can be learned beside θ.

    Args:
        law: which; held: the parameters behind c.
    """

    prior_std, step = 10.0, 1.0  # of powers of some tenths of a rad/s

    def __init__(self, law: Law, held: Values) -> None:
        super().__init__(law.expression, law.by)
        self.name, self._law, self._held = _at(law, held), law.name, held  # type: ignore[misc]
        said = " and ".join(f"{key} = {x:.3g}" for key, x in held.items())
        self.title = f"{law.title}{AT if said else ''}{said}"  # type: ignore[misc]

    def basis(self, at: JointSignals) -> tuple[Array, ...]:
        """The expression; the joint that others follow is not its own follower."""
        own = np.arange(np.shape(at.dq)[-1]) == self.by - 1
        return (np.where(own, 0.0, self.law(at.of(self.by), {"c": 1.0, **self._held})),)

    def learned_as(self, value: float, shape: float) -> tuple[str, dict[str, float]]:
        """The law with its setting."""
        return self._law, {"c": value, **self._held}


def _at(law: Law, values: Values) -> str:
    """The name under which a law is learned: its setting does not change, and is in it."""
    said = [f"{p.key} = {float(values[p.key])!r}" for p in law.parameters[1:]]
    return law.in_files + AT * bool(said) + " and ".join(said)


@lru_cache
def learned_law(name: str) -> LearnedLaw | None:
    """The law of that name, as it is learned; None where there is none."""
    text, _, said = name.partition(AT)
    numbers = re.findall(r"(\w+) = (-?\d+(?:\.\d+)?(?:e-?\d+)?)", said)
    law, held = LAWS.get(text), {key: float(value) for key, value in numbers}
    if law is None or law.by_load or list(held) != [p.key for p in law.parameters[1:]]:
        return None
    return LearnedLaw(law, held)


PIECES, DEGREE = 5, 3  # of a spline over a signal's range
WEIGHTS: dict[str, Callable[[JointSignals], Array | float]] = {
    "": lambda at: 1.0,
    "sign(dq) ": lambda at: at.direction,
    "dq ": lambda at: at.dq,
}


def splines(x: Array, low: Array | float, high: Array | float, pieces: int = PIECES) -> list[Array]:
    """Cubic B-splines (pieces + DEGREE of them) over a range; beyond it they stay as at its end."""
    step = np.maximum(np.subtract(high, low), 1e-9) / pieces
    at = np.minimum(np.maximum((x - low) / step, 0.0), pieces) + 1.0
    away = [np.abs(at - k) for k in range(pieces + DEGREE)]
    return [
        (np.maximum(2.0 - u, 0.0) ** 3 - 4.0 * np.maximum(1.0 - u, 0.0) ** 3) / 6.0 for u in away
    ]


class Curve(OverSignals):
    """A torque that follows a signal by no formula: a spline over the range that was seen.

    Args:
        signal: "q", "dq", "ddq" or "tau"; weight: one of `WEIGHTS`, which it is times.
    """

    steady = True
    log_odds = LOG_ODDS

    def __init__(self, signal: str, weight: str = "") -> None:
        self.signal, self.weight = signal, weight
        self.variables = frozenset({signal, "dq"} if weight else {signal})
        text = f"{weight}curve({signal})"
        self.name = f"{LAW}{text}"  # type: ignore[misc]
        self.title = f"torque of {text}, without a formula"  # type: ignore[misc]
        self.by_load = signal == "tau"  # type: ignore[misc]
        unit = _unit(SIGNALS[signal])
        self.parameters = (  # type: ignore[misc]
            base.Parameter("x", "N m", count=PIECES + DEGREE),
            base.Parameter("low", unit),
            base.Parameter("high", unit),
        )
        self.phrase = Phrase("{who} {has} {torque} that follow " + text + " by no formula")  # type: ignore[misc]

    def between(self, low: float, high: float) -> base.Template:
        """All its coefficients over a range."""
        return base.Template(
            (CURVE_NM,) * (PIECES + DEGREE),
            lambda x: {"x": [float(value) for value in x], "low": low, "high": high},
        )

    def templates(self) -> tuple[base.Template, ...]:
        """Over a usual range."""
        return (self.between(-1.0, 1.0),)

    def law(self, at: JointSignals, values: Values) -> Array:
        """Splines times coefficients, (..., n) of all joints or of one."""
        basis = splines(getattr(at, self.signal), values["low"], values["high"])
        shares = np.moveaxis(np.asarray(values["x"], dtype=float), -1, 0)
        torque = sum(share * one for share, one in zip(shares, basis, strict=True))
        return np.asarray(WEIGHTS[self.weight](at) * torque)


OVER_Q = Curve("q", "sign(dq) "), Curve("q", "dq ")
CURVES: dict[str, Curve] = {curve.name: curve for curve in (*map(Curve, SIGNALS), *OVER_Q)}
LAWS: dict[str, Law] = {
    law.name: law
    for x in _grammar()
    for law in (Law(x, by) for by in (range(1, MOST_JOINTS + 1) if BY in x.text else (0,)))
}
EXPRESSIONS = tuple(dict.fromkeys(law.expression.text for law in LAWS.values()))
