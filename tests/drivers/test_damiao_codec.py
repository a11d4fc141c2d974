"""Bytes and bus times of Damiao motors, against the reference page's golden frames and tables."""

import math

import numpy as np
import pytest

from drivers.damiao import codec
from drivers.damiao.arm import TORQUE_FRAMES
from drivers.damiao.codec import Scales, WireError
from drivers.damiao.settings import BusSettings, budget, frame_times
from drivers.damiao.tables import FAULTS, MOTOR_TYPES, OPENARM, fault_of, type_of
from drivers.interface import DriverError

DM4310, DM4340, DM8009 = MOTOR_TYPES["DM4310"], MOTOR_TYPES["DM4340"], MOTOR_TYPES["DM8009"]


def test_golden_frames():
    for limits in MOTOR_TYPES.values():
        assert codec.mit_command(limits) == bytes.fromhex("7fff7ff0000007ff")
    assert codec.refresh(3) == bytes.fromhex("0300cc0000000000")
    assert codec.read_register(3, 21) == bytes.fromhex("0300331500000000")
    assert codec.write_register(3, 10, 1) == bytes.fromhex("0300550a01000000")
    assert bytes.fromhex("fffffffffffffffc") == codec.ENABLE
    assert bytes.fromhex("fffffffffffffffd") == codec.DISABLE
    assert bytes.fromhex("fffffffffffffffb") == codec.CLEAR_ERROR


@pytest.mark.parametrize(
    ("name", "q", "dq", "tau"),
    [
        ("DM4310", -1.9e-4, -0.0073, -0.0024),
        ("DM4310P", -1.9e-4, -0.0122, -0.0024),
        ("DM4340", -1.9e-4, -0.0024, -0.0068),
        ("DM8009", -1.9e-4, -0.0110, -0.0132),
        ("DM10010", -1.9e-4, -0.0049, -0.0488),
        ("DMH3510", -1.9e-4, -0.0684, -0.0002),
    ],
)
def test_zero_comes_out_half_a_step_low(name, q, dq, tau):
    said = codec.state(MOTOR_TYPES[name], bytes.fromhex("13") + b"\x7f\xff\x7f\xf7\xff\x1e\x1f")
    assert said.q == pytest.approx(q, abs=6e-6)
    assert said.dq == pytest.approx(dq, abs=6e-5)
    assert said.tau == pytest.approx(tau, abs=6e-5)
    assert (said.status, said.motor, said.mosfet_degc, said.rotor_degc) == (1, 3, 30, 31)


def test_codes_are_clamped_and_truncated():
    full = int.from_bytes(codec.mit_command(DM4310, 12.5, -30, 500, 0, 10), "big")
    assert full == 0xFFFF_000F_FF00_0FFF
    assert codec.mit_command(DM4310, 99, -99, 9e9, -1, math.inf) == full.to_bytes(8, "big")
    step = 25 / 65535
    for share in (0.01, 0.5, 0.99):  # anywhere between two codes gives the lower one
        data = codec.mit_command(DM4310, q=-12.5 + (1000 + share) * step)
        assert int.from_bytes(data[:2], "big") == 1000
    with pytest.raises(WireError, match="not a number"):
        codec.mit_command(DM4310, tau=math.nan)


def test_no_command_is_taken_for_a_special_frame():
    for tau in np.linspace(9.9, 10.0, 200):
        data = codec.mit_command(DM4310, 12.5, 30, 500, 5, tau)
        assert data[:7] != b"\xff" * 7
        assert data[1:6] == b"\xfe" + b"\xff" * 4  # one step of the angle, nothing else
    assert all(frame[:7] != b"\xff" * 7 for frame in TORQUE_FRAMES)


def test_torque_frames_are_what_the_codec_makes():
    for limits in MOTOR_TYPES.values():
        for tau in np.linspace(-limits.tau_max, limits.tau_max, 777):
            code = int((tau + limits.tau_max) / (limits.tau_max + limits.tau_max) * 4095)
            assert TORQUE_FRAMES[code] == codec.mit_command(limits, tau=tau)


def test_registers():
    reply = bytes.fromhex("03003315") + b"\x00\x00\x48\x41"
    assert codec.register_reply(reply, 3, codec.READ, codec.PMAX) == 12.5
    echo = bytes.fromhex("0300550a01000000")
    assert codec.register_reply(echo, 3, codec.WRITE, codec.CTRL_MODE) == 1
    for motor, operation, register in ((4, codec.READ, 21), (3, codec.WRITE, 21), (3, 0x33, 22)):
        with pytest.raises(WireError, match="not the reply"):
            codec.register_reply(reply, motor, operation, register)
    with pytest.raises(WireError, match="8 bytes"):
        codec.register_reply(reply[:7], 3, codec.READ, 21)
    for register, value in ((codec.TIMEOUT, -1), (codec.TIMEOUT, 2**32), (codec.TMAX, 1e300)):
        with pytest.raises(WireError, match="cannot hold"):
            codec.write_register(1, register, value)


