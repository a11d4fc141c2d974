"""A real UR10's currents: gains fitted, held out on the last third, beside least squares.

    python tests/benchmarks/current_trials.py BAG URDF --per-ampere K1,...,K6

BAG tells torques in N m; divided by the drives' N m/A (13.5841, 14.2959, 11.3716, 11.2408, 11.7681,
11.7682 by its maker, unisa-acg/inverse-dynamics-solver) these are the currents `find_gap` sees.
Least squares is Pinocchio's regressor with the same columns and weights, on efforts times gains.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
from scipy.signal import butter, sosfiltfilt

from adapter.effects.robots import read_robot
from adapter.gap import GapSettings, find_gap
from adapter.signals.told import Told
from drivers.files.mcap import Log, read_log
from tests.helpers.benchmark import with_columns

SHARE, WIDE = 0.1, 100.0  # prior of inertias, of their kind's size; of all else
RATE_HZ, INDEPENDENT_HZ = 100.0, 20.0  # of the rows; of what the band holds
EDGE_S = 0.3


def smoothed(log: Log) -> tuple[np.ndarray, ...]:
    """t (m,), q, dq, ddq, tau (m, n) at 100 Hz, below 10 Hz."""
    stamps = 1e-9 * (log.stamp_ns - log.stamp_ns[0])
    new = np.r_[True, np.diff(stamps) > 0]
    t = np.arange(stamps[new][0], stamps[new][-1], 1e-3)
    sos = butter(4, 10.0, fs=1000.0, output="sos")
    q, dq, tau = (
        sosfiltfilt(
            sos, np.column_stack([np.interp(t, stamps[new], x) for x in table[new].T]), axis=0
        )
        for table in (log.q, log.dq, log.tau)
    )
    ddq = np.gradient(dq, 1e-3, axis=0)
    rows = slice(300, -300, round(1000.0 / RATE_HZ))
    return t[rows], q[rows], dq[rows], ddq[rows], tau[rows]


def least_squares(log: Log, urdf: Path, split_s: float) -> np.ndarray:
    """(n,) N m rms on what comes after split_s, learned from what comes before."""
    t, q, dq, ddq, tau = smoothed(log)
    model = pin.buildModelFromUrdf(str(urdf))
    data, n = model.createData(), model.nv
    Y = np.array(
        [pin.computeJointTorqueRegressor(model, data, *x) for x in zip(q, dq, ddq, strict=True)]
    )
    theta = np.array([body.toDynamicParameters() for body in model.inertias[1:]])
    own = [np.ones_like(dq), np.tanh(dq / 0.01), dq, ddq]
    columns = with_columns(Y, own)
    mass = np.maximum(theta[:, :1], 0.1)
    first = np.maximum(np.linalg.norm(theta[:, 1:4], axis=1, keepdims=True), 0.05 * mass)
    second = np.maximum(np.abs(theta[:, [4, 6, 9]].mean(axis=1, keepdims=True)), 0.05**2 * mass)
    kind = np.hstack([mass, *[first] * 3, *[second] * 6])
    prior = np.r_[SHARE * kind.ravel(), np.full(len(own) * n, WIDE)]
    left = tau - Y @ theta.ravel()
    before, after = t < split_s - EDGE_S, t > split_s + EDGE_S
    sigma = np.ones(n)
    for _ in range(4):
        weight = np.sqrt(INDEPENDENT_HZ / RATE_HZ) / sigma
        A = (columns[before] * weight[:, None]).reshape(-1, columns.shape[2])
        b = (left[before] * weight).ravel()
        x = np.linalg.solve(A.T @ A + np.diag(prior**-2), A.T @ b)
        error = left - columns @ x
        sigma = np.sqrt(np.mean(error[before] ** 2, axis=0))
    return np.asarray(np.sqrt(np.mean(error[after] ** 2, axis=0)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bag", type=Path)
    parser.add_argument("urdf", type=Path)
    parser.add_argument("--per-ampere", required=True)
    args = parser.parse_args()
    stated = np.array([float(x) for x in args.per_ampere.split(",")])
    model = read_robot(args.urdf)
    log = read_log(args.bag).select(list(model.tree.joint_names), [])
    log = replace(log, tau=log.tau / stated)
    split_s = 2.0 / 3.0 * 1e-9 * float(np.ptp(log.stamp_ns))
    settings = GapSettings(validate_from_s=split_s, told=Told(learn=True))
    found = find_gap([log], model, settings)
    assert found.torque_gains is not None
    gain = np.array(found.torque_gains["gain_nm_per_unit"])
    plain = least_squares(replace(log, tau=log.tau * gain), args.urdf, split_s)
    ours = np.asarray(found.after.torque_rmse_nm)
    with np.printoptions(precision=3, suppress=True, linewidth=120):
        print("gain over the stated one", gain / stated, found.torque_gains["shown"])
        print("held out, N m: gap", ours, "least squares", plain)
        print("over least squares", ours / plain)


if __name__ == "__main__":
    main()
