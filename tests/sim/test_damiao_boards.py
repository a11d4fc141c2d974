"""Simulated Damiao boards keep to the protocol: bytes, registers, states, processes."""

from __future__ import annotations

import argparse
import json
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from dataclasses import replace

import can
import numpy as np
import pytest

from drivers.damiao.codec import (
    CLEAR_ERROR,
    DISABLE,
    ENABLE,
    read_register,
    refresh,
    write_register,
)
from sim.damiao import codec as wire
from sim.damiao.bus import open_bus
from sim.damiao.faults import add_arguments, check
from sim.damiao.host import ServedBus
from sim.damiao.motor import SETS
from sim.damiao.server import BoardOptions, Boards, run
from sim.effects import Effect
from sim.noise import levels_of
from sim.scenarios import build
from tests.helpers.board_tools import (
    IDS,
    MS_NS,
    NOTHING,
    PANDA,
    ZERO,
    frame,
    free_port,
    mit,
    parse,
    rig,
    two_buses,
)
from tests.helpers.hardware_rigs import SERVE

READY = build("nominal").truth.ready
GROUP = "239.74.163.2"
IPV6_GROUP = "ff15:7079:7468:6f6e:6465:6d6f:6d63:6173"


# Bytes of the reference page, section 2, 3 and 5.


def test_command_fields_lie_where_the_reference_page_says() -> None:
    scale = wire.FullScale(12.5, 30.0, 10.0)
    low, high = bytes(8), bytes([0xFF] * 8)
    assert wire.decode_command(low, scale) == (-12.5, -30.0, 0.0, 0.0, -10.0)
    assert wire.decode_command(high, scale) == (12.5, 30.0, 500.0, 5.0, 10.0)
    only_kp = wire.decode_command(bytes.fromhex("000000000100 0000"), scale)
    assert only_kp.kp == pytest.approx(500 / 4095)
    assert only_kp.kd == 0.0
    only_kd = wire.decode_command(bytes.fromhex("0000000000 001000"), scale)
    assert only_kd.kd == pytest.approx(5 / 4095)
    assert only_kd.kp == 0.0


def test_feedback_bytes_by_hand() -> None:
    scale = wire.FullScale(12.5, 30.0, 10.0)
    at_zero = wire.encode_feedback(3, 1, (0.0, 0.0, 0.0), (40, 33), scale)
    assert at_zero == bytes.fromhex("13 7FFF 7F F7FF 28 21")
    ends = wire.encode_feedback(0x13, 0xD, (99.0, -99.0, 99.0), (300, -5), scale)
    assert ends == bytes.fromhex("D3 FFFF 00 0FFF FF 00")
    quarter = wire.encode_feedback(1, 0, (-6.25, 15.0, -5.0), (0, 0), scale)
    assert quarter == bytes.fromhex("01 3FFF BF F3FF 00 00")


# Dialogue.


def test_motors_answer_under_their_own_ids_and_say_who_they_are() -> None:
    with rig() as bench:
        for motor in IDS:
            (message,) = bench.ask(0x7FF, refresh(motor))
            assert message.arbitration_id == 0x10 + motor
            assert not message.is_extended_id
            assert message.is_fd
            assert message.bitrate_switch
            told = parse(message, PANDA[motor - 1])
            assert (told.motor, told.status) == (motor, 0)
            assert told.q == pytest.approx(READY[motor - 1], abs=4e-4)
            assert (told.mosfet_degc, told.rotor_degc) == (25, 25)


@pytest.mark.parametrize("fd", [True, False])
def test_a_reply_has_the_format_of_its_request(fd) -> None:
    with rig(fd=fd) as bench:
        (message,) = bench.ask(0x7FF, refresh(2))
        assert message.is_fd is fd
        assert message.bitrate_switch is fd
        if not fd:
            with pytest.raises(can.CanOperationError, match="classic line"):
                bench.line.host.send(frame(2, NOTHING, fd=True))


