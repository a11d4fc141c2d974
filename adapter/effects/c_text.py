"""A learned arm's torque as one C file: its bodies' inverse dynamics and the laws of its effects.

Nothing is written twice: the compiled kernels of `physics.kernels` and the effects' own laws run
once on numbers that write down what is done to them, and what they wrote down is the C. Frames,
inertias and parameters are numbers in it; what is multiplied by zero is not there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from types import FunctionType, SimpleNamespace
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from adapter.effects.active import Active, lasting_effects, with_bodies
from adapter.effects.base import BodyEffect, JointTorque
from adapter.effects.bristle_friction import Rubs
from adapter.effects.by_joint import DRUM_M, JointSignals
from adapter.effects.robots import RobotText, in_words, kept_lines
from adapter.errors import ModelError
from adapter.model.self_model import SelfModel, theta_doubt
from adapter.model.urdf_text import NO_PLACE, Kept
from adapter.physics.kernels import (
    JointMotion,
    base_at_rest,
    frames_of,
    inverse_dynamics,
    link_motion,
)

FORMS: dict[Any, str] = {
    np.add: "{} + {}",
    np.subtract: "{} - {}",
    np.multiply: "{} * {}",
    np.divide: "{} / {}",
    np.negative: "-{}",
    np.square: "{0} * {0}",
    np.power: "pow({}, {})",
    np.absolute: "fabs({})",
    np.sign: "({0} > 0.0) - ({0} < 0.0)",
    np.maximum: "fmax({}, {})",
    np.minimum: "fmin({}, {})",
    np.greater: "{} > {}",
    np.less: "{} < {}",
    np.where: "{} != 0.0 ? {} : {}",
} | {f: f"{f.__name__}({{}})" for f in (np.sin, np.cos, np.tanh, np.exp, np.sqrt)}


TEMPLATE = Path(__file__).with_name("arm.c")  # with @NAMES@ where something is to be filled in
NEUTRAL = {np.add: 0.0, np.subtract: 0.0, np.multiply: 1.0, np.divide: 1.0}  # what changes nothing


class Program:
    """Lines of C, each of which names one operation on numbers that were named before."""

    def __init__(self) -> None:
        self._known: dict[str, Traced] = {}
        self._lines: list[tuple[str, str, tuple[str, ...]]] = []  # name, what it is, of which

    def line(self, form: str, values: Sequence[Traced | float]) -> Traced:
        """The number that an operation gives."""
        texts = [x.name if isinstance(x, Traced) else f"({float(x)!r})" for x in values]
        text = form.format(*texts)
        if text not in self._known:
            name = f"x{len(self._lines)}"
            of = tuple(x.name for x in values if isinstance(x, Traced))
            self._lines.append((name, text, of))
            self._known[text] = Traced(self, name)
        return self._known[text]

    def inputs(self, name: str, count: int) -> Any:
        """(count,) the numbers of an array that the C is given."""
        return np.array([Traced(self, f"{name}[{k}]") for k in range(count)], dtype=object)

    def body(self, out: str, values: Sequence[Traced | float], sign: str = "=") -> str:
        """What fills an array of C with these values, without what none of them needs."""
        texts = [x.name if isinstance(x, Traced) else repr(float(x)) for x in values]
        needed, lines = set(texts), []
        for name, text, of in reversed(self._lines):
            if name in needed:
                lines.append(f"    const double {name} = {text};")
                needed.update(of)
        ends = [f"    {out}[{k}] {sign} {text};" for k, text in enumerate(texts)]
        return "\n".join([*reversed(lines), *ends])


class Traced(NDArrayOperatorsMixin):
    """A number that only the C knows: what is done to it becomes a line of its program."""

    def __init__(self, program: Program, name: str) -> None:
        self.program, self.name = program, name

    def __bool__(self) -> bool:
        raise TypeError("a law branches on a number that only the C knows")

    def __array_ufunc__(self, ufunc: Any, method: str, *given: Any, **more: Any) -> Any:
        if method != "__call__" or more.keys() - {"out"} or ufunc not in FORMS:
            return NotImplemented
        a, *rest = values = [_number(x) for x in given]
        b = rest[0] if rest else None
        if ufunc is np.multiply and (_is(a, 0.0) or _is(b, 0.0)):
            return 0.0
        if ufunc in (np.add, np.multiply) and _is(a, NEUTRAL[ufunc]):
            return b
        if ufunc in NEUTRAL and _is(b, NEUTRAL[ufunc]):
            return a
        if ufunc is np.power and _is(b, 2.0):
            return self.program.line(FORMS[np.square], [a])
        return self.program.line(FORMS[ufunc], values)

    def __array_function__(self, function: Any, _: Any, given: Any, __: Any) -> Any:
        if function in (np.ones_like, np.zeros_like):
            return float(function is np.ones_like)
        if function is np.full_like:
            return given[1]
        if function is np.where:
            return self.program.line(FORMS[function], [_number(x) for x in given])
        return NotImplemented


def _number(x: Any) -> Traced | float:
    """A number as C has it. Raises TypeError for tables."""
    if isinstance(x, np.ndarray):
        if x.size != 1:
            raise TypeError("a law over a table")
        x = x.item()
    return x if isinstance(x, Traced) else float(x)


def _is(x: Any, value: float) -> bool:
    return isinstance(x, float) and x == value


def _plain(kernel: Any) -> Callable[..., Any]:
    """A compiled function as Python runs it, on numbers of any kind, with those that it calls."""
    function = kernel.py_func
    called = {x: function.__globals__.get(x) for x in function.__code__.co_names}
    own = {name: _plain(x) for name, x in called.items() if hasattr(x, "py_func")}
    arrays = SimpleNamespace(
        empty=lambda shape: np.empty(shape, dtype=object),
        zeros=lambda shape: np.full(shape, 0.0, dtype=object),
    )
    names = {**function.__globals__, **own, "math": np, "np": arrays}
    return FunctionType(function.__code__, names)


def c_text(model: SelfModel, onto: None = None, alone: bool = True) -> RobotText:
    """The arm's torque in C99: `adapter_torque` and its parts, without allocation.

    Raises:
        ModelError: a floating base.
    """
    if model.tree.floating:
        raise ModelError(f"{model.name}: its base floats; C is written of fixed-base arms")
    bare = with_bodies(model)
    laws = _Laws(bare)
    acting = lasting_effects(model.effects, model.tree.n)
    bodies = {x.effect.name: None for x in acting if isinstance(x.effect, BodyEffect)}
    kept = (*(Kept(name, "", None) for name in bodies), *laws.kept)
    told = [
        f"The torque of {model.name}, written by `adapter export --c`.",
        f"Joints, in order: {', '.join(model.tree.joint_names)}.",
        *[f"theta: {theta_doubt(model)}"] * bool(theta_doubt(model)),
        "In it: the bodies with tool, load and mounting, and of effects:",
        *(f"  {line}" for line in kept_lines(kept)),
    ]
    n, bent = model.tree.n, laws.bent
    steps = (f"q[{j}] - state->q[{j}], {s0!r}" for j, s0 in bent)
    slots = ((f"state->bent[{k}]", step) for k, step in enumerate(steps))
    wind = [f"        {slot} = adapter_wound({slot}, {step});" for slot, step in slots]
    parts = {
        "HEAD": "\n".join(" * " + " ".join(x.splitlines()).replace("*/", "* /") for x in told),
        "JOINTS": str(n),
        "BENT": str(max(len(bent), 1)),
        "RIGID": _rigid(bare),
        "WIND": "\n".join(wind),
        "LAWS": laws.body,
    }
    text = TEMPLATE.read_text(encoding="utf-8")
    for key, part in parts.items():
        text = text.replace(f"@{key}@", part)
    return RobotText(text, None, kept, ())


def _rigid(model: SelfModel) -> str:
    """C of the bodies' inverse dynamics."""
    n, program = model.tree.n, Program()
    joints = JointMotion(*(program.inputs(name, n) for name in JointMotion._fields))
    frames = frames_of(model.tree, model.lam)
    frames = frames._replace(R0=frames.R0.astype(object), p=frames.p.astype(object))
    theta, base = model.theta_with_tool().astype(object), base_at_rest(model.gravity).astype(object)
    motion, tau = np.empty((n, 12), dtype=object), np.empty(n, dtype=object)
    _plain(link_motion)(frames, joints, base, motion)
    _plain(inverse_dynamics)(frames, theta, joints.q, motion, base, tau)
    return program.body("tau", list(tau))


