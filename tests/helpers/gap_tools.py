"""Hidden-effect trials without a simulator: the drawn motion, Pinocchio's torque, noise.

No controller and no steps in time, so that a trial of 20 s takes a fraction of a second. The
arm does exactly what it was told; everything else is as in `tests.hidden`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import butter, sosfilt

from drivers.files.mcap import Log
from sim.noise_levels import NoiseLevels
from sim.truth import panda, wrong_bodies
from tests.helpers.gap_effects import Array, sense
from tests.hidden import Trial, draw
from tests.hidden.motion import DrawnMotion, draw_motion
from tests.hidden.record import log_of
from tests.hidden.sizes import log_uniform, wrist_shares
from tests.hidden.trial import DISTURBANCE_HZ, DISTURBANCE_NM, TRIAL_STREAM

NOISE_STREAM = 1 << 35


def believed(seed: int) -> Trial:
    """Nothing hidden in an arm 2 % off its model, as a search believes; a multi-sine, no friction.

    Drawn in an order of its own: the tests' bounds were measured on it.
    """
    nominal, rng = panda(), np.random.default_rng([seed, TRIAL_STREAM])
    rng.random()
    theta = wrong_bodies(nominal.theta, 0.02, rng)
    motion = draw_motion(rng, nominal.limits, nominal.ready, "sines")
    return replace(
        draw(seed, "null", rubs=False),
        arm=nominal.with_changes(theta=theta, ready=motion.middle),
        model_error=0.02,
        motion=motion,
        disturbance_nm=wrist_shares(nominal.n) * rng.uniform(*DISTURBANCE_NM, nominal.n),
        disturbance_hz=log_uniform(rng, DISTURBANCE_HZ),
    )


def sines(seed: int) -> DrawnMotion:
    """A multi-sine in every joint of the Panda."""
    return believed(seed).motion


def with_sines(trial: Trial) -> Trial:
    """The trial on a multi-sine, whatever its motion was."""
    motion = sines(trial.seed)
    arm = trial.arm.with_changes(ready=motion.middle)
    return replace(trial, motion=motion, arm=arm)


def sensor_noise(levels: NoiseLevels, shape: tuple[int, int], seed: int) -> tuple[Array, ...]:
    """Noise (m, n) of q, dq and tau: white, and for tau a band from 10 to 40 Hz on top."""
    rng = np.random.default_rng([seed, NOISE_STREAM])
    whole = np.sqrt(0.9)  # nine tenths of white noise at 1 kHz are above 50 Hz
    q, dq, white = (
        np.asarray(level) / whole * rng.standard_normal(shape)
        for level in (levels.q_above_50hz, levels.dq_above_50hz, levels.tau_above_50hz)
    )
    power = np.square(levels.tau_10_to_40hz) - 0.06 * np.square(levels.tau_above_50hz) / 0.9
    band = sosfilt(
        butter(4, [10, 40], "band", fs=1000, output="sos"), rng.standard_normal(shape), 0
    )
    return q, dq, white + np.sqrt(np.maximum(power, 0)) * band / band.std(axis=0)


def recorded(trial: Trial, q: Array, dq: Array, tau: Array, commands: Array | None) -> Log:
    """Noise-free readings (m, n) as they are recorded."""
    more = sensor_noise(trial.noise, q.shape, trial.seed)
    q, dq, tau = (x + e for x, e in zip((q, dq, tau), more, strict=True))
    step = np.asarray(trial.noise.tau_step)
    stamps = 1_000_000 * np.arange(len(q), dtype=np.int64)
    names = trial.arm.joint_names
    return log_of(names, stamps, q, dq, np.round(tau / step) * step, commands)


def pinocchio_recording(trial: Trial) -> Log:
    """The recording of a trial, by Pinocchio alone."""
    motion = trial.motion.at(trial.times)
    rubs = 0.0 if trial.friction is None else trial.friction.along(motion[1], 1e-3)
    q, dq, tau = sense(trial.arm, trial.effects, trial.times, *motion, rubs)
    return recorded(trial, q, dq, tau + trial.disturbance(), None)