def test_enable_disable_and_errors_that_have_to_be_cleared() -> None:
    with rig() as bench:
        status = lambda data: parse(bench.ask(4, data)[0], PANDA[3]).status  # noqa: E731
        assert status(NOTHING) == 0
        assert status(ENABLE) == 1
        assert status(NOTHING) == 1
        assert status(DISABLE) == 0
        bench.boards.motors[3].fail(0xA)
        assert status(ENABLE) == 0xA
        assert status(DISABLE) == 0xA
        assert status(CLEAR_ERROR) == 0
        assert status(ENABLE) == 1


def test_scales_are_read_written_and_used_both_ways() -> None:
    with rig() as bench:
        for register, value in zip((21, 22, 23), PANDA[4], strict=True):
            (message,) = bench.ask(0x7FF, read_register(5, register))
            assert message.arbitration_id == 0x15
            assert bytes(message.data[:4]) == bytes([5, 0, 0x33, register])
            assert struct.unpack("<f", message.data[4:])[0] == value
        for register, value in ((21, 4.0), (22, 8.0), (23, 10.0)):
            (echo,) = bench.ask(0x7FF, write_register(5, register, value))
            assert bytes(echo.data[:4]) == bytes([5, 0, 0x55, register])
            assert struct.unpack("<f", echo.data[4:])[0] == value
        new = (4.0, 8.0, 10.0)
        (message,) = bench.ask(0x7FF, refresh(5))
        assert parse(message, new).q == pytest.approx(READY[4], abs=8 / 65535)
        bench.ask(5, ENABLE)
        bench.ask(5, mit(new, tau=5.0))
        assert bench.boards.motors[4].command.tau_ff == pytest.approx(5.0, abs=20 / 4095)


def test_registers_that_cannot_be_written_stay_and_unknown_ones_are_silent() -> None:
    with rig() as bench:
        (before,) = bench.ask(0x7FF, read_register(1, 14))
        (echo,) = bench.ask(0x7FF, write_register(1, 14, 7))
        assert echo.data[4:] == before.data[4:]
        (echo,) = bench.ask(0x7FF, write_register(1, 21, -3.0))
        assert struct.unpack("<f", echo.data[4:])[0] == 12.5
        (echo,) = bench.ask(0x7FF, write_register(1, 10, 9))
        assert struct.unpack("<I", echo.data[4:])[0] == 1
        assert bench.ask(0x7FF, read_register(1, 99)) == []
        (position,) = bench.ask(0x7FF, read_register(2, 81))
        assert struct.unpack("<f", position.data[4:])[0] == pytest.approx(READY[1], abs=1e-6)
        (saved,) = bench.ask(0x7FF, bytes([1, 0, 0xAA, 0, 0, 0, 0, 0]))
        assert saved.arbitration_id == 0x11


def test_ids_can_be_changed_and_act_at_once() -> None:
    with rig() as bench:
        bench.ask(0x7FF, write_register(7, 7, 0x27))
        bench.ask(0x7FF, write_register(7, 8, 0x0F))
        assert bench.ask(0x7FF, refresh(7)) == []
        (message,) = bench.ask(0x7FF, refresh(0x0F))
        assert message.arbitration_id == 0x27
        assert message.data[0] == 0x0F


def test_zero_moves_angles_and_wanted_angles_alike() -> None:
    with rig() as bench:
        told = parse(bench.ask(4, ZERO)[0], PANDA[3])
        assert told.q == pytest.approx(0.0, abs=4e-4)
        zeros = READY.copy()
        zeros[3] = 0.0
        bench.enable()
        for _ in range(100):
            bench.tick(bench.hold(zeros))
        assert bench.boards.world.state()[1] == pytest.approx(READY, abs=0.08)


