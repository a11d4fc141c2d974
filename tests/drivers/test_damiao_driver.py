"""The CAN arm's driver against small motors, in made-up time and on real python-can buses."""

import itertools
import math
import re
import time
from contextlib import ExitStack

import numpy as np
import pytest

from drivers.damiao.arm import DamiaoArm, SpeedCheck
from drivers.damiao.timing import NOTHING, ArrivalClock, at_instant
from drivers.interface import Driver, DriverError
from tests.helpers.damiao_tools import LIMITS, Bank, MotorBus, reply_bytes, tick, ticks

N = 7
PHASE = np.arange(N)
LOAD = np.full(N, 2.0)  # what carries the motors' load, N m
STEPS = np.array(
    [[2 * most / top for most, top in zip(row, (65535, 4095, 4095), strict=True)] for row in LIMITS]
)


def motion(t_s):
    return 0.5 * np.sin(2 * t_s + PHASE), np.cos(2 * t_s + PHASE), 2 * np.sin(3 * t_s + PHASE)


def arm_on(bus, address="can://bench?interface=virtual", **options):
    arm = DamiaoArm(address, bus=bus, now_ns=bus.clock.now_ns, wall_ns=bus.clock.wall_ns, **options)
    arm.connect()
    return arm


@pytest.fixture
def opened(monkeypatch):
    """Makes a driver on a bus whose made-up time passes for whoever sleeps; closes both."""
    with ExitStack() as stack:

        def made(bus, **options):
            def sleep(seconds):
                bus.clock.ns += int(1e9 * seconds)

            monkeypatch.setattr(time, "sleep", sleep)
            monkeypatch.setattr(time, "monotonic", lambda: 1e-9 * bus.clock.ns)
            stack.callback(bus.shutdown)
            arm = arm_on(bus, **options)
            stack.callback(arm.close)
            return arm, bus

        yield made


@pytest.fixture
def moving(opened):
    """A listening driver and motors that move as `motion` says."""
    return opened(MotorBus(Bank(motion=motion)))


@pytest.fixture
def driven(opened):
    """A driver that may move its motors."""
    return opened(MotorBus(Bank()), allow_motion=True)


def test_a_listener_is_a_driver_and_changes_nothing(moving):
    arm: Driver = moving[0]
    bus = moving[1]
    assert arm.joint_names == tuple(f"joint{j}" for j in range(1, 8))
    assert not (arm.paced or arm.can_move or arm.adds_gravity)
    assert arm.period_ns == 10**6
    ticks(50, arm, bus)
    assert {can_id for can_id, _ in bus.sent} == {0x7FF}
    assert {data[2] for _, data in bus.sent} == {0x33, 0xCC}
    assert bus.bank.status == [0] * N
    assert arm.intake.commands is None
    with pytest.raises(DriverError, match="allow motion"):
        arm.command(np.zeros(N))
    with pytest.raises(DriverError, match="connected already"):
        arm.connect()


def test_samples_are_of_one_instant(moving):
    """Replies come 0.6 ms apart; the sample is what all joints did at its stamp."""
    arm, bus = moving
    ticks(5, arm, bus)
    errors, stamps = [], []
    for _ in range(1000):
        sample = tick(arm, bus)
        q, dq, tau = motion(1e-9 * sample.stamp_ns)
        errors.append([sample.q - q, sample.dq - dq, sample.tau - tau])
        stamps.append(sample.stamp_ns)
        assert arm.arrived_ns <= bus.clock.ns
    errors = np.array(errors)
    assert (np.diff(stamps) > 0).all()
    assert (np.abs(errors).max(axis=0).T <= 1.01 * STEPS).all()  # truncation, nothing else
    assert (np.abs(errors.mean(axis=0).T) <= 0.53 * STEPS).all()
    # The last tick is on its way, two rounds came before.
    assert arm.intake.received == arm.intake.used == N * 1006
    assert not arm.intake.refused
    assert not arm.intake.notes


