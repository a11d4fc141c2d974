"""The oracle of the hidden-effect trials: it knows which effect is there, and says how well the
data could possibly show it and what a fit of the right effect leaves.

Everything is at 25 Hz after a sharp zero-phase low-pass of 10 Hz. Noise: one AR model per joint.
Nuisance: every inertial number of the model off by the trial's share of its size, a priori, and
where joints rub the levels of that friction, which nobody knows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import fftconvolve, firwin

from adapter.model.model_file import load_model
from drivers.files.mcap import Log
from sim.effects import Effect
from sim.truth import Truth
from tests.helpers.arm_data import rms
from tests.helpers.gap_effects import Array, effect_from, predict, regressor, rnea, sense, slope
from tests.helpers.gap_scorer import Row
from tests.helpers.gap_tools import pinocchio_recording, sensor_noise
from tests.hidden import Trial
from tests.hidden.motion import draw_motion

TAPS, EDGE, STEP = 1001, 500, 40  # at 1 kHz: transition of 3 Hz; half a filter; to 25 Hz
LOWPASS = firwin(TAPS, 10.0, fs=1000.0)[:, None]
AR_ORDER, FLOOR = 6, 1.01  # FLOOR: white noise added, where the low-pass leaves none
BLOCK_S, BLOCKS = 2.0, 3  # every third block of 2 s is held out
SECOND = 1_000_000  # added to a seed for the second recording


def smooth(x: Array) -> Array:
    """Low-passed (m, n), zero phase; half a filter at each end isn't usable."""
    return fftconvolve(x, LOWPASS, mode="same", axes=0)


def thin(x: Array) -> Array:
    """The usable part at 25 Hz."""
    return x[EDGE:-EDGE:STEP]


def slow(x: Array) -> Array:
    """Low-passed, at 25 Hz."""
    return thin(smooth(x))


@dataclass(frozen=True)
class Whitener:
    """AR model of each joint's noise: coefficients (order, n), rms of the innovation (n,)."""

    ar: Array
    size: Array

    def __call__(self, x: Array) -> Array:
        """(k, n, ...) -> (k - order, n, ...), of unit variance where x is that noise."""
        order = len(self.ar)
        more = (1,) * (x.ndim - 2)
        out = x[order:].copy()
        for i in range(order):
            out -= self.ar[i].reshape(-1, *more) * x[order - 1 - i : len(x) - 1 - i]
        return out / self.size.reshape(-1, *more)


def fit_noise(e: Array) -> Whitener:
    """Yule-Walker of every column of e (k, n)."""
    ar, size = [], []
    for x in (e - e.mean(axis=0)).T:
        r = np.array([x[: len(x) - i] @ x[i:] / len(x) for i in range(AR_ORDER + 1)])
        r[0] *= FLOOR
        a = solve_toeplitz(r[:-1], r[1:])
        ar.append(a)
        size.append(np.sqrt(r[0] - a @ r[1:]))
    return Whitener(np.array(ar).T, np.array(size))


def noise_residual(trial: Trial) -> Array:
    """Torque residual (k, n) at 25 Hz of the true arm from noise and disturbance alone.

    Noise of q and dq enters as it does in any residual: through the rigid-body model, with the
    acceleration taken from the low-passed velocity.
    """
    q, dq, ddq = trial.motion.at(trial.times)
    nq, ndq, ntau = (smooth(x) for x in sensor_noise(trial.noise, q.shape, trial.seed))
    nddq = slope(trial.times, ndq)
    motion, moved = (q, dq, ddq), (q + nq, dq + ndq, ddq + nddq)
    clean, noisy = (rnea(trial.arm, *map(thin, part)) for part in (motion, moved))
    return thin(ntau + smooth(trial.disturbance())) - (noisy - clean)


def signatures(trial: Trial) -> list[Array]:
    """Torque (k, n) at 25 Hz that each effect adds where the same motion is read."""
    t = trial.times
    q, dq, tau = sense(trial.arm, trial.effects, t, *trial.motion.at(t))
    ddq = slope(t, dq)
    whole = tau
    if len(trial.effects) > 1:  # what is inexact in predicting an effect is in both terms
        whole = predict(trial.arm, trial.effects, t, q, dq, ddq, tau)
    found = []
    for i in range(len(trial.effects)):
        rest = trial.effects[:i] + trial.effects[i + 1 :]
        found.append(slow(whole - predict(trial.arm, rest, t, q, dq, ddq, tau)))
    return found


