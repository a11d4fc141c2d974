"""Twins of logs that people hand over: short and ragged, of an arm that no model describes well.

The nominal model is the documented Panda. The simulated arm is another unit (inertias 5 to 30 %
off), its friction has a memory (LuGre bristles with Stribeck's drop), its hand may hold a load from
the first sample on, and its recorder loses, repeats and delays. Sizes are those seen on about 170
recordings of five real arms.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from drivers.files.mcap import Log
from sim.noise import levels_of
from sim.truth import FLANGE_M, Array, Truth, panda, theta_of, wrong_body
from tests.hidden.motion import MARGIN_RAD, hand, points
from tests.hidden.record import log_of
from tests.hidden.sizes import (
    Bristles,
    box_moments,
    draw_bristles,
    log_uniform,
    sizes,
    wrist_shares,
)
from tests.hidden.trial import first_order

STREAM, NOISE_STREAM = 36, 37  # apart from those of the other trials
STEP_S = 1e-3  # of the motion that is recorded
SECONDS = (2.0, 7.0)
MODEL_ERROR, LAST_ERROR = (0.05, 0.3), 0.05  # of links 1 to n - 1; of the last one
LOAD_KG = (0.3, 4.4)
LOAD_BEYOND_M, LOAD_ASIDE_M, LOAD_HALF_M = (0.0, 0.15), 0.05, (0.02, 0.06)
OFFSET_NM = 0.3
DISTURBANCE_NM, DISTURBANCE_HZ = (0.05, 0.3), (0.2, 5.0)
HOLES, HOLE_S = (2, 8), (17e-3, 53e-3)
PERIOD_S, LONG_PERIOD_S, LONG_SHARE = (0.7e-3, 1.3e-3), (1.3e-3, 8.8e-3), 0.02
MOTIONS = ("points", "sines", "hand")
REACH_RAD = (0.2, 1.0)
SPEED_SHARE = 0.6  # of a joint's limit, at most
SINES, SINES_HZ = 5, (0.1, 0.9)


@dataclass(frozen=True, eq=False)
class Twin:
    """What a seed decides, and of several logs of one arm its numbers.

    Attributes:
        motion_number, load_number: which motion and which load of the arm.
        arm: the simulated arm, what it carries included; nominal: the documented one.
        load_kg: what it carries from the first sample on; 0 for nothing. load_at: (3,) its centre
            in the last link's frame, m.
        q: (m, n) rad, what it is told to do, a row each `STEP_S`; kind: of `MOTIONS`.
        friction: of its joints. offset: (n,) N m of its torque sensors.
        sensor_hz: (n,) where their low-pass begins. dq_late_s: of the velocities behind positions.
    """

    seed: int
    arm: Truth
    nominal: Truth
    load_kg: float
    load_at: Array
    q: Array
    kind: str
    friction: Bristles
    offset: Array
    sensor_hz: Array
    dq_late_s: float
    motion_number: int = 0
    load_number: int = 0

    @property
    def motion(self) -> tuple[Array, Array, Array]:
        """q, dq, ddq (m, n) of what it is told."""
        dq = np.gradient(self.q, STEP_S, axis=0)
        return self.q, dq, np.gradient(dq, STEP_S, axis=0)

    def as_dict(self) -> dict[str, Any]:
        """What a judge needs."""
        return {
            "seed": self.seed,
            "kind": self.kind,
            "seconds": STEP_S * len(self.q),
            "load_kg": self.load_kg,
            "load_at": self.load_at.tolist(),
        }


def draw_twin(seed: int, motion: int = 0, load: int = 0) -> Twin:
    """The twin of a seed; of the same arm, any number of motions and of loads."""
    rng = np.random.default_rng([seed, STREAM])
    nominal = panda()
    n = nominal.n
    error = np.append(np.full(n - 1, rng.uniform(*MODEL_ERROR)), LAST_ERROR)
    theta = np.empty((n, 10))
    for k, (body, size) in enumerate(zip(nominal.theta, error, strict=True)):
        other = wrong_body(body, size, rng)
        theta[k] = body * (1 + size * rng.standard_normal()) if other is None else other
    load_kg, body, load_at = _held(rng)
    q, kind = _motion(rng, nominal)
    if load:
        load_kg, body, load_at = _held(np.random.default_rng([seed, STREAM, 0, load]))
    if motion:
        q, kind = _motion(np.random.default_rng([seed, STREAM, motion]), nominal)
    theta[-1] += body
    return Twin(
        seed=seed,
        arm=nominal.with_changes(theta=theta, ready=q[0]),
        nominal=nominal,
        load_kg=load_kg,
        load_at=load_at,
        q=q,
        kind=kind,
        friction=draw_bristles(rng, n),
        offset=wrist_shares(n) * OFFSET_NM * rng.standard_normal(n),
        sensor_hz=sizes(rng, (15.0, 80.0), n),  # where the torque sensor's low-pass begins
        dq_late_s=float(rng.uniform(0.0, 2.7e-3)),
        motion_number=motion,
        load_number=load,
    )


def _held(rng: np.random.Generator) -> tuple[float, Array, Array]:
    """What the hand holds, a box: mass kg, (10,) about the last link's origin, centre (3,) m."""
    mass = 0.0 if rng.random() < 0.3 else log_uniform(rng, LOAD_KG)  # some carry nothing
    x, y = rng.uniform(-LOAD_ASIDE_M, LOAD_ASIDE_M, 2)
    c = np.array([x, y, FLANGE_M + rng.uniform(*LOAD_BEYOND_M)])
    xx, yy, zz = box_moments(mass, rng.uniform(*LOAD_HALF_M, 3)).tolist()
    return mass, theta_of(mass, c.tolist(), [xx, 0.0, 0.0, yy, 0.0, zz]), c


