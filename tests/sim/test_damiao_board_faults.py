"""Faults of simulated boards strike as told, as often as told, and alike with the same seed."""

from __future__ import annotations

import errno

import can
import numpy as np
import pytest

from drivers.damiao.codec import CLEAR_ERROR, refresh
from sim.damiao.faults import NAMES, board_faults
from sim.damiao.server import Boards
from sim.scenarios import build
from tests.helpers.board_tools import (
    IDS,
    NOTHING,
    PANDA,
    STATUS_OF,
    Rig,
    frame,
    parse,
    rig,
    two_buses,
)

READY = build("nominal").truth.ready
TICKS = 400
SHARE = 0.1
EXPECTED = SHARE * 7 * TICKS  # 280, standard deviation 16


def run(bench: Rig, ticks: int = TICKS) -> list[list[can.Message]]:
    bench.enable()
    return [bench.tick(bench.hold(READY)) for _ in range(ticks)]


def struck(name: str) -> tuple[list[list[can.Message]], int]:
    """What came in each tick and behind the last one, and how often the fault struck."""
    with rig(faults=[f"{name}={SHARE}"]) as bench:
        rows = run(bench)
        bench.pass_ms(10.0)
        rows.append(bench.messages())
        count = bench.faults.counts[name]
    assert 200 < count < 360
    return rows, count


def test_every_fault_has_a_default_and_a_start() -> None:
    faults = board_faults([f"{name}@2.5" for name in NAMES])
    assert [fault.name for fault in faults.faults] == list(NAMES)
    assert all(fault.at_s == 2.5 for fault in faults.faults)


def test_dropped_replies_are_missing() -> None:
    rows, dropped = struck("drop")
    got = sum(map(len, rows))
    assert 0 <= got - (7 * TICKS - dropped) <= 7  # some of those that enabled may be among them


def test_unheard_commands_have_neither_reply_nor_effect() -> None:
    with rig(faults=["deaf=1.0@0.05"]) as bench:
        messages = run(bench, 100)
        bench.pass_ms(1.0)
        commands = bench.boards.frames["commands"]
    assert 40 * 7 <= commands <= 50 * 7
    assert sum(len(some) for some in messages[55:]) == 0


def test_late_replies_come_3_ms_after_the_others() -> None:
    rows, _ = struck("late")
    assert 0 <= sum(map(len, rows)) - 7 * TICKS <= 7
    assert any(len(row) > 7 for row in rows)
    assert any(len(row) < 7 for row in rows)


def test_corrupt_replies_have_one_bit_flipped_or_are_short() -> None:
    spoilt, count = struck("corrupt")
    with rig() as clean:
        good = run(clean)
    assert [len(row) for row in spoilt] == [7] * TICKS + [0]
    short = flipped = 0
    for row, healthy in zip(spoilt, good, strict=False):
        for message, wanted in zip(row, healthy, strict=True):
            if len(message.data) < 8:
                short += 1
                assert message.dlc == len(message.data)
                assert wanted.data.startswith(message.data)
            elif message.data != wanted.data:
                flipped += 1
                bits = int.from_bytes(message.data, "big") ^ int.from_bytes(wanted.data, "big")
                assert bits.bit_count() == 1
    assert count - 7 <= short + flipped <= count
    assert min(short, flipped) > 80


def test_a_silent_motor_says_nothing_from_its_time_on() -> None:
    with rig(faults=["silent=3@0.05"]) as bench:
        rows = run(bench, 100)
    heard = [[m.arbitration_id - 0x10 for m in row] for row in rows]
    assert heard[40] == list(IDS)
    assert heard[60] == [1, 2, 4, 5, 6, 7]


def test_a_stuck_encoder_stands_still_while_the_arm_moves() -> None:
    with rig(faults=["stuck=4@0.02"]) as bench:
        bench.enable()
        told = [parse(bench.tick([NOTHING] * 7)[3], PANDA[3]) for _ in range(100)]
        moved = abs(bench.boards.world.state()[1][3] - READY[3])
    assert moved > 0.05
    late = told[30:]
    assert {one.q for one in late} == {late[0].q}
    assert all(abs(one.dq) < 0.02 for one in late)
    assert all(one.status == 1 for one in late)