def test_what_is_not_for_motors_is_passed_over() -> None:
    with rig() as bench:
        for message in (
            frame(0x23, NOTHING),
            frame(0x11, NOTHING),  # a reply, handed back by the bus
            frame(3, NOTHING[:5]),
            frame(0x103, NOTHING),
            can.Message(arbitration_id=3, data=NOTHING, is_extended_id=True),
            can.Message(arbitration_id=3, is_extended_id=False, is_remote_frame=True),
            can.Message(arbitration_id=3, data=NOTHING, is_extended_id=False, is_error_frame=True),
            frame(0x7FF, bytes([3, 0, 0x77, 0, 0, 0, 0, 0])),
        ):
            bench.line.host.send(message)
        bench.pass_ms(2.0)
        assert bench.messages() == []
        assert sum(bench.boards.frames.values()) == 8


# Arm.


def test_the_stand_goes_when_all_motors_are_enabled_and_commanded() -> None:
    with rig() as bench:
        bench.enable()
        for motor in IDS[:-1]:
            bench.ask(motor, NOTHING)
        bench.pass_ms(50.0)
        assert (bench.boards.world.state()[1] == READY).all()
        bench.ask(7, NOTHING)
        bench.pass_ms(50.0)
        bench.state(1)
        assert not bench.boards.world.held
        assert np.abs(bench.boards.world.state()[1] - READY).max() > 0.01


def test_a_disabled_motor_answers_and_is_limp() -> None:
    with rig() as bench:
        bench.enable()
        for _ in range(20):
            bench.tick(bench.hold(READY))
        for motor in IDS:
            bench.ask(motor, DISABLE)
        for _ in range(100):
            messages = bench.tick(bench.hold(READY))
        told = [parse(message, PANDA[j]) for j, message in enumerate(messages)]
        assert [one.status for one in told] == [0] * 7
        assert all(abs(one.tau) < 0.03 for one in told)
        assert np.abs(bench.boards.world.state()[1] - READY).max() > 0.05
        assert bench.boards.report()["limp_ticks"] >= 100


@pytest.mark.parametrize("timeout_ms", [0, 20])
def test_without_watchdog_the_last_command_stays_with_it_the_arm_drops(timeout_ms) -> None:
    with rig() as bench:
        for motor in IDS:
            bench.ask(0x7FF, write_register(motor, 9, timeout_ms * 20))
        bench.enable()
        for _ in range(50):
            bench.tick(bench.hold(READY))
        for _ in range(300):  # the host is gone
            bench.pass_ms(1.0)
            bench.boards.service()
        far = np.abs(bench.boards.world.state()[1] - READY).max()
        states = [bench.state(motor).status for motor in IDS]
    if timeout_ms:
        assert states == [0xD] * 7
        assert far > 0.3
    else:
        assert states == [1] * 7
        assert far < 0.1


def test_the_watchdog_is_fed_by_every_frame_and_counts_50_us() -> None:
    with rig() as bench:
        bench.ask(0x7FF, write_register(1, 9, 100))  # 5 ms
        bench.ask(1, ENABLE)
        for _ in range(10):
            bench.pass_ms(4.0)
            assert bench.state(1).status == 1
        bench.pass_ms(5.1)
        assert bench.state(1).status == 0xD


def test_payload_comes_with_the_time_since_the_first_frame() -> None:
    scenario = build("payload_at_20s", t_s=0.1, mass=2.0)
    with rig(scenario) as bench:
        bench.pass_ms(500.0)
        bench.boards.service()
        bench.enable()
        torques = []
        for _ in range(600):
            bench.tick(bench.hold(READY, kp=500.0))
            end_ns, *_ = bench.boards.world.state()
            torques.append(bench.boards.world.at(end_ns, 3)[2])
    assert np.ptp(torques[80:95]) < 5.0
    assert np.mean(torques[-50:]) - np.mean(torques[60:95]) > 3.0


def test_a_backlog_is_caught_up_to_a_limit_and_the_rest_slips() -> None:
    clock = [0]
    bus = can.Bus(interface="virtual", channel="slip")
    boards = Boards(bus, build("nominal"), BoardOptions(stand=False), now_ns=lambda: clock[0])
    try:
        boards.service()
        for later_ms, ticks, slipped_ms in ((50, 51, 0), (1050, 151, 900), (1051, 152, 900)):
            clock[0] = later_ms * MS_NS
            boards.service()
            assert boards.world.ticks == ticks
            assert boards.world.slipped_ns == slipped_ms * MS_NS
            end_ns, *_ = boards.world.state()
            assert end_ns == clock[0] + MS_NS
    finally:
        boards.close()
        bus.shutdown()


