"""The FCI's bytes, held against offsets and frames written down independently of the codec.

Offsets, sizes and codes are those of the reference tables (libfranka 0.9.2 and 0.21.2 headers).
"""

import math
import struct

import numpy as np
import pytest

from drivers.fci import codec, tables
from drivers.fci.codec import CommandEncoder, StateDecoder, WireError
from tests.helpers import fci_peer

PROTOCOLS = pytest.mark.parametrize("protocol", [5, 10])
Q = tuple(0.25 * k for k in range(1, 8))  # exact in f32 as well
DQ = tuple(-0.5 * k for k in range(1, 8))
TAU = tuple(8.0 + k for k in range(7))
TAU_D = tuple(-16.0 - k for k in range(7))


def frame(protocol, **changes):
    fields = {"q": Q, "dq": DQ, "tau": TAU, "tau_d": TAU_D, "rate": 0.5, **changes}
    return fci_peer.state(protocol, 123456789, **fields)


def decode(protocol, data):
    return StateDecoder(protocol).decode(memoryview(data))


@PROTOCOLS
def test_a_golden_state_is_read_back(protocol):
    got = decode(protocol, frame(protocol, modes=(2, 1, 3), errors=(0, 40), reflex=(25,)))
    assert got.message_id == 123456789
    for values, expected in ((got.q, Q), (got.dq, DQ), (got.tau_J, TAU), (got.tau_J_d, TAU_D)):
        assert values.dtype == np.float64
        assert tuple(values) == expected
    assert got.success_rate == 0.5
    assert (got.status.generator, got.status.controller, got.status.robot_mode) == (2, 1, 3)
    assert tables.raised(got.status.errors) == (
        "joint_position_limits_violation",
        "base_acceleration_invalid_reading",
    )
    assert tables.raised(got.status.reflex_reason) == ("communication_constraints_violation",)


@PROTOCOLS
def test_what_is_no_state_is_refused_with_a_sentence(protocol):
    good = frame(protocol)
    _, _, _, _, _, modes, _ = fci_peer.PLACES[protocol]
    for data, why in (
        (good[:-1], "bytes; protocol"),
        (good + b"\0", "bytes; protocol"),
        (b"", "a state of 0 bytes"),
        (struct.pack("<Q", 1 << 41) + good[8:], "absurd message id"),
        (fci_peer.state(protocol, 1, modes=(0, 4, 1)), "unknown controller mode 4"),
        (fci_peer.state(protocol, 1, modes=(9, 3, 1)), "unknown motion generator mode 9"),
        (fci_peer.state(protocol, 1, modes=(0, 3, 8)), "unknown robot mode 8"),
        (good[: modes + 10] + b"\2" + good[modes + 11 :], "unknown error flag 2"),
    ):
        with pytest.raises(WireError, match=why):
            decode(protocol, data)


def test_modes_that_change_are_seen_each_time():
    decoder = StateDecoder(5)
    idle, moving = frame(5), frame(5, modes=(2, 2, 2))
    first = decoder.decode(memoryview(idle)).status
    assert decoder.decode(memoryview(frame(5, rate=0.75))).status is first
    assert decoder.decode(memoryview(moving)).status.robot_mode == 2
    assert decoder.decode(memoryview(idle)).status == first
    with pytest.raises(WireError):
        decoder.decode(memoryview(frame(5, modes=(2, 9, 2))))
    assert decoder.decode(memoryview(idle)).status == first


@PROTOCOLS
@pytest.mark.parametrize("finished", [False, True])
def test_a_golden_command(protocol, finished):
    expected = bytearray(fci_peer.COMMAND_SIZE[protocol])
    struct.pack_into("<Q", expected, 0, 77)
    struct.pack_into("<7d", expected, 314, *TAU)
    expected[313 if protocol == 5 else 370] = finished
    encoder = CommandEncoder(protocol)
    encoder.encode(1, np.ones(7), not finished)  # leaves nothing behind
    assert encoder.encode(77, np.array(TAU), finished) == expected


def test_golden_requests():
    connect = codec.request(0, 3, codec.connect_payload(5, 50000))
    assert connect == struct.pack("<IIIHH", 0, 3, 16, 5, 50000)
    deviation = (10.0, 3.12, 2 * math.pi)
    v5 = codec.request(1, 4, codec.move_payload(5))
    assert v5 == struct.pack("<IIIII6d", 1, 4, 68, 2, 1, *deviation, *deviation)
    v10 = codec.request(1, 4, codec.move_payload(10))
    rest = bytes(1 + 7 * 8)
    assert v10 == struct.pack("<IIIII6d", 1, 4, 125, 2, 4, *deviation, *deviation) + rest
    assert codec.request(12, 5) == struct.pack("<III", 12, 5, 12)


def test_impossible_replies_are_refused():
    for size in (0, 11, 1 << 30):
        with pytest.raises(WireError, match=f"says {size} bytes"):
            codec.ReplyParser().feed(struct.pack("<III", 1, 2, size))
    with pytest.raises(WireError, match="without a status"):
        codec.status_reply(b"")
    with pytest.raises(WireError, match="14 bytes; it has 15"):
        codec.connect_reply(b"\0\0")


def test_codes_shift_between_the_versions():
    for protocol, reflex, stopped in ((5, 6, 7), (10, 8, 9)):
        statuses = tables.MOVE_STATUS[protocol]
        assert tables.status_name(statuses, reflex) == "reflex"
        assert tables.status_name(statuses, stopped) == "user_stop"
    assert tables.status_name(tables.MOVE_STATUS[5], 3) == "not_possible"
    assert tables.status_name(tables.MOVE_STATUS[10], 5) == "not_possible"
    assert [len(tables.MOVE_STATUS[p]) for p in (5, 10)] == [10, 12]
    assert [len(tables.STOP_STATUS[p]) for p in (5, 10)] == [5, 6]
    assert [len(tables.RECOVER_STATUS[p]) for p in (5, 10)] == [6, 7]
    assert tables.status_name(tables.MOVE_STATUS[5], 200) == "status 200"


def test_each_error_and_status_says_what_to_do():
    assert len(tables.ERROR_NAMES) == tables.ERROR_COUNT == 41
    for index, name in (
        (6, "joint_reflex"),
        (25, "communication_constraints_violation"),
        (32, "controller_torque_discontinuity"),
        (36, "joint_move_in_wrong_direction"),
        (40, "base_acceleration_invalid_reading"),
    ):
        assert tables.ERROR_NAMES[index] == name
        bitmap = bytes(int(k == index) for k in range(41))
        assert tables.told(bitmap) == f"{name} ({tables.ERRORS[name]})"
    assert all(len(advice) > 20 for advice in tables.ERRORS.values())
    for table in (tables.MOVE_STATUS, tables.STOP_STATUS, tables.RECOVER_STATUS):
        assert all(name in tables.MEANING for names in table.values() for name in names)
    assert "not defined" in tables.meaning("status 200")
