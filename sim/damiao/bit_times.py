"""How long a CAN frame occupies the wire, to the bit (ISO 11898-1).

A frame of equal bits in a row gets a stuff bit after every fifth. Classic: everything from start
of frame to checksum is stuffed. FD: up to the last data bit; the checksum field has fixed ones.
"""

from __future__ import annotations

from functools import lru_cache

import can

ERROR_FRAME_BITS = 23  # flag 6, echo of the others up to 6, delimiter 8, gap 3
CLASSIC_TAIL_BITS = 13  # checksum delimiter, acknowledge and its delimiter, end 7, gap 3
FD_TAIL_BITS = 12  # the same without the checksum delimiter, which is sent at the data rate
CRC15 = 0x4599
SHORT_CRC_BYTES = 16  # FD frames of more bytes have a checksum of 21 bits instead of 17
FD_SIZES = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)

State = tuple[int, int]  # last bit (-1 before any), length of its run


@lru_cache(maxsize=1 << 16)
def stuffed(bits: int, width: int, state: State) -> tuple[int, State]:
    """Stuff bits that `width` bits get after what `state` tells, and the state after them.

    A stuff bit is counted with the bit that it precedes.
    """
    last, run = state
    count = 0
    for k in range(width - 1, -1, -1):
        bit = bits >> k & 1
        if run == 5:
            count, last, run = count + 1, 1 - last, 1
        run = run + 1 if bit == last else 1
        last = bit
    return count, (last, run)


def frame_ns(message: can.Message, bitrate: int, data_bitrate: int) -> int:
    """Time from start of frame to the end of the gap after it, ns.

    Args:
        message: 11-bit data frame or error frame.
        bitrate: bit/s, of arbitration and of classic frames.
        data_bitrate: bit/s, of the data of an FD frame with bit-rate switch.
    """
    if message.is_error_frame:
        return round(ERROR_FRAME_BITS * 1e9 / bitrate)
    if not message.is_fd:
        return round(classic_bits(message.arbitration_id, bytes(message.data)) * 1e9 / bitrate)
    slow, fast = fd_bits(message.arbitration_id, bytes(message.data), message.bitrate_switch)
    return round(slow * 1e9 / bitrate + fast * 1e9 / data_bitrate)


def classic_bits(identifier: int, data: bytes) -> int:
    """Bits of a classic frame, stuff bits and gap included."""
    head = identifier << 7 | len(data)  # start, id, then three dominant bits and the length
    count, state = stuffed(head, 19, (-1, 0))
    for byte in data:
        more, state = stuffed(byte, 8, state)
        count += more
    more, state = stuffed(_crc15(head, data), 15, state)
    count += more + (state[1] == 5)
    return 19 + 8 * len(data) + 15 + count + CLASSIC_TAIL_BITS


def fd_bits(identifier: int, data: bytes, switch: bool) -> tuple[int, int]:
    """Bits of an FD frame at the arbitration rate and at the data rate, gap included."""
    # Start, id, two dominant bits (RRS, IDE), FDF, a dominant one (res), BRS.
    slow, state = stuffed(identifier << 5 | 0b00100 | switch, 17, (-1, 0))
    size = next(size for size in FD_SIZES if size >= len(data))
    fast, state = stuffed(FD_SIZES.index(size), 5, state)  # ESI and length code
    for byte in data.ljust(size, b"\0"):
        more, state = stuffed(byte, 8, state)
        fast += more
    checksum = 4 + (17 if size <= SHORT_CRC_BYTES else 21)  # with the stuff count
    fixed = 1 + checksum // 4
    slow, fast = slow + 17 + FD_TAIL_BITS, fast + 5 + 8 * size + checksum + fixed + 1
    return (slow, fast) if switch else (slow + fast, 0)


def _crc15(head: int, data: bytes) -> int:
    """Checksum of a classic frame from start of frame to the last data bit."""
    crc = _crc_of(head, 19, 0)
    for byte in data:
        crc = _crc_of(byte, 8, crc)
    return crc


@lru_cache(maxsize=1 << 18)
def _crc_of(bits: int, width: int, crc: int) -> int:
    for k in range(width - 1, -1, -1):
        invert = (bits >> k & 1) ^ (crc >> 14)
        crc = (crc << 1 & 0x7FFF) ^ (CRC15 if invert else 0)
    return crc