def test_alignment_at_its_edges():
    now, ms = 100_000_000, 1_000_000
    old, new = (now - ms, 1.0, 2.0, 3.0), (now, 1.002, 2.0, 4.0)

    def one(stamp, before=old, after=new):
        values, missing = at_instant(stamp, [before], [after], 5 * ms)
        return values, bool(missing)

    assert one(now) == ([1.002, 2.0, 4.0], False)
    assert one(now - ms // 2)[0] == pytest.approx([1.001, 2.0, 3.5])
    values, missing = one(now + 2 * ms)
    assert missing
    assert values[:2] == pytest.approx([1.006, 2.0])
    assert math.isnan(values[2])
    assert np.isnan(one(now + 6 * ms)[0]).all()
    assert one(now - ms // 2, NOTHING)[0] == pytest.approx([1.001, 2.0, 4.0])
    assert one(now - ms // 2, (now - 10**9, 0.0, 9.0, 9.0))[0] == pytest.approx([1.001, 2.0, 4.0])
    assert np.isnan(one(now, NOTHING, NOTHING)[0]).all()


def test_a_missing_reply_is_predicted_and_counted_as_lost(moving):
    arm, bus = moving
    ticks(20, arm, bus)
    dropped = iter(range(10**6))
    bus.keep = lambda can_id, data: can_id != 0x13 or next(dropped) % 10 != 0
    nans = 0
    for _ in range(600):
        sample = tick(arm, bus)
        q, _, _ = motion(1e-9 * sample.stamp_ns)
        assert np.isfinite(sample.q).all()
        assert (np.abs(sample.q - q) < 0.002).all()
        others = np.delete(sample.tau, 2)
        assert np.isfinite(others).all()
        nans += int(np.isnan(sample.tau[2]))
    assert nans == 60
    assert 30 <= arm.intake.lost <= 60  # counted once they are missing for 0.1 s
    arm.close()
    assert arm.intake.lost == 60
    assert arm.intake.received == arm.intake.used


def test_a_longer_hole_is_nan_and_then_an_error_that_names_the_motor(moving):
    arm, bus = moving
    ticks(20, arm, bus)
    bus.bank.silent.add(2)
    seen = []
    with pytest.raises(DriverError, match=r"motor 3 \(id 0x03\) silent for 0.1 s"):
        for _ in range(200):
            seen.append(tick(arm, bus))
    assert 95 <= len(seen) <= 110
    finite = [bool(np.isfinite(sample.q[2])) for sample in seen]
    assert finite[5]
    assert not any(finite[8:])
    assert all(np.isfinite(sample.q[[0, 1, 3, 4, 5, 6]]).all() for sample in seen)


def test_commands_are_accounted_for_by_their_replies(driven):
    """Each seventh reply that is missing is a seventh of a command; windows are of 100."""
    arm, bus = driven
    ticks(200, arm, bus, LOAD)
    count = arm.intake.commands
    assert (count.sent, count.cut, count.holes) == (200, 0, 0)
    assert (count.success_min, count.success_mean) == (1.0, 1.0)
    every_other = itertools.count()
    bus.keep = lambda can_id, data: can_id != 0x13 or next(every_other) % 2 == 0
    ticks(100, arm, bus, LOAD)
    bus.keep = lambda can_id, data: True
    ticks(100, arm, bus, LOAD)
    assert count.success_min == pytest.approx(1 - 50 / (100 * N))
    assert count.success_mean == pytest.approx(1 - 50 / (399 * N))  # the last one's is to come
    assert count.holes == 0  # the motors had them all
    tick(arm, bus, LOAD, period_ns=6_000_000)
    tick(arm, bus, np.full(N, 1e3))
    assert (count.sent, count.cut, count.holes) == (402, 1, 1)
    assert count.longest_hole_ms == pytest.approx(6.0, abs=0.2)
    bus.refusing = 1  # the bus takes six of seven: no command, and a hole of two periods
    tick(arm, bus, LOAD)
    tick(arm, bus, LOAD)
    assert (count.sent, count.holes) == (403, 2)
    told = arm.intake.as_dict()["commands"]
    assert told["success_min"] == count.success_min and told["sent"] == 403
    assert "at worst 93 %" in count.line()


def test_late_replies_cost_one_sample_and_are_not_lost(moving):
    arm, bus = moving
    ticks(20, arm, bus)
    bus.spread_ns = 200_000  # motors 5 to 7 answer after the tick
    holes = sum(np.isnan(tick(arm, bus).tau).any() for _ in range(50))
    bus.spread_ns = 100_000
    sample = ticks(300, arm, bus)
    assert holes == 1  # from then on the last tick's late reply comes after the stamp
    assert np.isfinite(sample.tau).all()
    arm.close()
    assert arm.intake.lost <= N  # of the last tick
    assert arm.intake.used == arm.intake.received


def test_what_is_no_reply_is_refused_by_reason(moving):
    arm, bus = moving
    tick(arm, bus)
    good = reply_bytes(3, 0, LIMITS[2], 0.1, 0.2, 0.3)
    bus.put(0x123, good)
    bus.put(0x13, good[:5])
    bus.put(0x13, reply_bytes(4, 0, LIMITS[2], 0.1, 0.2, 0.3))
    bus.put(0x03, good)
    bus.put(0x13, good, is_extended_id=True)
    bus.put(0x13, good, is_remote_frame=True)
    bus.put(0x004, bytes([0, 0x10, 0, 0, 0, 0, 130, 1]), is_error_frame=True)
    bus.clock.ns += 500_000
    tick(arm, bus)
    for _ in range(3):
        bus.put(0x13, good)  # one more than asked for, each tick
        tick(arm, bus)
    intake = arm.intake
    assert intake.refused == {
        "unknown_id": 3,
        "wrong_length": 1,
        "wrong_motor": 1,
        "other_host": 1,
        "error_frame": 1,
        "unasked": 3,
    }
    assert intake.received == intake.used + sum(intake.refused.values())
    notes = " ".join(intake.notes)
    told = "no motor's", "5 bytes", "same reply id", "another program", "made the controller"
    assert all(part in notes for part in told)
    assert len(intake.notes) == len(set(intake.notes)) <= 8


def test_bus_off_says_how_to_restart(moving):
    arm, bus = moving
    bus.put(0x040, bytes(8), is_error_frame=True)
    with pytest.raises(DriverError, match=r"bus-off.*ip link set bench down"):
        tick(arm, bus)


@pytest.mark.parametrize(
    ("status", "said"),
    [
        (0x8, "over-voltage"),
        (0x9, "under-voltage"),
        (0xA, "over-current"),
        (0xB, "MOSFET over-temperature"),
        (0xC, "rotor over-temperature"),
        (0xD, "communication lost"),
        (0xE, "overload"),
        (0x3, "undocumented status"),
    ],
)
def test_a_fault_ends_the_run_with_advice(driven, status, said):
    arm, bus = driven
    ticks(3, arm, bus, LOAD)
    bus.bank.status[4] = status
    with pytest.raises(DriverError, match=rf"motor 5 \(id 0x05\) reports {said} \(status "):
        ticks(6, arm, bus, LOAD)
    with pytest.raises(DriverError, match=said):
        arm_on(bus)


def test_a_single_alarm_is_refused_and_not_believed(driven):
    arm, bus = driven
    for k in range(60):
        bus.bank.status[4] = 0xE if k % 10 == 0 else 1
        bus.bank.temperatures[2] = (200, 30) if k % 10 == 5 else (40, 40)
        tick(arm, bus, LOAD)
    intake = arm.intake
    assert 3 <= intake.refused["unconfirmed_alarm"] <= 7
    assert intake.received == intake.used + sum(intake.refused.values())


def test_a_motor_that_lost_its_power_is_said(driven):
    arm, bus = driven
    tick(arm, bus, LOAD)
    bus.bank.status[1] = 0
    with pytest.raises(DriverError, match=r"motor 2 .* is disabled"):
        ticks(6, arm, bus, LOAD)


def test_temperatures_warn_and_then_stop(driven):
    arm, bus = driven
    bus.bank.temperatures[0] = (250, 251)  # below zero
    ticks(3, arm, bus, LOAD)
    assert not any("deg C" in note for note in arm.intake.notes)
    bus.bank.temperatures[3] = (50, 85)
    ticks(5, arm, bus, LOAD)
    assert sum("motor 4" in note and "85 deg C" in note for note in arm.intake.notes) == 1
    bus.bank.temperatures[3] = (50, 101)
    with pytest.raises(DriverError, match=r"motor 4.*101 deg C"):
        ticks(6, arm, bus, LOAD)


def test_connecting_enables_and_holds_and_saves_nothing(driven):
    arm, bus = driven
    assert bus.bank.status == [1] * N
    assert sorted(set(bus.bank.writes)) == [(j, 10) for j in range(N)]
    assert all(bus.bank.registers[j][10] == 1 for j in range(N))
    assert not any(data[2] == 0xAA for can_id, data in bus.sent if can_id == 0x7FF)
    assert not any(data[7] == 0xFE and data[:7] == b"\xff" * 7 for _, data in bus.sent)
    sample = tick(arm, bus)
    np.testing.assert_allclose(sample.tau, 2.0, atol=0.1)  # what carries the load is known
    np.testing.assert_allclose(bus.bank.q, np.linspace(-0.6, 0.6, N), atol=0.02)  # it came back
    q0 = bus.bank.q.copy()
    sample = ticks(1500, arm, bus)
    np.testing.assert_allclose(sample.tau, 2.0, atol=0.1)
    np.testing.assert_allclose(bus.bank.q, q0, atol=0.01)


def test_commands_are_torques_clamped_to_tmax(driven):
    arm, bus = driven
    wanted = np.array([1.0, -2.0, 3.0, 99.0, -99.0, 0.0, 0.5])
    tick(arm, bus, wanted)
    got = bus.bank.command
    limits = np.array(LIMITS)[:, 2]
    assert (got[:, 2:4] == 0).all()
    assert (np.abs(got[:, 4] - np.clip(wanted, -limits, limits)) <= STEPS[:, 2]).all()
    assert any("TMAX" in note for note in arm.intake.notes)


@pytest.mark.parametrize("wrong", [np.full(N, np.nan), [0, 0, 0, np.inf, 0, 0, 0], [0.0] * 6, 1.0])
def test_a_wrong_command_sends_nothing(driven, wrong):
    arm, bus = driven
    tick(arm, bus, LOAD)
    sent = len(bus.sent)
    with pytest.raises(DriverError):
        arm.command(wrong)
    assert len(bus.sent) == sent


def test_a_full_queue_is_borne_for_some_ticks(driven):
    arm, bus = driven
    ticks(5, arm, bus, LOAD)
    bus.refusing = 3 * N
    ticks(10, arm, bus, LOAD)
    assert sum("Transmit buffer full" in note for note in arm.intake.notes) == 1
    bus.refusing = 10**6
    with pytest.raises(DriverError, match=r"nothing could be sent for 20 ticks.*txqueuelen"):
        ticks(40, arm, bus, LOAD)
    bus.refusing = 0


def test_a_driven_arm_is_braked_and_held(driven):
    arm, bus = driven
    sample = tick(arm, bus)
    for _ in range(800):
        tau = np.where(sample.dq < 0.6, 2.4, 1.9) if np.isfinite(sample.dq).all() else 2.0
        sample = tick(arm, bus, np.broadcast_to(tau, N))
    assert bus.bank.dq.min() > 0.3
    q0 = bus.bank.q.copy()
    arm.stop()
    travelled = bus.bank.q - q0
    assert (travelled < 0.3).all()
    assert np.abs(bus.bank.dq).max() < 0.02
    q1 = bus.bank.q.copy()
    bus.bank.advance(bus.clock.ns + 3_000_000_000)
    assert np.abs(bus.bank.q - q1).max() < 0.02  # held by what they were told last
    assert bus.bank.status == [1] * N
    sent = len(bus.sent)
    arm.stop()
    assert len(bus.sent) == sent
    assert any("braked" in note for note in arm.intake.notes)


def test_a_jump_of_the_wall_clock_disturbs_nothing(moving):
    arm, bus = moving
    ticks(10, arm, bus)
    for jump_ns in (3_600_000_000_000, -7_200_000_000_000, 3_000_000, -2_000_000):
        bus.clock.wall_offset_ns += jump_ns  # between the replies' stamps and the batch
        for _ in range(20):
            sample = tick(arm, bus)
            q, dq, tau = motion(1e-9 * sample.stamp_ns)
            assert (
                np.abs(np.array([sample.q - q, sample.dq - dq, sample.tau - tau]).T) <= 1.3 * STEPS
            ).all()
    assert not arm.intake.refused


def test_an_interface_with_a_clock_of_its_own():
    clock = ArrivalClock()
    own_s, errors = 12.5, []
    for k in range(2000):
        now = 10**9 + 1_000_000 * k
        clock.begin(now, now + 20_000, now + 1_700_000_000_000_000_000)
        for j in range(N):
            true = now - 900_000 + 100_000 * j  # the last one waits for 300 us
            at = clock.unusual(own_s + 1e-9 * (true - 10**9) * (1 + 20e-6))
            errors.append(at - true)
    late = np.array(errors[1000:])
    assert clock.own_clock
    assert np.ptp(late) < 30_000  # the spread between joints is kept; a common delay is not known


@pytest.mark.parametrize("seed", range(8))
def test_a_healthy_speed_is_never_called_wrong(seed):
    """Quantised, truncated, noisy; slow and fast; at rest; with stiction and jerks."""
    assert speed_of(seed, factor=1.0) is None


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_a_wrong_vmax_is_found_within_five_seconds(seed, factor):
    found = speed_of(seed, factor, fast=True)
    assert found is not None
    seconds, error = found
    assert seconds <= 5.0
    said = re.search(r"its speed is ([\d.]+) times .* VMAX", error)
    assert float(said[1]) == pytest.approx(factor, rel=0.03)


def speed_of(seed, factor, fast=False, duration_s=5.0):
    """(when, what) the check said of synthetic motion, or None."""
    rng = np.random.default_rng(seed)
    limits = np.array(LIMITS)
    check = SpeedCheck(tuple(f"joint{j + 1}" for j in range(N)), limits[:, 1])
    rate = rng.uniform(1.0, 8.0, (4, N))
    size = rng.uniform(0.3 if fast else 0.0, 0.6 if fast else 0.3, (4, N)) / 4
    phase = rng.uniform(0, 6, (4, N))
    resting = rng.random(N) < 0.3
    for k in range(int(1000 * duration_s)):
        t = 1e-3 * k
        q = (size * np.sin(rate * t + phase)).sum(axis=0)
        dq = (size * rate * np.cos(rate * t + phase)).sum(axis=0)
        if not fast:
            q, dq = np.where(resting, 0.2, q), np.where(resting, 0.0, dq)
        dq = factor * dq + rng.normal(0, 0.01, N)
        q_code = np.floor((q + limits[:, 0]) / STEPS[:, 0])
        dq_code = np.floor((dq + limits[:, 1]) / STEPS[:, 1])
        try:
            check.add(
                1_000_000 * k,
                q_code * STEPS[:, 0] - limits[:, 0],
                dq_code * STEPS[:, 1] - limits[:, 1],
            )
        except DriverError as error:
            return t, str(error)
    return None


def test_a_wrong_vmax_ends_the_run(opened):
    """The motor's register says 8, it scales with 10, as a DM4340 by another source's table."""
    limits = list(LIMITS)
    limits[2] = (12.5, 8.0, 28.0)
    arm, bus = opened(MotorBus(Bank(motion=motion, limits=limits, encode=LIMITS)))
    assert any("as no known type does" in note for note in arm.intake.notes)
    with pytest.raises(DriverError, match=r"joint3: its speed is 0.80 times.*about (10|9.99)\)"):
        ticks(5000, arm, bus)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda b: b.silent.update({2, 5}), r"motors 3 \(id 0x03\), 6 \(id 0x06\) do not"),
        (lambda b: b.silent.update(range(7)), "no motor"),
        (lambda b: b.registers[3].update({21: 0.0}), r"motor 4.*registers 21 to 23"),
        (lambda b: b.registers[3].update({22: math.nan}), r"motor 4.*registers 21 to 23"),
        (lambda b: b.registers[3].update({23: 1e9}), r"motor 4.*registers 21 to 23"),
    ],
    ids=["two silent", "all silent", "PMAX", "VMAX", "TMAX"],
)
def test_silent_motors_and_wrong_registers_are_named_at_connect(spoil, said):
    bus = MotorBus(Bank())
    spoil(bus.bank)
    with pytest.raises(DriverError, match=said):
        arm_on(bus)
    bus.shutdown()


