"""A recording made ready for discovery: one even grid, one filter for all, noise levels known.

Every signal goes through the same zero-phase Butterworth filter, so that whatever belonged to one
instant still does. Products such as Rz(q) w are formed after it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.discovery.channels import CHANNELS, STILL, Channels, channels_of, check, listed
from adapter.discovery.zero_phase import KEPT_PER_CUTOFF, ZeroPhase
from adapter.errors import SettingsError
from adapter.filters import noise_from_samples
from adapter.spatial import Array
from drivers.mcap_file import Log

CUTOFF_HZ = 20.0  # motion of arms and legs lies below
SHORTEST_S = 0.5  # less motion than this decides nothing
GAP_S = 0.05  # a longer silence of a sensor is not bridged
RESTING = 0.02  # rad/s, a joint slower than this counts as resting
ENCODER_STEP = 2.0 * np.pi / 2**14  # rad, coarser than any encoder at a joint of today


@dataclass(frozen=True)
class Recorded:
    """Filtered signals on an even grid, m samples.

    Attributes:
        joint_names, link_names: as recorded; order and names mean nothing.
        q, dq, ddq: (m, n) rad, rad/s, rad/s².
        tau: (m, n) N m; None where a torque is not finite.
        motion: for each channel that was measured, or follows from one that was, (m, links, 3)
            in the links' frames: w rad/s, dw rad/s², v m/s, a m/s² (accelerometer convention).
        measured: the channels that were measured, angular first.
        noise: for each channel (links,) variance of the noise that the filter left.
        joint_noise: variances (n,) the filter left in "q", "dq", "ddq".
        motion_hz: typical frequency of the joints' motion.
        rate_hz: of the recording; `samples` used of it; `duration_s` its length.
        cutoff_hz: corner of the filter.
        notes: what was done to the data, one sentence each.
        adrift: (links,) bool, links whose w was added up from an unknown start.
    """

    joint_names: tuple[str, ...]
    link_names: tuple[str, ...]
    q: Array
    dq: Array
    ddq: Array
    tau: Array | None
    motion: dict[str, Array]
    measured: tuple[str, ...]
    noise: dict[str, Array]
    joint_noise: dict[str, Array]
    motion_hz: float
    rate_hz: float
    samples: int
    duration_s: float
    cutoff_hz: float
    notes: tuple[str, ...]
    adrift: np.ndarray

    @property
    def motion_samples(self) -> float:
        """How many independent samples the motion itself is worth, at least one."""
        return max(1.0, 2.0 * self.duration_s * self.motion_hz)

    @property
    def noise_samples(self) -> float:
        """How many independent samples of noise the filter leaves, at least two."""
        return max(2.0, 2.0 * self.duration_s * self.cutoff_hz)


_ASSUMED_REST = (
    "no angular velocity of links {names} is recorded; it is added up from their angular "
    "acceleration, all links taken to be at rest at the start"
)
_FOUND_START = (
    "no angular velocity of links {names} is recorded; it is added up from their angular "
    "acceleration, and what it was at the start is found from the joints' speeds"
)


def prepare(log: Log, cutoff_hz: float = CUTOFF_HZ) -> Recorded:
    """Filter and thin out a recording.

    Args:
        log: with link motion, in the project's conventions.
        cutoff_hz: corner of the filter; lower where the sample rate asks for it.

    Raises:
        SettingsError: no link motion, no angular motion, too short, too many gaps; the sentence
            says what the recording does have.
    """
    if not 0.0 < cutoff_hz < np.inf:
        raise SettingsError(f"the filter's corner must be above zero and finite, got {cutoff_hz}")
    check(log, SHORTEST_S)
    t_s, first = _times(log)
    heard_of = channels_of(log, first)
    measured = heard_of.values
    grid, rate_hz = _grid(t_s)
    heard = np.ones(len(grid), dtype=bool)
    joints: dict[str, Array] = {}
    for name, values in (("q", _unwrapped(log.q[first])), ("dq", log.dq[first])):
        if name == "q" or np.isfinite(values).any(axis=0).all():
            joints[name] = _onto(grid, t_s, values, heard)
    motion = {
        channel: np.stack(
            [_onto(grid, t_s, values[:, k], heard) for k in range(values.shape[1])], axis=1
        )
        for channel, values in measured.items()
    }
    _check_heard(log, heard, motion, grid)
    torque = log.tau[first]
    tau = _onto(grid, t_s, torque, heard.copy()) if np.isfinite(torque).any(axis=0).all() else None
    through = ZeroPhase(rate_hz, cutoff_hz)
    levels = {k: _noise(x) * through.passes for k, x in measured.items()}
    return _filtered(log, through, grid, heard, joints, tau, motion, levels, heard_of)


def _times(log: Log) -> tuple[Array, np.ndarray]:
    """Seconds from the start, increasing, and the rows of the recording they belong to."""
    stamps, first = np.unique(log.stamp_ns, return_index=True)
    return 1e-9 * (stamps - stamps[0]).astype(np.float64), first


def _unwrapped(q: Array) -> Array:
    """q (k, n) without the jumps of whole turns, which no filter would survive."""
    out = q.copy()
    for column in out.T:
        heard = np.isfinite(column)
        column[heard] = np.unwrap(column[heard])
    return out


def _grid(t_s: Array) -> tuple[Array, float]:
    steps = np.diff(t_s)
    period_s = float(np.median(steps))
    count = int(np.floor(t_s[-1] / period_s + 1e-6)) + 1
    return np.asarray(period_s * np.arange(count)), 1.0 / period_s


def _onto(grid: Array, t_s: Array, values: Array, heard: np.ndarray) -> Array:
    """Columns (k, c) on the grid; clears `heard` where a gap is too long to be bridged."""
    finite = np.isfinite(values).all(axis=1)
    if finite.sum() < 2:
        heard[:] = False
        return np.zeros((len(grid), values.shape[1]))
    known = t_s[finite]
    after = np.clip(np.searchsorted(known, grid), 1, len(known) - 1)
    gap_s = known[after] - known[after - 1]
    outside = (grid < known[0] - GAP_S) | (grid > known[-1] + GAP_S)
    heard &= (gap_s <= GAP_S) & ~outside
    return np.stack([np.interp(grid, known, column) for column in values[finite].T], axis=1)


def _check_heard(log: Log, heard: np.ndarray, motion: dict[str, Array], grid: Array) -> None:
    step_s = grid[1] - grid[0]
    if heard.sum() * step_s >= SHORTEST_S:
        return
    counts = []
    for k, name in enumerate(log.link_names):
        tables = [table for table in (log.twists, log.accels) if table is not None]
        share = min(float(np.isfinite(table[:, k]).any(axis=1).mean()) for table in tables)
        counts.append(f"{name} {100 * share:.0f} %")
    raise SettingsError(
        f"{log.path}: only {heard.sum() * step_s:.2f} s have all of "
        f"{', '.join(motion)} of every link and all joint signals at the same time; stamps with "
        f"link motion: {', '.join(counts)}"
    )


def _filtered(
    log: Log,
    through: ZeroPhase,
    grid: Array,
    heard: np.ndarray,
    joints: dict[str, Array],
    tau: Array | None,
    motion: dict[str, Array],
    noise: dict[str, Array],
    channels: Channels,
) -> Recorded:
    joint_noise = {k: noise_from_samples(x) ** 2 * through.passes for k, x in joints.items()}
    joint_noise.setdefault("dq", joint_noise["q"] / through.passes * through.rate_passes)
    joint_noise["ddq"] = _rate_noise(joint_noise["dq"], through, "dq" in joints)
    joint_noise["q"] = np.minimum(joint_noise["q"], ENCODER_STEP**2)
    smooth = {k: through(x) for k, x in motion.items()}
    q = through(joints["q"])
    dq = through(joints["dq"]) if "dq" in joints else through.rate_of(q)
    ddq = through.rate_of(dq)
    turning = _Turning(through, len(grid), channels)
    turning.complete(smooth, noise)
    moving = float(np.abs(dq[: 2 * through.edge]).max()) > RESTING
    adrift = turning.lacking["w"] & moving
    keep = np.zeros(len(grid), dtype=bool)
    keep[through.edge : len(grid) - through.edge : through.step] = True
    keep &= heard
    if keep.sum() < 4 * KEPT_PER_CUTOFF:
        raise SettingsError(
            f"{log.path}: {int(keep.sum())} samples are left after filtering at "
            f"{through.cutoff_hz:.0f} Hz; it is too short or has too many gaps"
        )
    speed = np.sqrt(np.mean(dq[keep] ** 2))
    noisy = float(np.mean(joint_noise["ddq"]))
    change = np.sqrt(max(float(np.mean(ddq[keep] ** 2)) - noisy, 0.0))
    return Recorded(
        joint_names=log.joint_names,
        link_names=log.link_names,
        q=q[keep],
        dq=dq[keep],
        ddq=ddq[keep],
        tau=None if tau is None else through(tau)[keep],
        motion={k: smooth[k][keep] for k in CHANNELS if k in smooth},
        measured=channels.measured,
        noise=noise,
        joint_noise=joint_noise,
        motion_hz=float(np.clip(change / max(2 * np.pi * speed, STILL), 0.05, through.cutoff_hz)),
        rate_hz=through.rate_hz,
        samples=int(keep.sum()),
        duration_s=float(keep.sum() * through.step / through.rate_hz),
        cutoff_hz=through.cutoff_hz,
        notes=(*channels.notes, *turning.notes(log.link_names, moving)),
        adrift=adrift,
    )


def _rate_noise(noise: Array, through: ZeroPhase, white: bool) -> Array:
    """Variance of the rate of filtered noise; at most that of the corner where it isn't white."""
    if white:
        return noise / through.passes * through.rate_passes
    return noise * (2 * np.pi * through.cutoff_hz) ** 2


