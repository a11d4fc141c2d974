"""A recording made ready for discovery: its channels, one even grid, one filter, noise levels.

Turning must be known of every link, as angular velocity or acceleration; the other of the two
follows from it. Where neither was measured of all links, turning is compared by the acceleration.
Every signal goes through the same zero-phase Butterworth filter, so that whatever belonged to one
instant still does. Products such as Rz(q) w are formed after it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.signal import butter, sosfiltfilt

from adapter.errors import SettingsError
from adapter.model.spatial import Array
from adapter.signals.filters import noise_from_samples
from adapter.signals.recording import GAP_S, RESTING
from drivers.files.mcap import Log

CHANNELS = ("w", "dw", "v", "a")  # of link motion; the angular ones first
STILL = 1e-9  # a channel that never exceeds this was not measured but filled in
CUTOFF_HZ = 20.0  # motion of arms and legs lies below
CUTOFF_SHARE = 0.2  # of the sample rate, the highest corner that is used
ORDER = 4  # of the filter, run forwards and backwards
KEPT_PER_CUTOFF = 4.0  # samples kept per period of the corner frequency
SHORTEST_S = 0.5  # less motion than this decides nothing
ENCODER_STEP = 2.0 * np.pi / 2**14  # rad, coarser than any encoder at a joint of today


@dataclass(frozen=True)
class PreparedLog:
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
    def noise_samples(self) -> float:
        """How many independent samples of noise the filter leaves, at least two."""
        return max(2.0, 2.0 * self.duration_s * self.cutoff_hz)


def prepare(log: Log, cutoff_hz: float = CUTOFF_HZ) -> PreparedLog:
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
    _check(log)
    stamps, first = np.unique(log.stamp_ns, return_index=True)
    channels = channels_of(log, first)
    even = _resampled(log, 1e-9 * (stamps - stamps[0]).astype(np.float64), first, channels)
    through = ZeroPhase(even.rate_hz, cutoff_hz)
    # thinned out, without the ends and what was not heard
    keep = np.zeros(len(even.heard), dtype=bool)
    keep[through.edge : len(even.heard) - through.edge : through.step] = True
    keep &= even.heard
    if keep.sum() < 4 * KEPT_PER_CUTOFF:
        raise SettingsError(
            f"{log.path}: {int(keep.sum())} samples are left after filtering at "
            f"{through.cutoff_hz:.0f} Hz; it is too short or has too many gaps"
        )
    q, dq, ddq, joint_noise = _joint_signals(even.joints, through)
    noise = {k: _noise(x) * through.passes for k, x in channels.values.items()}
    motion = {k: through(x) for k, x in even.motion.items()}
    without_w = _complete_turning(motion, noise, channels, through)
    # typical frequency: rms acceleration, less what is noise in it, over rms speed
    speed = np.sqrt(np.mean(dq[keep] ** 2))
    change = np.sqrt(max(float(np.mean(ddq[keep] ** 2) - np.mean(joint_noise["ddq"])), 0.0))
    motion_hz = np.clip(change / max(2 * np.pi * speed, STILL), 0.05, through.cutoff_hz)
    moving = float(np.abs(dq[: 2 * through.edge]).max()) > RESTING
    notes = channels.notes
    if without_w.any():
        start = "all links taken to be at rest at the start"
        start = "and what it was at the start is found from the joints' speeds" if moving else start
        told = f"no angular velocity of links {listed(log.link_names, without_w)} is recorded"
        notes = (*notes, f"{told}; it is added up from their angular acceleration, {start}")
    return PreparedLog(
        joint_names=log.joint_names,
        link_names=log.link_names,
        q=q[keep],
        dq=dq[keep],
        ddq=ddq[keep],
        tau=None if even.tau is None else through(even.tau)[keep],
        motion={k: motion[k][keep] for k in CHANNELS if k in motion},
        measured=channels.measured,
        noise=noise,
        joint_noise=joint_noise,
        motion_hz=float(motion_hz),
        rate_hz=even.rate_hz,
        samples=int(keep.sum()),
        duration_s=float(keep.sum() * through.step / even.rate_hz),
        cutoff_hz=through.cutoff_hz,
        notes=notes,
        adrift=without_w & moving,
    )


# --- which motion of which links there is ------------------------------------------------------


def _check(log: Log) -> None:
    """Refuse what holds no link motion, of one link alone, or is too short."""
    links = ", ".join(log.link_names) or "none"
    if not log.link_names or (log.twists is None and log.accels is None):
        told = [f"{name} ({t.messages} {t.schema or t.encoding})" for name, t in log.topics.items()]
        raise SettingsError(
            f"{log.path}: has no motion of links (sensor_msgs/msg/Imu on any topic, or "
            f"/link_twists/<link> or /link_accels/<link>), of links: {links}; it needs that of "
            f"every link, measured in the link's own frame; has: {', '.join(told) or 'no topic'}"
        )
    if len(log.link_names) < 2 and len(log.joint_names) > 1:
        raise SettingsError(
            f"{log.path}: has the motion of one link only ({links}) beside "
            f"{len(log.joint_names)} joints; nothing can be compared"
        )
    span_s = 1e-9 * float(np.ptp(log.stamp_ns)) if len(log) else 0.0
    if span_s < SHORTEST_S:
        raise SettingsError(
            f"{log.path}: lasts {span_s:.2f} s; discovery needs at least {SHORTEST_S} s of motion"
        )


@dataclass(frozen=True)
class Channels:
    """Link motion as recorded.

    Attributes:
        values: by channel (k, links, 3), not a number where nothing was heard.
        lacking: by channel (links,) bool, links of which it was never heard; their values are 0.
        measured: channels that can be held against others of all links.
        notes: sentences.
    """

    values: dict[str, Array]
    lacking: dict[str, np.ndarray]
    measured: tuple[str, ...]
    notes: tuple[str, ...]


def channels_of(log: Log, rows: np.ndarray) -> Channels:
    """The channels that hold anything in some rows of a recording.

    Raises:
        SettingsError: of some link neither angular velocity nor angular acceleration is there.
    """
    heard = _heard(log, rows)
    lacking: dict[str, np.ndarray] = {
        name: np.asarray(~np.isfinite(x).all(axis=2).any(axis=0)) for name, x in heard.items()
    }
    every = np.ones(len(log.link_names), dtype=bool)
    mute = lacking.get("w", every) & lacking.get("dw", every)
    if mute.any():
        whole = ", ".join(k for k in CHANNELS if k in lacking and not lacking[k].any())
        raise SettingsError(
            f"{log.path}: has neither angular velocity nor angular acceleration of every link; of "
            f"all links it has: {whole or 'nothing'}; links with neither: "
            f"{listed(log.link_names, mute)}"
        )
    for name in ("v", "a"):
        if name in heard and lacking[name].any():
            del heard[name]
    values = {k: np.where(lacking[k][None, :, None], 0.0, heard[k]) for k in CHANNELS if k in heard}
    measured = tuple(k for k in values if not lacking[k].any())
    notes: list[str] = []
    if not {"w", "dw"} & set(measured):
        measured = ("dw", *measured)
        notes.append(
            f"of links {listed(log.link_names, lacking['w'])} no angular velocity is recorded, of "
            f"{listed(log.link_names, lacking['dw'])} no angular acceleration: links are compared "
            "by the latter, differentiated where need be"
        )
    if not {"v", "a"} & set(measured):
        notes.append(
            "neither linear velocity nor acceleration is recorded of every link: the tree follows "
            "from turning alone, and places of joints cannot be learned"
        )
    return Channels(values, {k: lacking[k] for k in values}, measured, tuple(notes))


def _heard(log: Log, rows: np.ndarray) -> dict[str, Array]:
    """By channel (k, links, 3) those in which some link moves."""
    heard: dict[str, Array] = {}
    for table, names in ((log.twists, ("v", "w")), (log.accels, ("a", "dw"))):
        if table is None:
            continue
        for k, name in enumerate(names):
            part = table[rows][:, :, 3 * k : 3 * k + 3]
            size = np.nanmax(np.abs(part), initial=0.0, where=np.isfinite(part), axis=(0, 2))
            if (size > STILL).any():
                heard[name] = part
    return heard


def listed(names: Sequence[str], which: np.ndarray) -> str:
    """Names of some links; where most are meant, of those that are not."""
    rest = [name for name, there in zip(names, which, strict=True) if not there]
    if len(rest) <= 2 < len(names) - len(rest):
        return f"(all {len(names)}{''.join(f', not {name}' for name in rest)})"
    return ", ".join(name for name, there in zip(names, which, strict=True) if there)


# --- onto one even grid ------------------------------------------------------------------------


@dataclass
class _EvenSignals:
    """All signals at the joints' typical rate, and where all of them were heard (m,)."""

    rate_hz: float
    heard: np.ndarray
    joints: dict[str, Array] = field(default_factory=dict)
    motion: dict[str, Array] = field(default_factory=dict)
    tau: Array | None = None


