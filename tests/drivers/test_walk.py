"""Messages whose sizes come again in turn are found at once, and none else than one by one."""

import struct

import numpy as np
import pytest
from mcap.opcode import Opcode

from drivers.files.mcap.records import walk

MESSAGE, CHANNEL, INVALID = int(Opcode.MESSAGE), int(Opcode.CHANNEL), 0
HEAD = struct.calcsize("<BQ")


def one(opcode: int, length: int, rng: np.random.Generator) -> bytes:
    return struct.pack("<BQ", opcode, length) + rng.bytes(length)


def one_by_one(data: bytes, most: int | None) -> tuple[list[int], list[int], int]:
    start, stop, at = [], [], 0
    while at + HEAD <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        if opcode == INVALID or at + HEAD + length > len(data):
            break
        if opcode == MESSAGE:
            if len(start) == most:
                break
            start.append(at + HEAD + 22)
            stop.append(at + HEAD + length)
        at += HEAD + length
    return start, stop, at


@pytest.mark.parametrize("most", [None, 50, 333])
@pytest.mark.parametrize("seed", range(12))
def test_a_walk_finds_what_is_there(seed, most):
    rng = np.random.default_rng(seed)
    parts: list[bytes] = []
    for _ in range(rng.integers(1, 6)):
        sizes = rng.integers(22, 90, rng.integers(1, 13))  # some turns are longer than looked for
        for _ in range(rng.integers(1, 60)):
            parts += [one(MESSAGE, int(x), rng) for x in sizes]
        if rng.random() < 0.7:
            parts.append(one(CHANNEL, int(rng.integers(0, 40)), rng))
    data = b"".join(parts)
    data = data[: len(data) - int(rng.integers(0, 60))] + bytes(int(rng.integers(0, 40)))
    found = walk(memoryview(data), 0, frozenset({INVALID}), most)
    start, stop, end = one_by_one(data, most)
    assert (list(found.start), list(found.stop), found.end) == (start, stop, end)
    assert found.full == (most is not None and len(start) == most and end < len(data))