def test_a_lost_frame_at_connect_is_asked_for_again(opened):
    bus, count = MotorBus(Bank()), itertools.count()
    bus.keep = lambda can_id, data: next(count) % 5 != 0
    arm, _ = opened(bus, allow_motion=True)
    assert [(x.q_max, x.dq_max, x.tau_max) for x in arm.limits] == LIMITS
    assert bus.bank.status == [1] * N


def test_a_time_out_of_a_former_run_is_cleared(opened):
    bus = MotorBus(Bank())
    bus.bank.status = [0xD] * N
    opened(bus, allow_motion=True)
    assert bus.bank.status == [1] * N


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("nobody?interface=nosuch", "no CAN interface 'nosuch'; python-can has: .*socketcan"),
        ("nobody?interface=virtual", "no motor answers"),
        ("can77", r"no CAN; use|no such device; plug|not permitted"),
    ],
)
def test_what_cannot_be_opened_is_explained(address, said):
    with pytest.raises(DriverError, match=said):
        DamiaoArm(f"can://{address}").connect()


def test_too_many_frames_are_refused_at_once():
    with pytest.raises(DriverError, match=r"at most 500 Hz \(\?rate=500\), or CAN FD"):
        DamiaoArm("can://can0?fd=0")
    assert DamiaoArm("can://can0?fd=0&rate=500").period_ns == 2_000_000