def test_sensor_noise_comes_on_top_of_the_quantisation_where_asked_for() -> None:
    def told(noise):
        with rig(noise=noise) as bench:
            bench.enable()
            rows = []
            for _ in range(200):
                rows.append(parse(bench.tick([NOTHING] * 7)[0], PANDA[0]).dq)
            truth = bench.boards.world.state()[2][0]
        return np.std(np.diff(rows)), truth

    quiet, loud = told(None), told(levels_of("real", dq_above_50hz=0.05))
    assert quiet[1] == loud[1]  # the arm itself moves alike
    assert loud[0] > 3 * quiet[0]


def test_sets_of_motors_cover_the_arm_and_unknown_ones_are_named() -> None:
    effort = build("nominal").truth.limits.effort
    for name in ("panda", "panda_fitted"):
        for (kind, scale), needed in zip(SETS[name], effort, strict=True):
            assert needed <= scale.tmax <= kind.scale.tmax
    assert [scale.tmax for _, scale in SETS["openarm"]] == [54, 54, 28, 28, 10, 10, 10]
    with (
        can.Bus(interface="virtual", channel="names") as bus,
        pytest.raises(ValueError, match="have: panda, panda_fitted, openarm"),
    ):
        Boards(bus, build("nominal"), BoardOptions("ur5"))


def test_effects_in_sensors_are_refused_those_on_the_arm_are_not() -> None:
    def arm(effect):
        nominal = build("nominal")
        return replace(nominal, truth=nominal.truth.with_changes(effects=(effect,)))

    with can.Bus(interface="virtual", channel="effects") as bus:
        with pytest.raises(ValueError, match="in sensors, this arm has: torque_gain"):
            Boards(bus, arm(Effect("torque_gain", (2,), {"g": 0.1})))
        Boards(bus, arm(Effect("joint_spring", (2,), {"k": 1.0, "q0": 0.0}))).close()


# Buses.


def test_in_one_process_on_the_virtual_bus() -> None:
    with two_buses("in process") as (_, far):
        boards = Boards(far, build("nominal"))
        host = ServedBus("in process", boards)
        host.send(frame(0x7FF, refresh(6)))
        message = host.recv(0.0)
        assert message is not None
        assert parse(message, PANDA[5]).q == pytest.approx(READY[5], abs=4e-4)
        host.serving = False
        host.send(frame(0x7FF, refresh(6)))
        assert host.recv(0.0) is None
        assert boards.service() == 1
        assert host.recv(0.0) is not None
        assert boards.compute_ns > 0
        boards.close()
        host.shutdown()


def receive(bus: can.BusABC, identifier: int, patience_s: float = 20.0) -> can.Message | None:
    end = time.monotonic() + patience_s
    while (left_s := end - time.monotonic()) > 0:
        try:
            message = bus.recv(left_s)
        except can.CanOperationError:  # python-can's bus stumbles over what is no frame
            continue
        if message is not None and message.arbitration_id == identifier:
            return message
    return None


@contextmanager
def serving(boards: Boards):
    """Boards served in a thread, which ends when it is told to."""
    stop = threading.Event()
    thread = threading.Thread(target=boards.serve, args=(stop.is_set,))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(20.0)
    assert not thread.is_alive()


def multicast_or_skip(channel: str, port: int) -> can.BusABC:
    try:
        return can.Bus(interface="udp_multicast", channel=channel, port=port, hop_limit=0)
    except can.CanError as error:
        pytest.skip(f"no multicast group {channel} on this machine: {error.__cause__}")


