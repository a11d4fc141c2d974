"""The simulated robot's bytes against offsets counted by hand from the published layouts."""

import struct
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from sim.fci.codec import (
    COMMAND_BYTES,
    ERRORS,
    LIMIT_REPLY,
    NAMES,
    BadRequest,
    Request,
    RequestReader,
    StateFrame,
    read_command,
    reply,
)
from sim.fci.server import robot_urdf
from sim.scenarios import build

# Field -> byte offset in version 5 (f64) and in version 10 (f32).
OFFSETS = {
    "O_T_EE": (8, 8), "O_T_EE_d": (136, 72), "F_T_EE": (264, 136), "EE_T_K": (392, 200),
    "F_T_NE": (520, 264), "NE_T_EE": (648, 328), "m_ee": (776, 392), "I_ee": (784, 396),
    "F_x_Cee": (856, 432), "m_load": (880, 444), "I_load": (888, 448), "F_x_Cload": (960, 484),
    "elbow": (984, 496), "elbow_d": (1000, 504), "tau_J": (1016, 512), "tau_J_d": (1072, 540),
    "dtau_J": (1128, 568), "q": (1184, 596), "q_d": (1240, 624), "dq": (1296, 652),
    "dq_d": (1352, 680), "ddq_d": (1408, 708), "joint_contact": (1464, 736),
    "cartesian_contact": (1520, 764), "joint_collision": (1568, 788),
    "cartesian_collision": (1624, 816), "tau_ext_hat_filtered": (1672, 840),
    "O_F_ext_hat_K": (1728, 868), "K_F_ext_hat_K": (1776, 892), "O_dP_EE_d": (1824, 916),
    "O_ddP_O": (1872, 940), "elbow_c": (1896, 952), "delbow_c": (1912, 960),
    "ddelbow_c": (1928, 968), "O_T_EE_c": (1944, 976), "O_dP_EE_c": (2072, 1040),
    "O_ddP_EE_c": (2120, 1064), "theta": (2168, 1088), "dtheta": (2224, 1116),
    "accelerometer_top": (None, 1144), "accelerometer_bottom": (None, 1216),
}  # fmt: skip
STATE = {5: (2373, "d", 2280), 10: (1377, "f", 1288)}  # size, float, first mode

versions = pytest.mark.parametrize("version", [5, 10])


@versions
def test_every_field_lies_where_it_is_published(version):
    frame = StateFrame(version)
    size, kind, modes = STATE[version]
    assert len(frame.data) == size
    for i, view in enumerate(frame.fields.values()):
        view[:] = 1000 * i + np.arange(len(view))
    expected = {name: at[version == 10] for name, at in OFFSETS.items()}
    assert set(frame.fields) == {name for name, at in expected.items() if at is not None}
    for i, (name, view) in enumerate(frame.fields.items()):
        found = struct.unpack_from(f"<{len(view)}{kind}", frame.data, expected[name])
        assert found == tuple(1000.0 * i + k for k in range(len(view))), name
    assert bytes(frame.data[modes:]) == bytes(size - modes)


@versions
def test_id_modes_and_flags_lie_where_they_are_published(version):
    frame = StateFrame(version)
    _, kind, modes = STATE[version]
    frame.set_id(0x0102030405060708)
    frame.set_modes(3, 2, 4, 0.25)
    frame.errors[25], frame.reflex_reason[40] = 1, 1
    data = bytes(frame.data)
    assert data[:8] == bytes((8, 7, 6, 5, 4, 3, 2, 1))
    assert (data[modes], data[modes + 1], data[modes + 84]) == (3, 2, 4)
    assert struct.unpack_from(f"<{kind}", data, modes + 85) == (0.25,)
    flags = data[modes + 2 : modes + 84]
    assert [i for i, flag in enumerate(flags) if flag] == [25, 41 + 40]
    assert not any(data[8:modes])


def test_errors_are_in_their_order():
    assert len(ERRORS) == len(set(ERRORS)) == 41
    golden = {
        0: "joint_position_limits_violation", 3: "joint_velocity_violation", 6: "joint_reflex",
        11: "joint_position_motion_generator_start_pose_invalid",
        14: "joint_motion_generator_velocity_discontinuity",
        15: "joint_motion_generator_acceleration_discontinuity",
        25: "communication_constraints_violation", 32: "controller_torque_discontinuity",
        34: "tau_J_range_violation", 40: "base_acceleration_invalid_reading",
    }  # fmt: skip
    assert {i: ERRORS[i] for i in golden} == golden


