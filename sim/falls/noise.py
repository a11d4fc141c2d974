"""What sensors make of a tree's motion: encoders, torque sensors, an inertial unit on each body.

Nothing measures accelerations of joints, angular accelerations or the velocity of a frame: those
signals are absent.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from sim.falls.fall import FallRecord
from sim.falls.links import link_tables
from sim.falls.tree_truth import TreeTruth
from sim.truth import Array

STANDARD_GRAVITY = 9.80665  # m/s² per g, exact by definition (CGPM 1901)
ENCODER_STEP = 2 * np.pi / 2**19  # rad; 19 bits, usual for magnetic absolute encoders on joints
# rad rms, our choice: with the quantisation it makes the differentiated position as noisy
# (6 mrad/s rms) as the velocities of a real Panda's log are (sim/models/panda.toml, [noise]).
ENCODER_NOISE = 0.2 * ENCODER_STEP
# Of the effort limit, rms; a real Panda's log has 0.15 to 0.22 % at its four large joints
# (sim/models/panda.toml, [noise] tau_above_50hz over effort).
TORQUE_SHARE = 2e-3
GYRO_DENSITY = np.radians(0.007)  # rad/s/√Hz; MEMS unit Xsens MTi-1, data sheet, 0.007 °/s/√Hz
ACCEL_DENSITY = 120e-6 * STANDARD_GRAVITY  # m/s²/√Hz; the same unit, 120 µg/√Hz


@dataclass(frozen=True, slots=True)
class TreeNoise:
    """Sizes of what the sensors add; all noise is white and Gaussian.

    Attributes:
        encoder_step: quantisation of joint positions, rad; 0 for none.
        encoder_noise: added before it, rad rms.
        torque_share: torque noise as share of a joint's effort limit, rms.
        gyro_density: noise of angular velocities, rad/s/√Hz, up to half the sample rate.
        accel_density: noise of accelerations, m/s²/√Hz, likewise.

    Raises:
        ValueError: a size that is negative or not a number.
    """

    encoder_step: float = ENCODER_STEP
    encoder_noise: float = ENCODER_NOISE
    torque_share: float = TORQUE_SHARE
    gyro_density: float = GYRO_DENSITY
    accel_density: float = ACCEL_DENSITY

    def __post_init__(self) -> None:
        for item in fields(self):
            if not (getattr(self, item.name) >= 0.0 and np.isfinite(getattr(self, item.name))):
                raise ValueError(f"noise {item.name!r} must be 0 or more and finite")


def measured(
    truth: TreeTruth,
    record: FallRecord,
    noise: TreeNoise,
    rate_hz: float,
    rng: np.random.Generator,
) -> dict[str, Array]:
    """Signals as they are measured, by name.

    Args:
        truth: of the tree.
        record: exact samples at `rate_hz`.
        noise: sizes of what is added.
        rate_hz: of the samples.
        rng: all that is random comes from it.

    Returns:
        q (m, n) rad; dq (m, n) rad/s, the difference of two readings of the encoder; tau (m, n)
        N m; base_w (m, 3) and link_w (m, n, 3) rad/s; base_a (m, 3) and link_a (m, n, 3) m/s²,
        minus gravity, at the origins of the frames.
    """
    base = (record.base_v, record.base_w, record.base_a, record.base_dw)
    links = link_tables(truth, record.q, record.dq, record.ddq, base)
    # The reading before the first sample too: a step of the simulator ends with q = q' + h dq.
    before = record.q[:1] - record.dq[:1] / rate_hz
    read = _read(np.concatenate((before, record.q)), noise, rng)
    gyro, accel = (d * np.sqrt(rate_hz / 2) for d in (noise.gyro_density, noise.accel_density))

    def noisy(x: Array, size: float | Array) -> Array:
        return x + size * rng.standard_normal(x.shape)

    return {
        "q": read[1:],
        "dq": np.diff(read, axis=0) * rate_hz,
        "tau": noisy(record.tau, noise.torque_share * truth.limits.effort),
        "base_w": noisy(record.base_w, gyro),
        "base_a": noisy(record.base_a, accel),
        "link_w": noisy(links.w, gyro),
        "link_a": noisy(links.a, accel),
    }


def _read(q: Array, noise: TreeNoise, rng: np.random.Generator) -> Array:
    """What the encoders give for positions q (m, n)."""
    q = q + noise.encoder_noise * rng.standard_normal(q.shape)
    if noise.encoder_step == 0.0:
        return q
    return np.asarray(np.round(q / noise.encoder_step) * noise.encoder_step)