def test_an_encoder_jumps_by_a_tenth_and_stays_there() -> None:
    with rig(faults=["jump=2@0.1"]) as bench:
        rows = run(bench, 200)
        true = bench.boards.world.state()[1][1]
    told = [parse(row[1], PANDA[1]).q for row in rows]
    step = np.abs(np.diff(told))
    assert step.max() == pytest.approx(0.1, abs=5e-3)
    assert (step > 0.05).sum() == 1
    assert told[-1] - true == pytest.approx(0.1, abs=5e-3)


def test_spikes_last_one_reply() -> None:
    with rig(faults=["spike=0.01"]) as bench:
        rows = run(bench)
        struck = bench.faults.counts["spike"]
    told = np.array([[parse(m, PANDA[j]).q for j, m in enumerate(row)] for row in rows])
    off = np.abs(told - READY) > 0.3
    assert 10 < struck < 60
    assert struck - 2 <= off.sum() <= struck


@pytest.mark.parametrize("name", list(STATUS_OF))
def test_electrical_faults_show_in_the_status_and_stay(name) -> None:
    with rig(faults=[f"{name}=6@0.03"]) as bench:
        rows = run(bench, 60)
        told = [parse(row[5], PANDA[5]) for row in rows]
        assert told[20].status == 1
        assert told[-1].status == STATUS_OF[name]
        assert abs(told[-1].tau) < 0.02
        others = [m.data[0] >> 4 for m in rows[-1] if m.arbitration_id != 0x16]
        assert others == [1] * 6
        assert (
            parse(bench.ask(6, CLEAR_ERROR)[0], PANDA[5]).status == STATUS_OF[name]
        )  # the cause stays


def test_a_hot_motor_lets_go_and_reports_its_temperature() -> None:
    with rig(faults=["overtemp=2@0.03"]) as bench:
        rows = run(bench, 80)
        told = parse(rows[-1][1], PANDA[1])
        far = abs(bench.boards.world.state()[1][1] - READY[1])
    assert told.status == 0xC
    assert told.rotor_degc > 100
    assert far > 0.001


def test_bus_off_is_announced_and_ends() -> None:
    with rig(faults=["bus_off=0.1@0.05"]) as bench:
        rows = run(bench, 250)
        unheard = bench.boards.frames["while bus off"]
    errors = [m for row in rows for m in row if m.is_error_frame]
    assert [m.arbitration_id for m in errors] == [0x40]
    assert 600 <= unheard <= 800
    assert all(not row for row in rows[60:140])
    assert [m.arbitration_id - 0x10 for m in rows[-1]] == list(IDS)


def test_error_frames_come_besides_the_replies() -> None:
    rows, count = struck("error_frames")
    errors = sum(m.is_error_frame for row in rows for m in row)
    assert count - 7 <= errors <= count
    assert sum(map(len, rows)) - errors == 7 * TICKS


def test_a_host_without_buffers_cannot_send_on_a_line() -> None:
    failed = 0
    with rig(faults=[f"enobufs={SHARE}"]) as bench:
        for k in range(7 * TICKS):
            try:
                bench.send(1 + k % 7, NOTHING)
            except can.CanOperationError as error:
                assert error.error_code == errno.ENOBUFS
                failed += 1
            bench.pass_ms(0.2)
        assert bench.boards.frames["commands"] == 7 * TICKS - failed
    assert 200 < failed < 360


def test_bytes_that_are_no_frame_are_counted_and_passed_over() -> None:
    class Noisy:
        """A bus that fails to receive a few times; its frames are real."""

        def __init__(self, bus) -> None:
            self.bus, self.left = bus, 3

        def recv(self, timeout):
            if self.left:
                self.left -= 1
                raise can.CanOperationError("could not unpack received message")
            return self.bus.recv(timeout)

        def send(self, message):
            self.bus.send(message)

    with two_buses("noisy") as (near, far):
        boards = Boards(Noisy(far), build("nominal"))
        near.send(frame(0x7FF, refresh(1)))
        assert boards.service() == 1
        assert boards.frames["unreadable"] == 3
        assert near.recv(0.0) is not None
        boards.close()
