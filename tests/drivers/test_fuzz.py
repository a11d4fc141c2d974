"""Whatever bytes arrive, decoders answer with a value or one sentence, and drivers go on.

Decoders and good inputs are those of the trials, of which there are a million.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.damiao.arm import DamiaoArm
from drivers.damiao.bus import UNREADABLE, unpack_datagram
from drivers.damiao.tables import troubles_of
from drivers.damiao.timing import ArrivalClock
from drivers.fci.codec import Reply, ReplyParser
from drivers.interface import DriverError
from tests.benchmarks.mutated_inputs import Decoder, mutated, wires
from tests.helpers import fci_peer
from tests.helpers.damiao_tools import LIMITS, Bank, MotorBus, reply_bytes, tick

MANY = 10_000


@pytest.fixture(scope="module")
def decoders() -> dict[str, Decoder]:
    return wires()


@pytest.mark.parametrize(
    "name",
    [
        *("fci state 5", "fci state 10", "fci requests", "fci command", "fci replies"),
        *("gripper requests", "can reply", "can register", "can datagram"),
    ],
)
def test_bytes_random_and_mutated(decoders: dict[str, Decoder], name: str) -> None:
    decoder, rng, refused = decoders[name], np.random.default_rng(1), 0
    good = decoder.seeds[0]
    count = MANY // 10 if "gripper" in name else MANY
    for k in range(count):
        data = rng.bytes(int(rng.integers(2 * len(good)))) if k % 2 else mutated(rng, good, False)
        try:
            decoder.read(data)
        except decoder.refuses as error:
            assert len(str(error)) > 20
            refused += 1
    decoder.read(good)
    assert not decoder.refuses or 0.05 * count < refused < 0.99 * count  # both were tried


def test_a_datagram_is_a_frame_or_unreadable(decoders: dict[str, Decoder]) -> None:
    (good,), rng = decoders["can datagram"].seeds, np.random.default_rng(1)
    assert unpack_datagram(good, 1.5) == (
        *(0x11, reply_bytes(1, 1, LIMITS[0], 1.0, 2.0, 3.0)),
        *(1.5, 0),
    )
    found = [unpack_datagram(mutated(rng, good, False), 2.0) for _ in range(MANY)]
    assert all(kind in (0, 1, 2) and stamp_s == 2.0 for _, _, stamp_s, kind in found)
    assert 0 < sum(can_id == UNREADABLE for can_id, *_ in found) < MANY


def test_error_frames() -> None:
    rng = np.random.default_rng(2)
    for _ in range(MANY):
        can_id = int(rng.integers(1 << 29))
        said = troubles_of(can_id, rng.bytes(int(rng.integers(10))), "can0")
        assert any("is bus-off" in trouble for trouble in said) == bool(can_id & 0x040)
        assert said and all(trouble.startswith("can0") for trouble in said)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    payloads=st.lists(st.binary(max_size=60), max_size=8),
    cuts=st.lists(st.integers(0, 600), max_size=8),
)
def test_replies_come_through_unchanged(payloads: list[bytes], cuts: list[int]) -> None:
    stream = b"".join(fci_peer.reply(1, k, payload) for k, payload in enumerate(payloads))
    places = sorted(min(cut, len(stream)) for cut in cuts)
    parser, ends = ReplyParser(), zip([0, *places], [*places, len(stream)], strict=True)
    got = [reply for begin, end in ends for reply in parser.feed(stream[begin:end])]
    assert got == [Reply(k, payload) for k, payload in enumerate(payloads)]


@settings(max_examples=300, deadline=None)
@given(st.lists(st.floats(allow_nan=False, min_value=-1e6, max_value=4e9), max_size=40))
def test_arrivals_lie_between_batches(stamps: list[float]) -> None:
    clock, wall_ns = ArrivalClock(), 1_700_000_000_000_000_000
    for k in range(3):
        now = 10**12 + k * 1_000_000
        clock.begin(now - 10_000, now, wall_ns + now)
        for stamp_s in stamps:
            assert clock.first_ns <= clock.unusual(stamp_s) <= now


def test_a_driver_under_garbage() -> None:
    """Frames of any id, length and content among the good ones: an account, and never a crash."""
    rng = np.random.default_rng(3)
    bus = MotorBus(Bank(motion=lambda t: (0.3, 0.0, 1.0)))
    clocks = {"now_ns": bus.clock.now_ns, "wall_ns": bus.clock.wall_ns}
    arm = DamiaoArm("can://x?interface=virtual", bus=bus, **clocks)
    arm.connect()
    good = [reply_bytes(j + 1, 0, LIMITS[j], 0.3, 0.0, 1.0) for j in range(7)]
    put = 0
    for _ in range(MANY // 10):
        for _ in range(10):
            j = int(rng.integers(7))
            data = mutated(rng, good[j], False)[:64]
            can_id = 0x11 + j if rng.random() < 0.5 else int(rng.integers(0x800))
            flags = {"is_error_frame": rng.random() < 0.1, "is_remote_frame": rng.random() < 0.1}
            bus.put(can_id, data, **flags)
            put += 1
        try:
            sample = tick(arm, bus)
        except DriverError as error:
            assert len(str(error)) > 30
            continue
        assert (np.abs(sample.q[np.isfinite(sample.q)]) < 100).all()
    intake = arm.intake
    assert put == MANY
    assert intake.received == intake.used + sum(intake.refused.values())
    assert len(intake.refused) >= 5 and len(intake.notes) < 60
    arm.close()
    bus.shutdown()