def prior_columns(truth: Truth, error: float, *motion: Array) -> Array:
    """Y sqrt(P) (k, n, 10 n): torque of one prior standard deviation of each number of θ."""
    return regressor(truth, *motion) * (error * np.abs(truth.theta).ravel())


def rubbing(trial: Trial, dq: Array) -> tuple[Array, Array]:
    """Torque (k, n) at 25 Hz of the friction in every joint, and its columns (k, n, 2 n).

    Zero and none where there is no friction; by joint first what is dry, then what is viscous.
    """
    if trial.friction is None:
        return np.zeros_like(thin(dq)), np.zeros((*thin(dq).shape, 0))
    whole = trial.friction.along(dq, float(np.median(np.diff(trial.times))))
    viscous = trial.friction.viscous * dq
    parts = [slow(part)[:, :, None] * np.eye(dq.shape[1]) for part in (whole - viscous, viscous)]
    return slow(whole), np.concatenate(parts, axis=2)


def distance(s: Array, nuisance: Array) -> float:
    """sqrt(s' (I + N N')^-1 s) of a whitened signature (m,) and nuisances (m, p)."""
    gram = np.eye(nuisance.shape[1]) + nuisance.T @ nuisance
    b = nuisance.T @ s
    return float(np.sqrt(max(s @ s - b @ np.linalg.solve(gram, b), 0.0)))


def detectability(trial: Trial) -> list[float]:
    """z of each effect: how many standard deviations its signature is away from nothing, given
    the noise, the prior and, in a pair, not knowing the other effect's size."""
    if not trial.effects:
        return []
    white = fit_noise(noise_residual(trial))
    motion = trial.motion.at(trial.times)
    Y = prior_columns(trial.arm, trial.model_error, *map(thin, motion))
    Y = np.concatenate([Y, rubbing(trial, motion[1])[1]], axis=2)
    nuisance = white(Y).reshape(-1, Y.shape[2])
    parts = [white(s).ravel() for s in signatures(trial)]
    found = []
    for i, s in enumerate(parts):
        others = parts[:i] + parts[i + 1 :]
        found.append(distance(s, np.column_stack([nuisance, *others])))
    return found


@dataclass(frozen=True)
class OracleFit:
    """What a fit of the right effects leaves.

    Attributes:
        effects: with fitted parameters; std: their standard deviations, by key.
        theta: (n, 10) of the fitted arm.
        held_rmse_nm: (n,) on the blocks held out, at 25 Hz; before_rmse_nm: of the nominal model.
    """

    effects: tuple[Effect, ...]
    std: tuple[dict[str, Any], ...]
    theta: Array
    held_rmse_nm: Array
    before_rmse_nm: Array


def free_keys(effect: Effect) -> list[tuple[str, int | None]]:
    """(key, place in a list or None) of the numbers that are fitted."""
    free: list[tuple[str, int | None]] = []
    for key, value in effect.parameters.items():
        if isinstance(value, list | tuple):
            if effect.name == "link_inertia":
                continue
            free += [(key, i) for i in range(len(value)) if value[i]]
        elif value and key != "n":
            free.append((key, None))
    return free


def _numbers(effects: Sequence[Effect]) -> Array:
    return np.array(
        [np.atleast_1d(e.parameters[key])[i or 0] for e in effects for key, i in free_keys(e)],
        float,
    )


def _with(effects: Sequence[Effect], numbers: Array) -> tuple[Effect, ...]:
    """The effects with other numbers, as plain containers: a size may be out of its range."""
    left, out = iter(numbers.tolist()), []
    for effect in effects:
        changed: dict[str, Any] = {
            k: list(v) if isinstance(v, list | tuple) else v for k, v in effect.parameters.items()
        }
        for key, i in free_keys(effect):
            if i is None:
                changed[key] = next(left)
            else:
                changed[key][i] = next(left)
        out.append(replace(effect, parameters=changed))
    return tuple(out)