@versions
def test_command_is_read_from_its_offsets(version):
    data = bytearray(COMMAND_BYTES[version])
    struct.pack_into("<Q", data, 0, 7_000_000_001)
    struct.pack_into("<7d", data, 8, *range(1, 8))
    struct.pack_into("<7d", data, 64, *range(11, 18))
    struct.pack_into("<7d", data, 314, *range(21, 28))
    data[313] = 1
    found = read_command(bytes(data), version)
    assert (found.message_id, found.generator_finished) == (7_000_000_001, True)
    assert not found.torque_finished
    for values, first in ((found.q, 1), (found.dq, 11), (found.tau, 21)):
        assert values.tolist() == [float(first + k) for k in range(7)]
    if version == 10:
        data[313], data[370] = 0, 1
        found = read_command(bytes(data), version)
        assert (found.generator_finished, found.torque_finished) == (False, True)
    assert read_command(bytes(data[:-1]), version) is None
    assert read_command(bytes(data) + b"\0", version) is None


SIZES = {
    5: [16, 68, 12, 16, 428, 68, 60, 19, 140, 140, 116, 52, 12, 14],
    10: [16, 125, 12, 428, 68, 60, 19, 140, 140, 116, 12, 12],
}


@versions
def test_requests_come_in_pieces_and_in_their_sizes(version):
    stream = b"".join(
        struct.pack("<III", number, 40 + number, size) + bytes([number]) * (size - 12)
        for number, size in enumerate(SIZES[version])
    )
    reader, found = RequestReader(version), []
    for at in range(0, len(stream), 5):
        found += reader.feed(stream[at : at + 5])
    assert [r.name for r in found] == list(NAMES[version])
    assert [r.ident for r in found] == [40 + i for i in range(len(found))]
    assert [len(r.payload) + 12 for r in found] == SIZES[version]


@versions
@pytest.mark.parametrize("wrong", [(99, 12), (1, 12), (2, 13), (0, 0), (0, 1 << 31)])
def test_what_is_no_request_is_refused(version, wrong):
    number, size = wrong
    with pytest.raises(BadRequest):
        RequestReader(version).feed(struct.pack("<III", number, 0, size))


def test_replies_have_their_published_bytes():
    connect = Request("Connect", 0, 9, struct.pack("<HH", 5, 4000))
    assert connect.connect_terms() == (5, 4000)
    said = reply(connect, "ok", 5, struct.pack("<H", 5))
    assert said == bytes.fromhex("00000000 09000000 0f000000 00 0500")
    assert reply(connect, "incompatible", 5)[12:] == bytes((1,))
    move = Request("Move", 1, 2, struct.pack("<II", 2, 1) + bytes(48))
    assert move.move_modes() == (2, 1)
    assert reply(move, "motion started", 5) == bytes.fromhex("01000000 02000000 0d000000 01")
    limit = Request("GetCartesianLimit", 3, 0, bytes(4))
    assert len(reply(limit, "ok", 5, bytes(LIMIT_REPLY))) == 166


@pytest.mark.parametrize(
    ("name", "status", "codes"),
    [
        ("Move", "preempted", (2, 2)), ("Move", "not possible", (3, 5)),
        ("Move", "invalid argument", (5, 7)), ("Move", "reflex", (6, 8)),
        ("Move", "emergency", (7, 9)), ("Move", "aborted", (9, 11)),
        ("StopMove", "ok", (0, 0)), ("StopMove", "reflex", (3, 4)),
        ("StopMove", "emergency", (2, 3)),
        ("AutomaticErrorRecovery", "manual recovery required", (2, 3)),
        ("AutomaticErrorRecovery", "reflex", (3, 4)),
        ("AutomaticErrorRecovery", "emergency", (4, 5)),
        ("SetLoad", "invalid argument", (2, 2)), ("SetLoad", "not possible", (1, 1)),
    ],
)  # fmt: skip
def test_codes_shift_between_the_versions(name, status, codes):
    request = Request(name, 0, 0, b"")
    assert tuple(reply(request, status, version)[12] for version in (5, 10)) == codes


def test_urdf_has_what_libfranka_demands():
    root = ElementTree.fromstring(robot_urdf(build("bent_link", 1).truth))
    movable = [joint for joint in root.iter("joint") if joint.get("type") != "fixed"]
    assert [joint.get("name") for joint in movable] == [f"joint{k}" for k in range(1, 8)]
    for joint in movable:
        assert joint.find("position_based_velocity_limits").get("deceleration_limit")
        assert joint.find("limit").get("velocity")
    assert "link8" in {link.get("name") for link in root.iter("link")}
    assert not root.get("name").startswith("tmr")
