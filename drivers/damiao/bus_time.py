"""Whether the frames of a tick fit on a CAN bus."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.interface import DriverError

# By whether frames are FD: bits of a torque command and of a state reply, each the mean of 200 such
# as an arm has them, and of the longest frame; each (at the arbitration rate, at the data rate),
# with stuff bits and the gap behind (ISO 11898-1). Of an FD frame those up to BRS and from ACK on
# go at the arbitration rate.
BITS = {
    False: ((122.945, 0.0), (114.94, 0.0), (135, 0)),
    True: ((30.435, 106.86), (30.0, 99.32), (33, 114)),
}
TYPICAL_SHARE = 0.85  # of a tick that typical frames may fill; motors and hosts need gaps
WORST_SHARE = 1.0
ROUND_RATES_HZ = (1000, 800, 500, 400, 250, 200, 100, 50)


@dataclass(frozen=True)
class BusTime:
    """Bus time of one tick.

    Attributes:
        typical_us, worst_us: of all its frames, back to back.
        reply_us: typical, of one reply.
        load: typical share of the tick.
    """

    typical_us: float
    worst_us: float
    reply_us: float
    load: float


def budget(
    joints: int, rate_hz: int, fd: bool, bitrate: int, data_bitrate: int | None = None
) -> BusTime:
    """Bus time of one command to and one reply from each joint.

    Args:
        joints: on this bus.
        rate_hz: of ticks.
        fd: FD frames with bit-rate switch.
        bitrate, data_bitrate: bit/s; the latter `bitrate` where None or not FD.

    Raises:
        DriverError: they do not fit; the message says what would.
    """
    found = frame_times(joints, rate_hz, fd, bitrate, data_bitrate)
    if _fits(found, rate_hz):
        return found
    ways = []
    for rate in ROUND_RATES_HZ:
        slower = frame_times(joints, rate, fd, bitrate, data_bitrate)
        if rate < rate_hz and _fits(slower, rate):
            ways.append(f"at most {rate} Hz (?rate={rate})")
            break
    for data_rate in (5_000_000, 8_000_000):
        faster = frame_times(joints, rate_hz, True, bitrate, data_rate)
        if _fits(faster, rate_hz):
            ways.append(f"CAN FD with {data_rate / 1e6:g} Mbit/s (?fd=1&data_bitrate={data_rate})")
            break
    ways.append("fewer joints on this bus")
    fast = f"/{(data_bitrate or bitrate) / 1e6:g}" if fd else ""
    kind = f"{'CAN FD' if fd else 'classic CAN'} {bitrate / 1e6:g}{fast}"
    raise DriverError(
        f"{2 * joints} frames take {found.typical_us:.0f} us (at worst {found.worst_us:.0f}) on "
        f"{kind} Mbit/s: {100 * found.load:.0f} % of a tick at {rate_hz} Hz; what fits: "
        + ", or ".join(ways)
    )


def frame_times(
    joints: int, rate_hz: int, fd: bool, bitrate: int, data_bitrate: int | None = None
) -> BusTime:
    """As `budget`, without judging."""
    fast = float(data_bitrate or bitrate) if fd else float(bitrate)
    command, reply, worst = (
        1e6 * (slow_bits / bitrate + fast_bits / fast) for slow_bits, fast_bits in BITS[fd]
    )
    typical_us = joints * (command + reply)
    return BusTime(typical_us, 2 * joints * worst, reply, typical_us * rate_hz / 1e6)


def _fits(found: BusTime, rate_hz: int) -> bool:
    return found.load <= TYPICAL_SHARE and found.worst_us * rate_hz / 1e6 <= WORST_SHARE
