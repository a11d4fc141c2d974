"""What a fault makes of one sample; pure, the sample given is left as it is."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from drivers.interface import Array, JointSample, LinkMotion

MOST_BITS = 3  # flipped at a time
SIGNALS = ("q", "dq", "tau")
# A spike of factor 1 is up to this far off: rad, rad/s, N m; at least a fifth of it.
SPIKE_SIZE = {"q": 0.5, "dq": 2.0, "tau": 30.0}
LEAST_SPIKE = 0.2
LONGEST_STAMP_BIT = 62  # the sign of a stamp stays


def flip_bits(values: Array, at: int, rng: np.random.Generator) -> Array:
    """A copy of values with one to three bits of its entry `at` (flat) flipped."""
    out = values.copy()
    words = out.reshape(-1).view(np.uint64)
    for bit in rng.choice(64, size=rng.integers(1, MOST_BITS + 1), replace=False):
        words[at] ^= np.uint64(1) << np.uint64(bit)
    return out


def corrupt(sample: JointSample, rng: np.random.Generator) -> JointSample:
    """Flip bits of one number: it may become huge, tiny, not a number or just a little wrong."""
    n = len(sample.q)
    numbers = 3 * n if sample.links is None else 15 * n
    at = int(rng.integers(numbers))
    if at < 3 * n:
        name = SIGNALS[at // n]
        changed: dict[str, Any] = {name: flip_bits(getattr(sample, name), at % n, rng)}
        return replace(sample, **changed)
    assert sample.links is not None
    at -= 3 * n
    twist, accel = sample.links.twist, sample.links.accel
    if at < 6 * n:
        return replace(sample, links=LinkMotion(flip_bits(twist, at, rng), accel))
    return replace(sample, links=LinkMotion(twist, flip_bits(accel, at - 6 * n, rng)))


def corrupt_stamp(sample: JointSample, rng: np.random.Generator) -> JointSample:
    """Flip bits of the stamp."""
    stamp_ns = sample.stamp_ns
    bits = rng.choice(LONGEST_STAMP_BIT, size=rng.integers(1, MOST_BITS + 1), replace=False)
    for bit in bits:
        stamp_ns ^= 1 << int(bit)
    return replace(sample, stamp_ns=stamp_ns)


def with_reading(sample: JointSample, name: str, joint: int, value: float) -> JointSample:
    """One reading (q, dq or tau) of one joint is another."""
    values = getattr(sample, name).copy()
    values[joint] = value
    return replace(sample, **{name: values})


def blank(sample: JointSample, rng: np.random.Generator) -> JointSample:
    """One reading of one joint, or all of them, is not a number."""
    joint, which = int(rng.integers(len(sample.q))), int(rng.integers(len(SIGNALS) + 1))
    for name in SIGNALS if which == len(SIGNALS) else SIGNALS[which : which + 1]:
        sample = with_reading(sample, name, joint, np.nan)
    return sample


def spike(sample: JointSample, rng: np.random.Generator, factor: float) -> JointSample:
    """One reading of one joint is off by up to `factor` times the usual size of a spike."""
    name = SIGNALS[rng.integers(len(SIGNALS))]
    size = rng.uniform(LEAST_SPIKE, 1.0) * rng.choice([-1.0, 1.0])
    joint = int(rng.integers(len(sample.q)))
    value = getattr(sample, name)[joint] + factor * SPIKE_SIZE[name] * size
    return with_reading(sample, name, joint, value)