def _resampled(log: Log, t_s: Array, rows: np.ndarray, channels: Channels) -> _EvenSignals:
    """Signals at increasing times t_s, which belong to these rows of the recording."""
    period_s = float(np.median(np.diff(t_s)))
    grid: Array = np.asarray(period_s * np.arange(int(np.floor(t_s[-1] / period_s + 1e-6)) + 1))
    even = _EvenSignals(1.0 / period_s, np.ones(len(grid), dtype=bool))
    q = log.q[rows].copy()
    for column in q.T:  # no filter would survive the jumps of whole turns
        known = np.isfinite(column)
        column[known] = np.unwrap(column[known])
    for name, values in (("q", q), ("dq", log.dq[rows])):
        if name == "q" or np.isfinite(values).any(axis=0).all():
            even.joints[name] = _onto(grid, t_s, values, even.heard)
    for channel, values in channels.values.items():
        links = range(values.shape[1])
        even.motion[channel] = np.stack(
            [_onto(grid, t_s, values[:, k], even.heard) for k in links], axis=1
        )
    heard_s = float(even.heard.sum() * period_s)
    if heard_s < SHORTEST_S:
        tables = [table for table in (log.twists, log.accels) if table is not None]
        counts = []
        for k, name in enumerate(log.link_names):
            share = min(float(np.isfinite(table[:, k]).any(axis=1).mean()) for table in tables)
            counts.append(f"{name} {100 * share:.0f} %")
        raise SettingsError(
            f"{log.path}: only {heard_s:.2f} s have all of {', '.join(channels.values)} of every "
            "link and all joint signals at the same time; stamps with link motion: "
            f"{', '.join(counts)}"
        )
    torque = log.tau[rows]
    if np.isfinite(torque).any(axis=0).all():
        even.tau = _onto(grid, t_s, torque, even.heard.copy())
    return even


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


