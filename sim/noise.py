"""What the sensors add: noise like that of a real Panda's log, quantisation, lost samples.

The noise of sample k depends on the seed and on k alone: each signal has its own stream of
random numbers, drawn ahead in blocks of fixed length.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, sosfreqz

from drivers.errors import choices
from drivers.interface import JointSample, LinkMotion
from sim.noise_levels import NOISES, NoiseLevels, check_levels
from sim.truth import Array, facts_of

RATE_HZ = 1000.0
HIGH_HZ = 50.0  # "above 50 Hz"
BAND_HZ = (10.0, 40.0)
BLOCK = 16  # samples drawn at once: dear enough one by one, a hitch in the loop if many
TAPS = 256  # samples after which the band filter has forgotten an input but for 2e-4

Draw = Callable[[np.random.Generator], Array]


def levels_of(name: str, **changes: float) -> NoiseLevels:
    """Noise levels by name: `real` (a Panda's log) or `none`, with some of them changed.

    Raises:
        ValueError: unknown name or unknown level; the message has the choices.
    """
    if name not in NOISES:
        raise ValueError(f"no noise {name!r}; {choices(name, NOISES)}")
    check_levels(changes)
    base = NoiseLevels() if name == "none" else NoiseLevels(**facts_of("panda")["noise"])
    return replace(base, **changes)


class SensorNoise:
    """Turns the clean sample number k = 0, 1, 2, ... into what arrives of it."""

    def __init__(self, levels: NoiseLevels, n: int, seed: int) -> None:
        self._levels = levels
        sizes = np.array([[levels.link_twist], [levels.link_accel]])
        draws: list[Draw] = [
            _JointNoise(levels, n),
            lambda rng: sizes * rng.standard_normal((BLOCK, n, 2, 6)),
            lambda rng: rng.random((BLOCK, 2)),
            lambda rng: levels.stamp_jitter_s * rng.standard_normal(BLOCK),
        ]
        streams = [_Stream(draw, np.random.default_rng([seed, i])) for i, draw in enumerate(draws)]
        self._joints, self._links, self._fate, self._jitter = streams
        self._step = np.broadcast_to(np.asarray(levels.tau_step, dtype=float), n)
        self._quantised = self._step > 0
        self._last: JointSample | None = None

    def measure(self, k: int, clean: JointSample) -> JointSample | None:
        """Sample k as it arrives, None where it is lost. To be called for every k in order."""
        tau, dq, q = self._joints.at(k)
        least = self._levels.tau_at_rest
        if least != 1.0:
            tau = tau * (least + (1.0 - least) * np.minimum(np.abs(clean.dq) / 0.1, 1.0))
        tau = clean.tau + tau
        on = self._quantised
        tau[on] = np.round(tau[on] / self._step[on]) * self._step[on]
        links = clean.links
        if links is not None:
            extra = self._links.at(k)
            links = LinkMotion(links.twist + extra[:, 0], links.accel + extra[:, 1])
        stamp_ns = clean.stamp_ns
        if self._levels.stamp_jitter_s:
            edge = 0.45 / RATE_HZ  # stamps stay in order
            stamp_ns += round(min(max(float(self._jitter.at(k)), -edge), edge) * 1e9)
        sample = JointSample(stamp_ns, clean.q + q, clean.dq + dq, tau, links)
        if self._levels.repeats or self._levels.dropouts:
            lost, repeated = self._fate.at(k)
            if self._last is not None and repeated < self._levels.repeats:
                sample = replace(self._last, stamp_ns=sample.stamp_ns)
            self._last = sample
            return None if lost < self._levels.dropouts else sample
        return sample


class _Stream:
    """One source of noise, row k for sample k, drawn in blocks."""

    def __init__(self, draw: Draw, rng: np.random.Generator) -> None:
        self._draw, self._rng = draw, rng
        self._block, self._number = np.empty(0), -1

    def at(self, k: int) -> Any:
        while self._number < k // BLOCK:
            self._block, self._number = self._draw(self._rng), self._number + 1
        return self._block[k % BLOCK]


class _JointNoise:
    """Draws (BLOCK, 3, n) noise of tau, dq and q: white, and of tau more between 10 and 40 Hz.

    That is band-passed white noise. The filter is applied as a product of a block's inputs and
    their past with the shifted impulse responses, which takes a tenth of the time of a recursive
    filter's call.
    """

    def __init__(self, levels: NoiseLevels, n: int) -> None:
        # Rms of the white noise and gain of the band noise that add up to the levels. Both have
        # power in both bands: the white one between 10 and 40 Hz, the band one in its skirts above
        # 50 Hz. Two linear equations in the two powers.
        f, response = (x[:-1] for x in band_response())
        power = np.abs(response) ** 2 / len(f)
        high, inside = f >= HIGH_HZ, (f >= BAND_HZ[0]) & (f <= BAND_HZ[1])
        shares = np.array([[high.mean(), power[high].sum()], [inside.mean(), power[inside].sum()]])
        wanted = np.square(np.broadcast_arrays(levels.tau_above_50hz, levels.tau_10_to_40hz))
        powers = np.linalg.solve(shares, wanted.reshape(2, -1))
        white, band = np.sqrt(np.maximum(powers, 0.0))
        above = 1.0 - HIGH_HZ / (RATE_HZ / 2)  # share of white noise's power above 50 Hz: 0.9
        whole = 1 / np.sqrt(above)
        dq, q = (whole * np.asarray(x) for x in (levels.dq_above_50hz, levels.q_above_50hz))
        self._white = np.stack([np.broadcast_to(x, n) for x in (white, dq, q)])
        self._gain = np.broadcast_to(band, n)
        response = np.fft.irfft(band_response()[1])[:TAPS][::-1]
        self._rows = np.zeros((BLOCK, TAPS - 1 + BLOCK))
        for i, row in enumerate(self._rows):
            row[i : i + TAPS] = response
        self._past: Array | None = None

    def __call__(self, rng: np.random.Generator) -> Array:
        n = len(self._gain)
        block = self._white * rng.standard_normal((BLOCK, *self._white.shape))
        if self._past is None:
            self._past = rng.standard_normal((TAPS - 1, n))
        inputs = np.concatenate((self._past, rng.standard_normal((BLOCK, n))))
        self._past = inputs[BLOCK:]
        block[:, 0] += self._gain * (self._rows @ inputs)
        return block


def band_response() -> tuple[Array, NDArray[np.complex128]]:
    """Frequencies, Hz, and the response there of a Butterworth band-pass of second order."""
    f = np.linspace(0.0, RATE_HZ / 2, (1 << 14) + 1)
    sections = butter(2, BAND_HZ, btype="bandpass", fs=RATE_HZ, output="sos")
    return f, np.asarray(sosfreqz(sections, f, fs=RATE_HZ)[1])