class _Laws:
    """C of what a model's joints have beside the bodies.

    Attributes:
        body: of it; kept: how much of which effect is in it.
        bent: joint (from 0) and way s0 (rad) of each friction with bristles.
    """

    def __init__(self, model: SelfModel) -> None:
        n, program = model.tree.n, Program()
        q, dq, ddq, load = (program.inputs(x, n) for x in ("q", "dq", "ddq", "load"))
        drums = np.where(model.tree.slides, DRUM_M, 1.0).tolist()
        each = zip(q, dq, ddq, load, drums, strict=True)
        self._joints = [JointSignals(*x[:4], drum=x[4]) for x in each]
        self._program, self.bent = program, list[tuple[int, float]]()
        sums: list[Any] = [0.0] * n
        self.kept: list[Kept] = []
        for active in lasting_effects(model.effects, n):
            part = None
            try:
                if any(map(np.any, active.values.values())):
                    sums[active.joint] = sums[active.joint] + self._torque(active)
            except TypeError:  # no law of a joint's signals, or one that C does not hold
                part = NO_PLACE
            if part is None or active.shown:
                self.kept.append(Kept(active.effect.name, in_words(active, model.tree), part))
        self.body = program.body("tau", sums, "+=")

    def _torque(self, active: Active) -> Traced | float:
        """A law of one joint. Raises TypeError where it is none that C can hold."""
        effect = active.effect
        own = self._joints[effect.by - 1 if effect.by else active.joint]
        values = {key: x if np.ndim(x) else float(x) for key, x in active.values.items()}
        if not isinstance(effect, JointTorque):
            raise TypeError(effect.name)
        if not isinstance(effect, Rubs):
            return _number(np.asarray(effect.law(own, values), object))
        s0, z = effect.bristles(values), _number(own.direction)
        if s0 is not None:
            z = self._program.line(f"state ? state->bent[{len(self.bent)}] : {{}}", [z])
            self.bent.append((active.joint, s0))
        return _number(np.asarray(effect.level(own.dq, values) * z, object))
