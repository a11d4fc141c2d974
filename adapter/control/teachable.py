"""What a recording can teach of an arm, before anything is learned from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, sosfiltfilt

from adapter.control.information import Expected, Information
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm
from adapter.screening.timing import HOLE_PERIODS
from drivers.files.mcap import Log
from drivers.interface import DriverError

CUTOFF_HZ, OF_RATE = 10.0, 0.2  # of the smoothing: what arms move at, and of the rate where slower
SHORT_S = 10.0  # of motion; periodic motions that show an arm take 10 s and more
RESTS = 0.05  # rad/s, a joint that is never faster rests
REVERSALS = 2  # of a joint, from which on friction and offset come apart
SHORTEST = 30  # samples of a stretch that is used


@dataclass(frozen=True)
class Teachable:
    """Attributes:
    rank: combinations of parameters that the motion tells more of than was believed before.
    full_rank: those that torques of this arm depend on at all.
    expected: standard deviation of every parameter.
    torque_std: (n,) N m, what no parameters explain of the torques.
    missing: what keeps the rest from being learned, one sentence each.
    """

    rank: int
    full_rank: int
    expected: Expected
    torque_std: Array
    missing: tuple[str, ...]


def teachable(log: Log, model: SelfModel) -> Teachable:
    """Predict what a recording teaches, from its motion, rate and noise.

    Args:
        log: with the joints of the model in its order.
        model: as documented.

    Raises:
        DriverError: too short, or without torques.
    """
    signals, moving_s = _smoothed(log)
    q, dq, ddq, tau = signals
    blind = Information(model)
    Y = blind.regressor(q, dq, ddq)
    rows = Y.reshape(-1, Y.shape[2]) @ blind.basis
    x = np.linalg.lstsq(rows, tau.ravel(), rcond=None)[0]
    left = tau - (rows @ x).reshape(tau.shape)
    std = np.maximum(np.sqrt((left**2).mean(axis=0)), 1e-6)
    told = Information(model, torque_std=std)
    information = len(q) * told.mean(q, dq, ddq)
    whitened = np.linalg.solve(told.prior, information)
    rank = int((np.linalg.eigvals(whitened).real > 1.0).sum())
    arm = RigidArm.of(model)
    still = np.zeros_like(q)
    moved = arm.torque(q, dq, ddq) - arm.torque(q, still, still)
    missing = _missing(model.tree.joint_names, dq, np.sqrt((moved**2).mean(axis=0)), std)
    if moving_s < SHORT_S:
        missing = [f"too short: {moving_s:.1f} s of motion; {SHORT_S:g} s and more tell", *missing]
    expected = told.expected(information, 0.05)  # of each usual size
    return Teachable(rank, told.basis.shape[1], expected, std, tuple(missing))


def _missing(names: tuple[str, ...], dq: Array, moved: Array, std: Array) -> list[str]:
    fastest = np.abs(dq).max(axis=0)
    ways = [np.sign(speed[np.abs(speed) > RESTS]) for speed in dq.T]
    turns = [int((way[1:] != way[:-1]).sum()) for way in ways]
    resting = [name for name, speed in zip(names, fastest, strict=True) if speed < RESTS]
    one_way = [n for n, k in zip(names, turns, strict=True) if k < REVERSALS and n not in resting]
    slow = [
        f"{n} ({a:.2g} of {s:.2g} N m)"
        for n, a, s in zip(names, moved, std, strict=True)
        if a < s and n not in resting
    ]
    said = []
    if resting:
        said.append(f"rests (below {RESTS} rad/s): {', '.join(resting)}; friction does not show")
    if one_way:
        said.append(
            f"fewer than {REVERSALS} reversals: {', '.join(one_way)}; friction and offset "
            "do not come apart"
        )
    if slow:
        said.append(
            f"too slow, torque of motion below the noise: {', '.join(slow)}; inertias hardly show"
        )
    return said


def _smoothed(log: Log) -> tuple[list[Array], float]:
    """q, dq, ddq, tau (k, n), as many as are independent, and seconds of motion."""
    good = np.isfinite(log.q).all(axis=1) & np.isfinite(log.tau).all(axis=1)
    order = np.argsort(log.stamp_ns[good], kind="stable")
    stamps, first = np.unique(log.stamp_ns[good][order], return_index=True)
    q, tau = log.q[good][order][first], log.tau[good][order][first]
    if len(stamps) < SHORTEST:
        raise DriverError(f"{log.path}: {len(stamps)} samples of q and tau; need {SHORTEST}")
    seconds = (stamps - stamps[0]) * 1e-9
    period_s = float(np.median(np.diff(seconds)))
    cutoff_hz = min(CUTOFF_HZ, OF_RATE / period_s)
    every = max(1, round(0.5 / (cutoff_hz * period_s)))
    found = []
    holes = np.flatnonzero(np.diff(seconds) > HOLE_PERIODS * period_s) + 1
    for part in np.split(np.arange(len(stamps)), holes):
        if len(part) >= SHORTEST:
            # On an even grid, all smoothed alike
            t = seconds[part]
            grid = np.arange(t[0], t[-1], period_s)
            sections = butter(2, cutoff_hz, fs=1.0 / period_s, output="sos")
            smooth = []
            for signal in (q[part], tau[part]):
                even = np.column_stack([np.interp(grid, t, x) for x in signal.T])
                smooth.append(sosfiltfilt(sections, even, axis=0))
            dq = np.gradient(smooth[0], period_s, axis=0)
            table = [smooth[0], dq, np.gradient(dq, period_s, axis=0), smooth[1]]
            found.append([x[::every] for x in table])
    if not found:
        raise DriverError(f"{log.path}: no {SHORTEST} samples follow each other without a hole")
    whole = [np.concatenate(x) for x in zip(*found, strict=True)]
    moving = (np.abs(whole[1]) > RESTS).any(axis=1)
    return whole, float(moving.sum()) * every * period_s
