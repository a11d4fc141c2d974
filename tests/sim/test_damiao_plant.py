"""Simulated joint boards against closed forms: motion, motor law, quantisation, wire times."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sim.engine import Engine
from sim.scenarios import build
from tests.helpers.board_tools import IDS, MS_NS, NOTHING, PANDA, frame, mit, parse, rig
from tests.helpers.can_line import frame_ns

READY = build("nominal").truth.ready
OPENARM = ((12.5, 45.0, 54.0),) * 2 + ((12.5, 10.0, 28.0),) * 2 + ((12.5, 30.0, 10.0),) * 3


def integrate(truth, law, times, q0=READY, dq0=None):
    """q, dq (m, n) under torques law(t, q, dq), by an integrator that is not ours."""
    engine = Engine(truth)

    def rate(t, y):
        q, dq = y[:7], y[7:]
        return np.concatenate((dq, engine.acceleration(q, dq, law(t, q, dq))))

    start = np.concatenate((q0, np.zeros(7) if dq0 is None else dq0))
    found = solve_ivp(rate, (times[0], times[-1]), start, t_eval=times, rtol=1e-9, atol=1e-10)
    engine.close()
    return found.y[:7].T, found.y[7:].T


@pytest.mark.parametrize(
    ("scenario", "most"),
    [("nominal", 1e-5), pytest.param("friction", 1e-4, marks=pytest.mark.slow)],
)
def test_a_limp_arm_falls_as_the_equations_of_motion_say(scenario, most) -> None:
    with rig(scenario, stand=False) as bench:
        world, start_ns = bench.boards.world, bench.line.start_ns
        bench.line.advance_to(start_ns)
        bench.boards.service()
        times, found = [0.0], [READY]
        for _ in range(150):  # before it touches an end stop
            bench.pass_ms()
            bench.boards.service()
            end_ns, q, dq = world.state()
            times.append((end_ns - start_ns) * 1e-9)
            found.append(q)
        truth = bench.scenario.truth
    times, found = np.array(times), np.array(found)
    expected, speeds = integrate(truth, lambda t, q, dq: np.zeros(7), times)
    assert np.abs(expected[-1] - READY).max() > 0.3  # it does fall
    assert np.abs(found - expected).max() < most
    assert np.abs(dq - speeds[-1]).max() < 1e-3


def moved_by(commands, ticks):
    """Angles, speeds (m, n) and torques once all commands are in force, what the equations of
    motion say of angles and speeds, and the law of torque."""
    with rig() as bench:
        bench.enable()
        world, rows = bench.boards.world, []
        for _ in range(ticks):
            bench.tick(commands)
            end_ns, q, dq = world.state()
            if not world.held:
                rows.append((end_ns * 1e-9, q, dq, [world.at(end_ns, j)[2] for j in range(7)]))
        sent = [m.command for m in bench.boards.motors]
        truth = bench.scenario.truth
    q_des, dq_des, kp, kd, ff = (np.array(column) for column in zip(*sent, strict=True))

    def law(t, q, dq):
        return kp * (q_des - q) + kd * (dq_des - dq) + ff

    # From the third tick on: before it not all commands were in force.
    times, *found = (np.array(column[3:]) for column in zip(*rows, strict=True))
    return found, integrate(truth, law, times - times[0], found[0][0], found[1][0]), law


def test_the_law_holds_and_swings_as_spring_and_damper_do() -> None:
    """A step of 0.1 rad in the wanted angles, with a speed wanted."""
    gains = zip([400.0] * 4 + [40.0] * 3, [5.0] * 4 + [0.5] * 3, READY + 0.1, PANDA, strict=True)
    commands = [mit(scale, q=q, dq=0.2, kp=kp, kd=kd) for kp, kd, q, scale in gains]
    (found, _, torques), (expected, speeds), law = moved_by(commands, 300)
    assert np.abs(found - expected).max() < 2e-4
    assert np.abs(expected - found[0]).max() > 0.1
    assert np.abs(torques - law(0.0, expected, speeds)).max() < 0.15  # of up to 40 N m


def test_full_damping_sinks_and_does_not_ring_on_the_lightest_joint() -> None:
    """kd = 5 N m s/rad on 0.005 kg m²: a law that lagged by a tick would blow up."""
    (found, speeds, _), (expected, fast), _ = moved_by([mit(x, kd=5.0) for x in PANDA], 100)
    assert np.abs(found - expected).max() < 2e-4
    assert np.abs(speeds - fast).max() < 5e-3
    assert np.abs(speeds).max() > 1.0


def test_torque_ends_at_the_motors_scale() -> None:
    """An OpenArm's 10 N m motor asked for 50 rad/s·5 + ... gives 10 N m and says so."""
    with rig(motors="openarm", scale=OPENARM, q0=READY) as bench:
        bench.enable()
        commands = bench.hold(READY)
        commands[6] = mit(OPENARM[6], q=12.5, kp=500.0)
        for _ in range(5):
            bench.tick(commands)
        state = bench.state(7)
        end_ns, *_ = bench.boards.world.state()
        told = bench.boards.world.at(end_ns, 6)[2]
    assert told == 10.0
    assert state.tau == pytest.approx(10.0, abs=20 / 4095)


