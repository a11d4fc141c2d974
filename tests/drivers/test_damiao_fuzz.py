"""Random bytes and mutated frames into everything that decodes them: an error or a refusal."""

import math

import numpy as np
import pytest
from can.interfaces.udp_multicast.utils import pack_message
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.damiao import codec
from drivers.damiao.arm import DamiaoArm
from drivers.damiao.bus import UNREADABLE, message_for, unpack_datagram
from drivers.damiao.codec import Scales, WireError
from drivers.damiao.settings import BusSettings
from drivers.damiao.tables import troubles_of
from drivers.damiao.timing import ArrivalClock
from drivers.interface import DriverError
from tests.helpers.damiao_tools import LIMITS, Bank, MotorBus, reply_bytes, tick
from tests.helpers.mutations import mutated

MANY = 10_000
SCALES = Scales(*LIMITS[0])


def need_sound(said):
    assert 0 <= said.status <= 15
    assert 0 <= said.motor <= 15
    assert abs(said.q) <= 12.5 * (1 + 1e-12)
    assert abs(said.dq) <= 45 * (1 + 1e-12)
    assert abs(said.tau) <= 54 * (1 + 1e-12)
    assert -40 <= said.mosfet_degc < 216
    assert -40 <= said.rotor_degc < 216


def test_many_states_and_register_replies():
    rng = np.random.default_rng(0)
    good = reply_bytes(1, 1, LIMITS[0], 1.0, 2.0, 3.0)
    answer = codec.write_register(1, codec.PMAX, 12.5)
    sound = refused = 0
    for k in range(2 * MANY):
        data = mutated(rng, good) if k % 2 else rng.bytes(int(rng.integers(12)))
        try:
            need_sound(codec.state(SCALES, data))
            assert len(data) == 8
            sound += 1
        except WireError:
            assert len(data) != 8
            refused += 1
        data = mutated(rng, answer) if k % 2 else data
        try:
            value = codec.register_reply(data, 1, codec.WRITE, codec.PMAX)
            assert data[:4] == answer[:4]
            assert isinstance(value, float)
        except WireError:
            assert data[:4] != answer[:4] or len(data) != 8
    assert sound > 1000
    assert refused > 1000


@given(*[st.floats(allow_nan=True, allow_infinity=True)] * 5)
@settings(max_examples=300, deadline=None)
def test_commands(q, dq, kp, kd, tau):
    values = (q, dq, kp, kd, tau)
    if any(math.isnan(value) for value in values):
        with pytest.raises(WireError, match="not a number"):
            codec.mit_command(SCALES, *values)
        return
    data = codec.mit_command(SCALES, *values)
    assert len(data) == 8
    assert data[:7] != b"\xff" * 7


def test_datagrams_of_the_multicast_bus():
    rng = np.random.default_rng(1)
    message = message_for(BusSettings("x"), 0x11, reply_bytes(1, 1, LIMITS[0], 1.0, 2.0, 3.0))
    good = pack_message(message)
    assert unpack_datagram(good, 1.5) == (0x11, bytes(message.data), 1.5, 0)
    unreadable = 0
    for k in range(2 * MANY):
        data = mutated(rng, good) if k % 2 else rng.bytes(int(rng.integers(200)))
        can_id, payload, stamp_s, kind = unpack_datagram(data, 2.0)
        assert type(can_id) is int
        assert type(payload) is bytes
        assert stamp_s == 2.0
        assert kind in (0, 1, 2)
        unreadable += can_id == UNREADABLE
    assert MANY < unreadable < 2 * MANY


def test_error_frames():
    rng = np.random.default_rng(2)
    for _ in range(MANY):
        can_id = int(rng.integers(1 << 29))
        said = troubles_of(can_id, rng.bytes(int(rng.integers(10))), "can0")
        assert any("is bus-off" in trouble for trouble in said) == bool(can_id & 0x040)
        assert all(trouble.startswith("can0") for trouble in said)
        assert said


@given(st.lists(st.floats(allow_nan=False, min_value=-1e6, max_value=4e9), max_size=40))
@settings(max_examples=300, deadline=None)
def test_arrivals_lie_between_batches(stamps):
    clock, wall_ns = ArrivalClock(), 1_700_000_000_000_000_000
    for k in range(3):
        now = 10**12 + k * 1_000_000
        clock.begin(now - 10_000, now, wall_ns + now)
        for stamp_s in stamps:
            assert clock.first_ns <= clock.unusual(stamp_s) <= now


def test_a_driver_under_garbage():
    """Frames of any id, length and content among the good ones: an account, and never a crash."""
    rng = np.random.default_rng(3)
    bus = MotorBus(Bank(motion=lambda t: (0.3, 0.0, 1.0)))
    arm = DamiaoArm(
        "can://x?interface=virtual", bus=bus, now_ns=bus.clock.now_ns, wall_ns=bus.clock.wall_ns
    )
    arm.connect()
    good = [reply_bytes(j + 1, 0, LIMITS[j], 0.3, 0.0, 1.0) for j in range(7)]
    put = faults = 0
    for _ in range(MANY // 10):
        for _ in range(10):
            j = int(rng.integers(7))
            data = mutated(rng, good[j])[:64]
            can_id = 0x11 + j if rng.random() < 0.5 else int(rng.integers(0x800))
            flags = {"is_error_frame": rng.random() < 0.1, "is_remote_frame": rng.random() < 0.1}
            bus.put(can_id, data, **flags)
            put += 1
        try:
            sample = tick(arm, bus)
        except DriverError as error:
            faults += 1
            assert len(str(error)) > 30
            continue
        assert (np.abs(sample.q[np.isfinite(sample.q)]) < 100).all()
    intake = arm.intake
    assert put == MANY
    assert intake.received == intake.used + sum(intake.refused.values())
    assert len(intake.refused) >= 5
    assert len(intake.notes) < 60
    arm.close()
    bus.shutdown()