class Oracle:
    """Fits the right effects and the inertial error to one recording.

    Args:
        trial: the truth.
        recording: made of it, by whatever simulator.
    """

    def __init__(self, trial: Trial, recording: Log) -> None:
        self._trial = trial
        self._t = trial.times[: len(recording.q)]
        self._q, self._dq, self._tau = map(smooth, (recording.q, recording.dq, recording.tau))
        self._ddq = slope(self._t, self._dq)
        self._motion = self._q, self._dq, self._ddq
        self._read = thin(self._tau)
        self._rubs = rubbing(trial, self._dq)[0]
        self._Y = prior_columns(trial.nominal, trial.model_error, *map(thin, self._motion))
        self._white = fit_noise(noise_residual(trial))
        t = thin(self._t)
        self._held = (t // BLOCK_S) % BLOCKS == BLOCKS - 1

    def torque(self, effects: Sequence[Effect]) -> Array:
        """Predicted torque (k, n) at 25 Hz, nominal inertias."""
        raw = predict(self._trial.nominal, effects, self._t, *self._motion, self._tau)
        return slow(raw)

    def residual(self, effects: Sequence[Effect], theta: Array, knows_friction: bool) -> Array:
        """Torque residual (k, n) at 25 Hz, less the friction of every joint where that is known."""
        left = self._read - self.torque(effects) - (self._rubs if knows_friction else 0.0)
        share = (theta - self._trial.nominal.theta).ravel()
        sizes = self._trial.model_error * np.abs(self._trial.nominal.theta).ravel()
        return left - self._Y @ (share / np.where(sizes, sizes, 1.0))

    def fit(self) -> OracleFit:
        """Gauss-Newton from the truth, which is also the middle of a prior as wide as each number:
        what the data don't show stays. `link_inertia` is kept as it is."""
        effects, read = self._trial.effects, self._read - self._rubs
        sizes = self._trial.model_error * np.abs(self._trial.nominal.theta)
        truth, m = _numbers(effects), self._Y.shape[2]
        x, sizes_x = truth, np.maximum(np.abs(truth), 1e-6)
        keep = ~self._held[AR_ORDER:]
        nuisance = self._white(self._Y)[keep].reshape(-1, m)
        y, cov = np.zeros(m), np.zeros((len(x), len(x)))
        for _ in range(4 if len(x) else 1):
            base = self.torque(_with(effects, x))
            steps = 1e-3 * sizes_x
            moved = (_with(effects, x + d) for d in np.diag(steps))
            J = np.array([(self.torque(e) - base) / h for e, h in zip(moved, steps, strict=True)])
            J = J.reshape(len(x), *base.shape).transpose(1, 2, 0)
            left = self._white(read - base)[keep]
            shown = self._white(J)[keep].reshape(left.size, len(x))
            left, A = left.ravel(), np.column_stack([shown, nuisance])
            tight = np.diag([*(1 / np.square(sizes_x)), *np.ones(m)])
            pull = np.concatenate(((truth - x) / np.square(sizes_x), np.zeros(m)))
            inverse = np.linalg.inv(A.T @ A + tight)
            step = inverse @ (A.T @ left + pull)
            x = truth + np.clip(x + step[: len(x)] - truth, -0.7 * sizes_x, 2 * sizes_x)
            y, cov = step[len(x) :], inverse[: len(x), : len(x)]
        fitted = _with(effects, x)
        left = read - self.torque(fitted) - self._Y @ y
        before = self._read - self.torque(())
        std = _with(effects, np.sqrt(np.maximum(np.diag(cov), 0.0)))
        return OracleFit(
            fitted,
            tuple({key: dict(e.parameters)[key] for key, _ in free_keys(e)} for e in std),
            self._trial.nominal.theta + sizes * y.reshape(sizes.shape),
            rms(left[self._held]),
            rms(before[self._held]),
        )


def second(trial: Trial) -> Trial:
    """The same arm, its effects at the same times, on another motion with other noise."""
    rng = np.random.default_rng([trial.seed, 1 << 36])
    motion = draw_motion(rng, trial.nominal.limits, trial.nominal.ready)
    return replace(trial, motion=motion, seed=trial.seed + SECOND)


def torque_judge(trial: Trial, recording: Log, result: dict[str, Any], folder: Path) -> Row:
    """Torque RMSE at 25 Hz of the model that was written, against that of the oracle's fit.

    Both are fitted to `recording` and judged on a second recording of the same arm. The effects
    are those of the findings, computed by the tests' formulas; of the model file only θ is used.

    Returns:
        `torque_ratio`: rms over the joints of the ratios; `torque_rmse_nm`, `oracle_rmse_nm`.
    """
    if not result.get("model_out"):
        return {}
    place = Path(result["model_out"])
    theta = load_model(place if place.is_absolute() else folder / place).theta
    other = second(trial)
    unseen = Oracle(other, pinocchio_recording(other))
    fit = Oracle(trial, recording).fit()
    best = rms(unseen.residual(fit.effects, fit.theta, True))
    found = tuple(effect_from(finding) for finding in result["findings"])
    ours = rms(unseen.residual(found, theta, False))
    return {
        "torque_ratio": float(np.sqrt(np.mean(np.square(ours / best)))),
        "torque_rmse_nm": ours.tolist(),
        "oracle_rmse_nm": best.tolist(),
    }