@pytest.mark.parametrize("channel", [GROUP, IPV6_GROUP])
def test_boards_on_multicast_do_not_hear_themselves_and_pass_over_noise(channel) -> None:
    port = free_port()
    family = socket.AF_INET6 if ":" in channel else socket.AF_INET
    with multicast_or_skip(channel, port) as host, open_bus("udp_multicast", channel, port) as far:
        boards = Boards(far, build("nominal"))
        with socket.socket(family, socket.SOCK_DGRAM) as noise:
            if family == socket.AF_INET:
                noise.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            for junk in (b"", b"\xc1", b"no frame at all", bytes(2000)):
                noise.sendto(junk, (channel, port))
        for motor in (*IDS, *IDS):
            host.send(frame(0x7FF, refresh(motor)))
        with serving(boards):
            for motor in (*IDS, *IDS):
                assert receive(host, 0x10 + motor) is not None
        boards.close()
    assert boards.frames == {"unreadable": 4, "refresh": 14}


def command(*options: str) -> int:
    """The command in this process."""
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    args = parser.parse_args(options)
    check(args)
    return run(args)


def test_across_processes_until_sigterm(tmp_path) -> None:
    port, figures = free_port(), tmp_path / "figures.json"
    with multicast_or_skip(GROUP, port) as bus:
        server = subprocess.Popen(
            [sys.executable, *SERVE, "can", "--port", str(port), "--json", str(figures)],
            stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            ready = server.stdout.readline()
            assert f"can://{GROUP}:{port}?interface=udp_multicast" in ready
            for motor in IDS:
                bus.send(frame(motor, ENABLE))
                message = receive(bus, 0x10 + motor)
                assert message is not None
                assert parse(message, PANDA[motor - 1]).status == 1
            for _ in range(50):
                for motor in IDS:
                    bus.send(frame(motor, mit(PANDA[motor - 1], READY[motor - 1], kp=300, kd=5)))
                for motor in IDS:
                    assert receive(bus, 0x10 + motor) is not None
            with pytest.raises(ValueError, match="another arm answers as motor 1"):
                command("--port", str(port))
            server.send_signal(signal.SIGTERM)
            rest, _ = server.communicate(timeout=60)
        finally:
            server.kill()
            server.wait()
    assert server.returncode == 0
    assert "frames: " in rest
    told = json.loads(figures.read_text())
    assert told["frames"]["commands"] == 350
    assert told["frames"]["enable"] == 7
    assert not told["in_stand"]


def test_it_ends_by_itself_after_its_duration(capsys) -> None:
    port = free_port()
    multicast_or_skip(GROUP, port).shutdown()
    options = ["--scenario", "payload_at_20s", "--set", "mass=2", "--set", "noise=real"]
    assert command("--port", str(port), "--duration", "0.3", *options) == 0
    said = capsys.readouterr().out
    assert "ready: " in said and "simulated " in said


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--channel", "10.0.0.1"], "no multicast address; try 239.74.163.2"),
        (["--set", "mass"], "--set takes KEY=VALUE"),
        (["--scenario", "moon"], "no scenario 'moon'; have: nominal"),
        (["--fault", "fire"], "no fault 'fire'; have: drop"),
        (["--fault", "enobufs=0.1"], "host's own controller"),
        (["--interface", "socketcan", "--channel", "nobus9"], "CAN"),
    ],
)
def test_wrong_options_are_refused_in_a_sentence(options, says) -> None:
    with pytest.raises(ValueError, match=says) as refused:
        command("--port", str(free_port()), *options)
    assert "\n" not in str(refused.value)


@pytest.mark.skipif(shutil.which("unshare") is None, reason="needs unshare for a bare network")
def test_a_machine_without_route_is_told_which_one_it_needs() -> None:
    bare = ["unshare", "--net", sys.executable, *SERVE, "can"]
    if subprocess.run(["unshare", "--net", "true"], capture_output=True).returncode:
        pytest.skip("this user may not open a network namespace")
    done = subprocess.run(bare, capture_output=True, text=True, timeout=60)
    assert done.returncode != 0
    assert "no route to the multicast group" in done.stderr
    assert "ip route add 239.74.163.2 dev lo" in done.stderr