def test_replies_are_the_true_state_within_one_code() -> None:
    """Every reply in a lively motion, against the world at the instant the command arrived."""
    rng = np.random.default_rng(3)
    seen = 0
    with rig() as bench:
        bench.enable()
        for k in range(120):
            q = READY + 0.1 * np.sin(0.05 * k + np.arange(7))
            commands = bench.hold(q, kp=200.0, kd=2.0, tau=rng.uniform(-1, 1, 7))
            truth = {}
            for motor, data in zip(IDS, commands, strict=True):
                begun = bench.line.now_ns()
                took = frame_ns(frame(motor, data))
                bench.send(motor, data)
                bench.line.advance_to(begun + took)  # the command is complete, measured now
                assert bench.line.now_ns() == begun + took
                truth[motor] = bench.boards.world.at(begun + took, motor - 1)
                bench.line.advance_to(begun + took + 70_000)
                (message,) = bench.messages()
                told, scale = parse(message, PANDA[motor - 1]), PANDA[motor - 1]
                steps = np.array(scale) * 2 / [65535, 4095, 4095]
                error = np.array(truth[motor]) - (told.q, told.dq, told.tau)
                assert (error >= -1e-9).all()  # truncated, never rounded up
                assert (error <= steps + 1e-9).all()
                seen += 1
            bench.line.advance_to(bench.line.next_whole_ns(MS_NS))
    assert seen == 840


def test_an_instant_inside_a_tick_lies_on_the_motion() -> None:
    with rig(stand=False) as bench:
        bench.boards.service()
        bench.pass_ms(100.0)
        bench.boards.service()
        world, truth = bench.boards.world, bench.scenario.truth
        end_ns, q1, dq1 = world.state()
        first_ns = end_ns - MS_NS
        q0 = np.array([world.at(first_ns, j)[0] for j in range(7)])
        dq0 = np.array([world.at(first_ns, j)[1] for j in range(7)])
        parts = np.linspace(0.0, 1.0, 11)
        inside = np.array(
            [[world.at(first_ns + round(x * MS_NS), j)[:2] for j in range(7)] for x in parts]
        )
    q, dq = integrate(truth, lambda t, q, dq: np.zeros(7), parts * 1e-3, q0, dq0)
    assert np.abs(dq0).max() > 0.5
    assert np.abs(inside[:, :, 0] - q).max() < 1e-7
    assert np.abs(inside[:, :, 1] - dq).max() < 1e-4
    np.testing.assert_allclose(inside[-1, :, 0], q1, atol=1e-12)
    np.testing.assert_allclose(inside[-1, :, 1], dq1, atol=1e-9)


def test_a_joint_stops_at_the_end_of_its_range() -> None:
    with rig(stand=False) as bench:
        bench.boards.service()
        for _ in range(20):
            bench.pass_ms(100.0)
            bench.boards.service()
        limits, (_, q, _) = bench.scenario.truth.limits, bench.boards.world.state()
        report = bench.boards.report()
    assert report["stop_ticks"] > 0
    assert (q > limits.lower - 0.2).all()
    assert (q < limits.upper + 0.2).all()


def test_rotor_warms_as_an_exponential_of_its_load() -> None:
    """Half the rated torque for a minute: 15 K (1 - exp(-60/300))."""
    with rig() as bench:
        bench.boards.motors[6].fail(0xE)  # a motor that drives nothing stays cool
        motor = bench.boards.motors[4]
        for _ in range(3000):
            motor.warm_up(4.0, 0.02)
        assert motor.rotor_c == pytest.approx(25 + 15 * (1 - np.exp(-0.2)), abs=0.02)
        for _ in range(100_000):
            motor.warm_up(12.5, 0.02)
        assert motor.status == 0xC  # 146 K of rise are too much


def test_replies_queue_behind_commands_up_to_the_end_of_the_cycle() -> None:
    with rig() as bench:
        bench.enable()
        bench.line.advance_to(bench.line.next_whole_ns(MS_NS))
        begun_s = bench.line.now_ns() * 1e-9
        messages = bench.tick([NOTHING] * 7)
    assert [m.arbitration_id for m in messages] == [0x10 + motor for motor in IDS]
    after_us = [(m.timestamp - begun_s) * 1e6 for m in messages]
    assert 678 <= after_us[-1] <= 781
    assert 350 <= after_us[0] <= 450  # seven commands and one reply
    assert np.diff(after_us) == pytest.approx([51] * 6, abs=3)


def test_lines_are_alike_bit_by_bit_when_run_twice_with_one_seed() -> None:
    def run(seed):
        faults = ["drop=0.1", "late=0.1", "corrupt=0.1", "repeat=0.1"]
        with rig("friction", faults=faults, seed=seed) as bench:
            bench.enable()
            rows = [bench.tick(bench.hold(READY)) for _ in range(100)]
        return [(m.arbitration_id, bytes(m.data), m.timestamp) for row in rows for m in row]

    first = run(5)
    assert len(first) > 500
    assert first == run(5)
    assert [x[0] for x in first] != [x[0] for x in run(6)]
