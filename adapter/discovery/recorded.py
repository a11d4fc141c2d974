"""A recording made ready for discovery: one even grid, one filter for all, noise levels known.

Every signal goes through the same zero-phase Butterworth filter, so that whatever belonged to one
instant still does. Products such as Rz(q) w are formed after it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.discovery.zero_phase import KEPT_PER_CUTOFF, ZeroPhase
from adapter.errors import SettingsError
from adapter.filters import noise_from_samples
from adapter.spatial import Array
from drivers.mcap_file import Log

CHANNELS = ("w", "dw", "v", "a")  # of link motion; the angular ones first
CUTOFF_HZ = 20.0  # motion of arms and legs lies below
SHORTEST_S = 0.5  # less motion than this decides nothing
GAP_S = 0.05  # a longer silence of a sensor is not bridged
STILL = 1e-9  # a channel that never exceeds this was not measured but filled in
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

    @property
    def motion_samples(self) -> float:
        """How many independent samples the motion itself is worth, at least one."""
        return max(1.0, 2.0 * self.duration_s * self.motion_hz)

    @property
    def noise_samples(self) -> float:
        """How many independent samples of noise the filter leaves, at least two."""
        return max(2.0, 2.0 * self.duration_s * self.cutoff_hz)


_ASSUMED_REST = (
    "no angular velocity of links is recorded; it is added up from their angular acceleration, "
    "all links taken to be at rest at the start"
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
    _check(log, cutoff_hz)
    t_s, first = _times(log)
    measured, notes = _measured(log, first)
    grid, rate_hz = _grid(t_s)
    heard = np.ones(len(grid), dtype=bool)
    joints: dict[str, Array] = {}
    for name in ("q", "dq"):
        joints[name] = _onto(grid, t_s, getattr(log, name)[first], heard)
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
    return _filtered(log, through, grid, heard, joints, tau, motion, levels, notes)


def _check(log: Log, cutoff_hz: float) -> None:
    if not 0.0 < cutoff_hz < np.inf:
        raise SettingsError(f"the filter's corner must be above zero and finite, got {cutoff_hz}")
    links = ", ".join(log.link_names) or "none"
    if not log.link_names or (log.twists is None and log.accels is None):
        raise SettingsError(
            f"{log.path}: has no motion of links (topics /link_twists/<link> or "
            f"/link_accels/<link>), of links: {links}; it needs that of every link, measured in "
            "the link's own frame"
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


def _times(log: Log) -> tuple[Array, np.ndarray]:
    """Seconds from the start, increasing, and the rows of the recording they belong to."""
    stamps, first = np.unique(log.stamp_ns, return_index=True)
    return 1e-9 * (stamps - stamps[0]).astype(np.float64), first


def _measured(log: Log, rows: np.ndarray) -> tuple[dict[str, Array], list[str]]:
    """The channels that hold anything, (k, links, 3) each."""
    found: dict[str, Array] = {}
    for table, names in ((log.twists, ("v", "w")), (log.accels, ("a", "dw"))):
        if table is None:
            continue
        for k, name in enumerate(names):
            part = table[rows][:, :, 3 * k : 3 * k + 3]
            size = np.nanmax(np.abs(part), initial=0.0, where=np.isfinite(part), axis=(0, 2))
            if (size > STILL).any() and np.isfinite(part).any(axis=(0, 2)).all():
                found[name] = part
    notes = []
    missing = [name for name in CHANNELS if name not in found]
    if "w" in missing and "dw" in missing:
        raise SettingsError(
            f"{log.path}: has neither angular velocity nor angular acceleration of every link; "
            f"has: {', '.join(found) or 'nothing'} of {', '.join(log.link_names)}"
        )
    if "w" in missing:
        notes.append(_ASSUMED_REST)
    return found, notes


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
    notes: list[str],
) -> Recorded:
    joint_noise = {k: noise_from_samples(x) ** 2 * through.passes for k, x in joints.items()}
    joint_noise["ddq"] = joint_noise["dq"] / through.passes * through.rate_passes
    joint_noise["q"] = np.minimum(joint_noise["q"], ENCODER_STEP**2)
    smooth = {k: through(x) for k, x in motion.items()}
    q, dq = through(joints["q"]), through(joints["dq"])
    ddq = through.rate_of(dq)
    if "dw" not in smooth:
        smooth["dw"] = through.rate_of(smooth["w"])
        noise["dw"] = noise["w"] / through.passes * through.rate_passes
    if "w" not in smooth:
        _check_start(log, dq[: 2 * through.edge])
        smooth["w"] = np.cumsum(smooth["dw"], axis=0) / through.rate_hz
        noise["w"] = noise["dw"] / through.passes * len(grid) / through.rate_hz**2
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
        measured=tuple(k for k in CHANNELS if k in motion),
        noise=noise,
        joint_noise=joint_noise,
        motion_hz=float(np.clip(change / max(2 * np.pi * speed, STILL), 0.05, through.cutoff_hz)),
        rate_hz=through.rate_hz,
        samples=int(keep.sum()),
        duration_s=float(keep.sum() * through.step / through.rate_hz),
        cutoff_hz=through.cutoff_hz,
        notes=tuple(notes),
    )


def _check_start(log: Log, dq: Array) -> None:
    fastest = float(np.abs(dq).max())
    if fastest > RESTING:
        name = log.joint_names[int(np.abs(dq).max(axis=0).argmax())]
        raise SettingsError(
            f"{log.path}: has no angular velocity of links (/link_twists), and it can be added up "
            f"from angular acceleration only from rest; joint {name} starts at "
            f"{fastest:.2g} rad/s (at most {RESTING})"
        )


def _noise(x: Array) -> Array:
    """Variance (links,) of one component's white noise, if it came at the joints' rate.

    A sensor that is heard less often has more of its noise below the filter's corner.
    """
    out = np.zeros(x.shape[1])
    for k in range(x.shape[1]):
        heard = x[np.isfinite(x[:, k]).all(axis=1), k]
        out[k] = np.mean(noise_from_samples(heard) ** 2) * len(x) / len(heard)
    return out
