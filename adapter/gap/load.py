"""What the hand carries: the load of a recording, as the numbers that a robot asks for.

The payload's ten parameters, friction, offsets and motor inertia of every joint, and the errors of
the documented inertias are judged together (`adapter.judgement`). With a second recording without
the load all but the load is common to both, so that the arm's own errors cancel.

Formats of robots' own tools. libfranka: `setLoad(mass, F_x_Cload, load_inertia)`, flange frame,
inertia about the centre of mass, column by column. Franka Desk: the end effector's JSON file, the
same numbers with the place of the tool, 4x4, column by column. Universal Robots: `set_payload(m,
cog)`, and since PolyScope 5.10 `set_target_payload(m, cog, [Ixx, Iyy, Izz, Ixy, Ixz, Iyz])`, in
axes of the flange.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapter.effects.active import SHOWN_STD
from adapter.gap.hand import hand_frame
from adapter.gap.long_recording import Survey, is_long
from adapter.judgement.posterior import SEGMENTS, Moments, Part, judge, moments_of
from adapter.judgement.priors import DOCUMENTED_SHARE, positive, prior_std
from adapter.model.inertia import body_from_theta, move_theta, six_from_tensor, tensor_from_six
from adapter.model.numbers import plus_minus
from adapter.model.self_model import FixedFrame, SelfModel
from adapter.model.spatial import Array
from adapter.screening import screen
from adapter.screening.likelihood import Rows
from adapter.signals.matching import present
from adapter.signals.validation import GRID_S
from drivers.files.mcap import Log

COM_M, INERTIA_SHARE = 0.05, 0.5  # standard deviations above which a number is not shown
EDGE, EVERY = 60, 10  # ms at either end, where the filter has no neighbours; between rows
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
        return self.mass > SHOWN_STD * self.mass_std

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
    share = inertia_prior or (DOCUMENTED_SHARE if empty is None else 0.2)  # of the inertias
    taken = [_taken(one, model) for one in logs]
    notes += [note for x in taken for note in x.notes]
    std, n, whole = (
        prior_std(model.theta, model.tree.slides, share),
        model.tree.n,
        taken[0].moments.together(),
    )
    parts = [Part(whole, np.arange(len(std)), taken[0].alive)]
    if empty is not None:  # the same arm: its load is nothing, its static friction another
        at = np.arange(len(std))
        at[:10], at[-n:] = len(std) + np.arange(10), len(std) + 10 + np.arange(n)
        parts.append(Part(taken[1].moments.together(), at, taken[1].alive))
        std = np.r_[std, np.zeros(10), std[-n:]]
    found = judge(parts, std, positive(std, n))
    if taken[0].moves:
        notes += _changed(taken[0].moments, parts, std, 1e-9 * (log.end_ns - log.begin_ns))
    load = load_of(found.x[:10], found.covariance[:10, :10], riding)
    before = np.sqrt(whole.size / whole.rows)
    left, before = (taken[0].alive * x for x in (found.left_nm, before))
    return replace(load, left_nm=left, before_nm=before, notes=tuple(dict.fromkeys(notes)))


def plain_load(log: Log, model: SelfModel, share: float) -> HandLoad:
    """The load of a screened recording by the posterior alone, without a search.

    Args:
        share: by which the model's inertias may be off, one standard deviation.
    """
    std = prior_std(model.theta, model.tree.slides, share)
    whole, held = _of_all(log, model).together(), positive(std, model.tree.n)
    found = judge([Part(whole, np.arange(len(std)), np.ptp(log.tau, axis=0) > 0.0)], std, held)
    return load_of(found.x[:10], found.covariance[:10, :10], hand_frame(model))


class _Taken(NamedTuple):
    """A recording as it is judged, whether the arm moves in it, and notes."""

    moments: Moments
    moves: bool
    alive: NDArray[np.bool_]
    notes: list[str]


def _taken(log: Log, model: SelfModel) -> _Taken:
    """Raises RecordingRefused."""
    own, survey = log, None
    if is_long(log):
        survey = Survey.of(screen.of_this_robot(log, model))
        own = survey.busiest(log)
    own, _, said = screen.cleaned(own, model)
    smoothed, torque = screen.smoothed_rows(own), screen.Judged()
    moves = float((np.abs(smoothed[1]).max(axis=1) > screen.MOVES_DQ).sum()) * GRID_S >= 1.0  # s
    more = ["the arm hardly moves: static friction in its joints counts as load"]
    if moves:  # asked of the arm without what is fitted: a load of 90 kg explains N cm
        dead = screen.silent(own, model.tree.joint_names)
        torque = screen.judged(own, model, smoothed)
        more = dead + torque.notes
    alive, notes = np.ptp(own.tau, axis=0) > 0.0, own.warnings + said + more
    own = torque.in_time(own if survey is None else survey.log)
    moments = _of_all(own, torque.mounted(model))
    left_s = float(moments.rows.sum()) * moments.period_s
    if left_s < 0.3:  # of rows
        raise screen.RecordingRefused(
            screen.RecordingFault.DATA,
            f"{log.path}: its pauses leave {left_s:.2g} s to weigh by; record at least "
            f"{screen.SHORTEST_S:g} s without one.",
        )
    return _Taken(moments, moves, alive, notes)


def _of_all(log: Log, model: SelfModel) -> Moments:
    """What a recording tells, piece by piece."""
    return reduce(Moments.with_more, (_moments(x, model, log) for x in log.pieces()))


def _moments(piece: Log, model: SelfModel, whole: Log) -> Moments:
    """What a piece of a recording tells."""
    q, dq, ddq, tau = (x[EDGE:-EDGE:EVERY] for x in screen.smoothed_rows(piece))
    begin, end = (
        (stamp - whole.first_ns) / max(whole.end_ns - whole.first_ns, 1)
        for stamp in (piece.first_ns, piece.end_ns)
    )
    at = np.linspace(begin, end, len(q))
    return moments_of(model, Rows(q, dq, ddq, tau), EVERY * GRID_S, at)


def _changed(segments: Moments, parts: Sequence[Part], std: Array, span_s: float) -> list[str]:
    """That the hand's load clearly is another from some time on: it is judged as two.

    Args:
        segments: of the recording that is the first of the parts.
    """
    whole, found = parts[0], (CLEAR, 0.0, 0.0)
    later = np.r_[len(std) + np.arange(10), whole.at[10:]]
    two, weigh = np.r_[std, std[:10]], np.zeros(len(std) + 10)
    weigh[0], weigh[len(std)] = -1.0, 1.0
    for segment in range(1, SEGMENTS):
        before = whole._replace(moments=segments.together(slice(segment)))
        after = whole._replace(moments=segments.together(slice(segment, None)), at=later)
        if not (before.moments.rows and after.moments.rows):
            continue
        trial = judge([before, after, *parts[1:]], two, positive(two, len(whole.alive)))
        mass = float(weigh @ trial.x)
        clear = abs(mass) / float(np.sqrt(weigh @ trial.covariance @ weigh))
        if abs(mass) > LEAST_CHANGE_KG:
            found = max(found, (clear, span_s * segment / SEGMENTS, mass))
    clear, at, mass = found
    if not at:
        return []
    return [
        f"the hand holds some {abs(mass):.2g} kg {'more' if mass > 0.0 else 'less'} from about "
        f"{at:.0f} s on, and what is told is of the whole recording; `adapter gap` dates it, "
        "`adapter replay` weighs what is held at the end"
    ]


def _body(theta: Array) -> Array:
    """Mass, centre and the six numbers of the inertia about it (10,)."""
    mass, com, inertia = body_from_theta(theta)
    return np.r_[mass, com, six_from_tensor(inertia)]


def load_of(theta: Array, covariance: Array, frame: FixedFrame) -> HandLoad:
    """A load from its ten parameters (10,) about the last link's origin, and how well it is known.

    Args:
        covariance: (10, 10) of the parameters; frame: in whose axes the load is told.
    """
    back = frame.rotation.T, -frame.rotation.T @ frame.position
    turn = move_theta(np.eye(10), *back)  # row i: of a unit of parameter i
    theta, covariance = theta @ turn, turn.T @ covariance @ turn
    mass, com, inertia = body_from_theta(theta)
    steps = 1e-6 * np.diag(np.sqrt(np.diagonal(covariance)))
    slopes = np.array([(_body(theta + d) - _body(theta - d)) / (2.0 * d.max()) for d in steps])
    std = np.sqrt(np.diagonal(slopes.T @ covariance @ slopes))
    values, axes = np.linalg.eigh(0.5 * np.trace(inertia) * np.eye(3) - inertia)
    spread = (axes * np.maximum(values, 0.0)) @ axes.T  # of the nearest that a body may have
    return HandLoad(
        float(mass),
        com,
        np.trace(spread) * np.eye(3) - spread,
        float(std[0]),
        std[1:4],
        tensor_from_six(std[4:]),
        frame.name,
    )


_SIX = ("XX", "XY", "XZ", "YY", "YZ", "ZZ")
NOT_SHOWN = "not shown"


def sentence(load: HandLoad) -> str:
    """What the hand carries, with standard deviations."""
    mass = f"{plus_minus(load.mass, load.mass_std)} kg"
    if not load.is_there:
        less = load.mass < -3.0 * load.mass_std
        why = "the hand is lighter than the model says, or its inertias are wrong"
        return f"no load is shown: {mass}" + (f"; {why}" if less else "")
    where = NOT_SHOWN + " by this log; turn the hand about several axes"
    if load.com_shown:
        pairs = zip("xyz", 1e3 * load.com, 1e3 * load.com_std, strict=True)
        where = ", ".join(f"{axis} {at:.1f} ± {std:.1f}" for axis, at, std in pairs) + " mm"
    turning = NOT_SHOWN + " by this log; turn the hand faster, about several axes"
    if load.inertia_shown:
        numbers = zip(
            _SIX, *(six_from_tensor(x) for x in (load.inertia, load.inertia_std)), strict=True
        )
        turning = ", ".join(f"{key} {x:.2g} ± {std:.1g}" for key, x, std in numbers) + " kg m²"
    return (
        f"the hand carries {mass}; centre of mass, in {load.frame}: {where}; inertia about it: "
        f"{turning}"
    )


def robot_lines(load: HandLoad) -> dict[str, str]:
    """What to give to each robot, by its name; nothing where the centre is not shown."""
    if not load.com_shown:
        return {}
    com, six = _rounded(load.com), _rounded(_inertia(load)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
    mass, columns = round(load.mass, 4), _columns(load)
    braces = ", ".join("{{" + ", ".join(map(str, x)) + "}}" for x in (com, columns))
    return {
        "libfranka": f"robot.setLoad({mass}, {braces});",
        "Franka Desk": json.dumps(desk(load)),
        "UR": f"set_payload({mass}, {com})",
        "UR, PolyScope 5.10 on": f"set_target_payload({mass}, {com}, {six})",
    }


def desk(load: HandLoad) -> dict[str, Any]:
    """An end effector as Franka Desk reads it; its own place is left as it is."""
    return {
        "mass": round(load.mass, 4),
        "centerOfMass": _rounded(load.com),
        "transformation": np.eye(4).ravel().tolist(),
        "inertia": _columns(load),
    }


def as_json(load: HandLoad) -> dict[str, Any]:
    """Everything, ready for JSON; None for what is not shown."""
    com, inertia = load.com_shown, load.inertia_shown
    return {
        "frame": load.frame,
        "is_there": load.is_there,
        "mass_kg": load.mass,
        "mass_std_kg": load.mass_std,
        "com_m": load.com.tolist() if com else None,
        "com_std_m": load.com_std.tolist() if com else None,
        "inertia_kg_m2": load.inertia.tolist() if inertia else None,
        "inertia_std_kg_m2": load.inertia_std.tolist() if inertia else None,
        "set_load": {
            "mass": load.mass,
            "F_x_Cload": load.com.tolist(),
            "load_inertia": _inertia(load).ravel(order="F").tolist(),
        }
        if com
        else None,
        "desk": desk(load) if com else None,
        "robots": robot_lines(load),
        "torque_rmse_nm": {"before": load.before_nm.tolist(), "after": load.left_nm.tolist()},
        "sentence": sentence(load),
        "notes": list(load.notes),
    }


def _inertia(load: HandLoad) -> Array:
    """(3, 3) kg m², zeros where it is not shown: robots take a point's."""
    return load.inertia if load.inertia_shown else np.zeros((3, 3))


def _columns(load: HandLoad) -> list[float]:
    return _rounded(_inertia(load).ravel(order="F"), 6)


def _rounded(values: Array, digits: int = 5) -> list[float]:
    return [round(float(value), digits) + 0.0 for value in values]
