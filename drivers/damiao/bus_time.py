"""Whether the frames of a tick fit on a CAN bus.

Classic frame, ISO 11898-1: start, 11-bit id, RTR, IDE, r0, DLC, data and CRC15 are stuffed; then
13 bits with the interframe gap. FD frame: the bits up to BRS and from ACK on go at the arbitration
rate, those between at the data rate; the CRC17 has fixed stuff bits.
"""

from __future__ import annotations

import random
from dataclasses import dataclass
from functools import cache

from drivers.damiao.codec import FRAME_BYTES
from drivers.interface import DriverError

CLASSIC_TAIL = 13  # CRC delimiter, ACK, ACK delimiter, 7 of end of frame, 3 of gap
FD_TAIL = 12  # the same without the CRC delimiter, which is sent at the data rate
FD_CHECK = 28  # stuff count 4, CRC17, their 6 fixed stuff bits, CRC delimiter
CRC15_POLYNOMIAL, CRC15_BITS = 0x4599, 15
STUFF_AFTER = 5  # equal bits
TYPICAL_SHARE = 0.85  # of a tick that typical frames may fill; motors and hosts need gaps
WORST_SHARE = 1.0
ROUND_RATES_HZ = (1000, 800, 500, 400, 250, 200, 100, 50)
TYPICAL_FRAMES = 200  # drawn to find the mean number of stuff bits


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
        1e6 * (slow_bits / bitrate + fast_bits / fast) for slow_bits, fast_bits in _bit_counts(fd)
    )
    typical_us = joints * (command + reply)
    return BusTime(typical_us, 2 * joints * worst, reply, typical_us * rate_hz / 1e6)


def classic_bits(can_id: int, data: bytes) -> int:
    """Bits of a classic data frame with 11-bit id, stuff bits and interframe gap included."""
    body = [0, *_bits(can_id, 11), 0, 0, 0, *_bits(len(data), 4)]
    for byte in data:
        body += _bits(byte, 8)
    body += _bits(_crc15(body), CRC15_BITS)
    return len(body) + _stuffed(body) + CLASSIC_TAIL


def fd_bits(can_id: int, data: bytes) -> tuple[int, int]:
    """(bits at the arbitration rate, bits at the data rate) of an FD frame with bit-rate switch.

    `data` has at most 8 bytes.
    """
    head = [0, *_bits(can_id, 11), 0, 0, 1, 0, 1]  # start, id, RRS, IDE, FDF, res, BRS
    body = [0, *_bits(len(data), 4)]  # ESI, DLC
    for byte in data:
        body += _bits(byte, 8)
    in_head = _stuffed(head)
    in_body = _stuffed(head + body) - in_head
    return len(head) + in_head + FD_TAIL, len(body) + in_body + FD_CHECK


def _fits(found: BusTime, rate_hz: int) -> bool:
    return found.load <= TYPICAL_SHARE and found.worst_us * rate_hz / 1e6 <= WORST_SHARE


@cache
def _bit_counts(fd: bool) -> tuple[tuple[float, float], tuple[float, float], tuple[int, int]]:
    """(slow, fast) bits of a torque command and a state reply in the mean, and of the longest."""
    draw = random.Random(0)
    sums = [[0, 0], [0, 0]]
    for k in range(TYPICAL_FRAMES):
        joint = k % 7 + 1
        tau = draw.randrange(0x600, 0xA00)  # around zero, as an arm needs
        command = bytes((0x7F, 0xFF, 0x7F, 0xF0, 0, 0, tau >> 8, tau & 0xFF))
        for total, can_id, data in (
            (sums[0], joint, command),
            (sums[1], joint + 0x10, draw.randbytes(FRAME_BYTES)),
        ):
            slow, fast = fd_bits(can_id, data) if fd else (classic_bits(can_id, data), 0)
            total[0] += slow
            total[1] += fast
    command_bits, reply_bits = (
        (slow / TYPICAL_FRAMES, fast / TYPICAL_FRAMES) for slow, fast in sums
    )
    stuffable_classic = 19 + 8 * FRAME_BYTES + CRC15_BITS
    longest = (stuffable_classic + (stuffable_classic - 1) // 4 + CLASSIC_TAIL, 0)
    if fd:
        body = 5 + 8 * FRAME_BYTES
        longest = (17 + (17 - 1) // 4 + FD_TAIL, body + body // 4 + FD_CHECK)
    return command_bits, reply_bits, longest


def _bits(value: int, width: int) -> list[int]:
    return [value >> k & 1 for k in range(width - 1, -1, -1)]


def _crc15(bits: list[int]) -> int:
    crc = 0
    for bit in bits:
        top = crc >> (CRC15_BITS - 1) & 1
        crc = crc << 1 & 0x7FFF
        if top ^ bit:
            crc ^= CRC15_POLYNOMIAL
    return crc


def _stuffed(bits: list[int]) -> int:
    """Stuff bits: one of the other value after five equal ones, itself counting on."""
    count, run, last = 0, 0, -1
    for bit in bits:
        run = run + 1 if bit == last else 1
        last = bit
        if run == STUFF_AFTER:
            count += 1
            run, last = 1, 1 - bit
    return count