def test_a_state_may_look_like_a_register_reply():
    """Byte 2 of a state, the low byte of its angle, can be 0x33: the register trap."""
    data = bytes.fromhex("0300331500000000")
    assert codec.state(DM4310, data).q == pytest.approx(-12.5 + 0x33 / 65535 * 25)
    assert codec.register_reply(data, 3, codec.READ, codec.PMAX) == 0.0


def test_limits_must_be_numbers_above_zero():
    for wrong in ((0.0, 1, 1), (1, -2, 1), (1, 1, math.nan), (math.inf, 1, 1)):
        with pytest.raises(WireError, match="above zero"):
            Scales(*wrong)


def test_motor_table():
    assert [type_of(MOTOR_TYPES[name]) for name in OPENARM] == list(OPENARM)
    assert type_of(Scales(12.5, 8.0, 28.0)) == "unknown type"
    assert fault_of(0) is None
    assert fault_of(1) is None
    for status in range(2, 16):
        assert fault_of(status).advice
    assert set(FAULTS) == {5, 6, 8, 9, 0xA, 0xB, 0xC, 0xD, 0xE}


@pytest.mark.parametrize(
    ("joints", "fd", "data_rate", "typical", "low", "high"),
    [
        (7, False, None, 1668, 1554, 1890),
        (4, False, None, 953, 888, 1080),
        (3, False, None, 715, 666, 810),
        (7, True, 2_000_000, 1147, 1085, 1260),
        (7, True, 5_000_000, 713, 678, 781),
        (8, True, 5_000_000, 815, 774, 893),
        (7, True, 8_000_000, 605, 576, 662),
        (7, True, 1_000_000, 1880, 1764, 2058),
    ],
)
def test_bus_time_is_the_reference_tables(joints, fd, data_rate, typical, low, high):
    found = frame_times(joints, 1000, fd, 1_000_000, data_rate)
    assert found.typical_us == pytest.approx(typical, rel=0.01)
    assert found.worst_us == pytest.approx(high, rel=0.001)
    assert low < found.typical_us < found.worst_us
    assert found.load == pytest.approx(found.typical_us / 1000)


def test_what_does_not_fit_is_refused_with_what_does():
    with pytest.raises(DriverError, match=r"at most 500 Hz \(\?rate=500\), or CAN FD") as refused:
        budget(7, 1000, False, 1_000_000)
    assert "167 %" in str(refused.value)
    with pytest.raises(DriverError, match=r"4 frames|8 frames take 95\d us"):
        budget(4, 1000, False, 1_000_000)
    for fits in ((7, 500, False, 1_000_000), (3, 1000, False, 1_000_000)):
        assert budget(*fits).load < 0.86
    assert budget(7, 1000, True, 1_000_000, 5_000_000).load == pytest.approx(0.71, abs=0.01)
    with pytest.raises(DriverError, match="data_bitrate=5000000"):
        budget(7, 1000, True, 1_000_000, 2_000_000)


def test_addresses():
    plain = BusSettings.of("can://can0")
    assert (plain.interface, plain.fd, plain.rate_hz, list(plain.ids)) == (
        "socketcan",
        True,
        1000,
        [1, 2, 3, 4, 5, 6, 7],
    )
    assert plain.reply_ids == tuple(range(0x11, 0x18))
    udp = BusSettings.of("can://239.74.163.2:5000?interface=udp_multicast", ("a", "b"))
    assert (udp.port, udp.joints) == (5000, 2)


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("can://can0?speed=1", "have: interface, fd, bitrate"),
        ("can://can0?fd=yes", "0 or 1"),
        ("can://can0?rate=5000", "from 20 to 1000"),
        ("can://can0?joints=9&first_id=9", "at most 15"),
        ("can://can0?reply_offset=3", "mixes replies"),
        ("can://can0:77", "only interface=udp_multicast takes a port"),
        ("can://can0?joints=6", "joints=6"),
        ("fci://can0", "no CAN arm"),
    ],
)
def test_wrong_addresses_are_explained(address, said):
    with pytest.raises(DriverError, match=said):
        BusSettings.of(address, tuple("abcdefg") if "joints=6" in address else None)