class _Turning:
    """Fills in w by dw and dw by w, link by link."""

    def __init__(self, through: ZeroPhase, samples: int, channels: Channels) -> None:
        self._through, self._samples = through, samples
        links = next(iter(channels.values.values())).shape[1]
        every = np.ones(links, dtype=bool)
        self.lacking = {k: channels.lacking.get(k, every) for k in ("w", "dw")}

    def complete(self, smooth: dict[str, Array], noise: dict[str, Array]) -> None:
        """Both channels of every link, filtered, and the variances of their noise."""
        through, lacking = self._through, self.lacking
        known = smooth["w"] if "w" in smooth else smooth["dw"]
        for k in ("w", "dw"):
            smooth.setdefault(k, np.zeros_like(known))
            noise.setdefault(k, np.zeros(known.shape[1]))
        drift = self._samples / through.rate_hz**2
        rate = through.rate_of(smooth["w"][:, lacking["dw"]])
        smooth["w"][:, lacking["w"]] = (
            np.cumsum(smooth["dw"][:, lacking["w"]], axis=0) / through.rate_hz
        )
        smooth["dw"][:, lacking["dw"]] = rate
        noise["w"][lacking["w"]] = noise["dw"][lacking["w"]] / through.passes * drift
        noise["dw"][lacking["dw"]] = (
            noise["w"][lacking["dw"]] / through.passes * through.rate_passes
        )

    def notes(self, names: tuple[str, ...], moving: bool) -> list[str]:
        """How w was found where it was not measured."""
        without = self.lacking["w"]
        if not without.any():
            return []
        sentence = _FOUND_START if moving else _ASSUMED_REST
        return [sentence.format(names=listed(names, without))]


def _noise(x: Array) -> Array:
    """Variance (links,) of one component's white noise, if it came at the joints' rate.

    A sensor that is heard less often has more of its noise below the filter's corner.
    """
    out = np.zeros(x.shape[1])
    for k in range(x.shape[1]):
        heard = x[np.isfinite(x[:, k]).all(axis=1), k]
        out[k] = np.mean(noise_from_samples(heard) ** 2) * len(x) / len(heard)
    return out