def _motion(rng: np.random.Generator, arm: Truth) -> tuple[Array, str]:
    """Positions (m, n), slower where a joint would come near its limits."""
    kind = str(rng.choice(MOTIONS))
    t = np.arange(0.0, rng.uniform(*SECONDS), STEP_S)
    shape = {"points": points, "sines": _sines, "hand": hand}[kind](rng, t, arm.n)
    middle = arm.ready + rng.uniform(-0.3, 0.3, arm.n)
    free = np.minimum(middle - arm.limits.lower, arm.limits.upper - middle) - MARGIN_RAD
    reach = np.minimum(rng.uniform(*REACH_RAD, arm.n), free)
    shape = shape * reach / np.maximum(np.abs(shape).max(axis=0), 1e-9)
    speed = np.abs(np.gradient(shape, STEP_S, axis=0)).max(axis=0)
    return middle + shape * np.minimum(1.0, SPEED_SHARE * arm.limits.velocity / speed.max()), kind


def _sines(rng: np.random.Generator, t: Array, n: int) -> Array:
    w = 2 * np.pi * rng.uniform(*SINES_HZ, (SINES, 1, n))
    sines = np.sin(w * t[:, None] + rng.uniform(0, 2 * np.pi, (SINES, 1, n)))
    return np.asarray((rng.standard_normal((SINES, 1, n)) / np.sqrt(w) * sines).sum(axis=0))


def recorded(twin: Twin, q: Array, dq: Array, tau: Array) -> Log:
    """What the recorder makes of clean q, dq and drive torque (m, n), a row each `STEP_S`."""
    rng = np.random.default_rng([twin.seed, NOISE_STREAM, twin.motion_number, twin.load_number])
    m, n = q.shape
    keep = np.exp(-2 * np.pi * twin.sensor_hz * STEP_S)
    low = [lfilter([1 - k], [1, -k], x, zi=[k * x[0]])[0] for k, x in zip(keep, tau.T, strict=True)]
    pace = float(np.exp(-2 * np.pi * log_uniform(rng, DISTURBANCE_HZ) * STEP_S))
    coloured = first_order(rng.standard_normal((m, n)), pace)
    tau = (
        np.array(low).T + twin.offset + wrist_shares(n) * rng.uniform(*DISTURBANCE_NM, n) * coloured
    )
    t, stamps, rows = STEP_S * np.arange(m), *_stamps(rng, STEP_S * (m - 1))
    late = {0: 0.0, 1: twin.dq_late_s, 2: 0.0}
    signals = [
        np.array([np.interp(stamps[rows] - late[i], t, column) for column in x.T]).T
        for i, x in enumerate((q, dq, tau))
    ]
    levels = levels_of("real")
    sizes = levels.q_above_50hz, levels.dq_above_50hz, levels.tau_above_50hz
    q, dq, tau = (
        x + (np.asarray(size) * rng.standard_normal((len(stamps), n)))[rows]
        for x, size in zip(signals, sizes, strict=True)
    )
    step = np.asarray(levels.tau_step)
    start_ns = int(rng.integers(0, 10**9)) * 10**9
    stamp_ns = start_ns + np.round(1e9 * stamps).astype(np.int64)
    return log_of(twin.arm.joint_names, stamp_ns, q, dq, np.round(tau / step) * step)


def _stamps(rng: np.random.Generator, end_s: float) -> tuple[Array, NDArray[np.intp]]:
    """Stamps (r,) s, and for each row the one whose values it carries: its own, or the last's."""
    count = round(1.2 * end_s / STEP_S)
    steps = rng.uniform(*PERIOD_S, count)
    long = rng.random(count) < LONG_SHARE
    steps[long] = rng.uniform(*LONG_PERIOD_S, int(long.sum()))
    inside = round(0.8 * end_s / STEP_S)  # with the long steps the log has about 0.9 so many
    holes = rng.choice(inside, int(rng.integers(HOLES[0], HOLES[1] + 1)), replace=False)
    steps[holes] += rng.uniform(*HOLE_S, len(holes))
    stamps = np.cumsum(steps)
    stamps = stamps[stamps < end_s]
    fresh = rng.random(len(stamps)) >= rng.uniform(0.06, 0.37)
    fresh[0] = True
    return stamps, np.maximum.accumulate(np.where(fresh, np.arange(len(stamps)), 0))