# --- one filter for all, and the noise it leaves -----------------------------------------------


class ZeroPhase:
    """Zero-phase Butterworth, then every so many samples.

    Attributes:
        cutoff_hz: its corner, lower than asked for where the sample rate wants it.
        step: one in so many samples is kept; edge: so many at either end are not.
        passes: share of the variance of white noise that passes.
        rate_passes: variance of the rate of change of filtered white noise of variance one, 1/s².
    """

    def __init__(self, rate_hz: float, cutoff_hz: float) -> None:
        self.rate_hz = rate_hz
        self.cutoff_hz = min(cutoff_hz, CUTOFF_SHARE * rate_hz)
        self._sos = butter(ORDER, self.cutoff_hz, fs=rate_hz, output="sos")
        self.step = max(1, int(rate_hz / (KEPT_PER_CUTOFF * self.cutoff_hz)))
        self.edge = int(np.ceil(rate_hz / self.cutoff_hz))
        f = np.linspace(0.0, rate_hz / 2, 4000)
        passes = 1.0 / (1.0 + (f / self.cutoff_hz) ** (2 * ORDER)) ** 2
        self.passes = float(np.mean(passes))
        self.rate_passes = float(np.mean(passes * (2 * np.pi * f) ** 2))

    def __call__(self, x: Array) -> Array:
        flat = x.reshape(len(x), -1)
        return np.asarray(sosfiltfilt(self._sos, flat, axis=0)).reshape(x.shape)

    def rate_of(self, smooth: Array) -> Array:
        """d/dt of what was filtered at full rate."""
        return np.asarray(np.gradient(smooth, 1.0 / self.rate_hz, axis=0))


def _joint_signals(
    joints: dict[str, Array], through: ZeroPhase
) -> tuple[Array, Array, Array, dict[str, Array]]:
    """Filtered q, dq, ddq (m, n), and the variances (n,) of their noise by name."""
    noise = {k: noise_from_samples(x) ** 2 * through.passes for k, x in joints.items()}
    q = through(joints["q"])
    if "dq" in joints:
        dq = through(joints["dq"])
        noise["ddq"] = noise["dq"] / through.passes * through.rate_passes
    else:
        dq = through.rate_of(q)
        noise["dq"] = noise["q"] / through.passes * through.rate_passes
        # not white any more: at most all of it at the corner
        noise["ddq"] = noise["dq"] * (2 * np.pi * through.cutoff_hz) ** 2
    noise["q"] = np.minimum(noise["q"], ENCODER_STEP**2)
    return q, dq, through.rate_of(dq), noise


def _complete_turning(
    motion: dict[str, Array], noise: dict[str, Array], channels: Channels, through: ZeroPhase
) -> np.ndarray:
    """Fill in w by dw and dw by w, link by link, and the variances of their noise.

    Returns:
        Links (links,) bool whose w was not measured but added up from dw, from zero.
    """
    known = motion["w"] if "w" in motion else motion["dw"]
    samples, links = known.shape[:2]
    lacking = {k: channels.lacking.get(k, np.ones(links, dtype=bool)) for k in ("w", "dw")}
    for k in ("w", "dw"):
        motion.setdefault(k, np.zeros_like(known))
        noise.setdefault(k, np.zeros(links))
    by_dw, by_w = lacking["w"], lacking["dw"]
    rate = through.rate_of(motion["w"][:, by_w])
    motion["w"][:, by_dw] = np.cumsum(motion["dw"][:, by_dw], axis=0) / through.rate_hz
    motion["dw"][:, by_w] = rate
    drift = samples / through.rate_hz**2
    noise["w"][by_dw] = noise["dw"][by_dw] / through.passes * drift
    noise["dw"][by_w] = noise["w"][by_w] / through.passes * through.rate_passes
    return by_dw


def _noise(x: Array) -> Array:
    """Variance (links,) of one component's white noise, if it came at the joints' rate.

    A sensor that is heard less often has more of its noise below the filter's corner.
    """
    out = np.zeros(x.shape[1])
    for k in range(x.shape[1]):
        heard = x[np.isfinite(x[:, k]).all(axis=1), k]
        out[k] = np.mean(noise_from_samples(heard) ** 2) * len(x) / len(heard)
    return out
