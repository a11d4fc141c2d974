"""However a run ends, the arm is brought to rest and the files are closed."""

from __future__ import annotations

import fcntl
import os
import pty
import signal
import subprocess
import sys
import termios
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapter.realtime.jobs import Jobs
from adapter.realtime.loop import run_live
from adapter.realtime.session import run_lockstep
from adapter.realtime.supervisor import RECORDER_NICE
from drivers.files.mcap import read_log
from drivers.interface import DriverError
from tests.helpers import live_tools as tools
from tests.helpers.stalls import Stalls

pytestmark = pytest.mark.usefixtures("no_leftovers")
alone = pytest.mark.alone  # what kills processes of a live run, in real time

SCRIPT = """
import os, sys

if __name__ == "__main__":  # the workers load this file as well, and need none of it
    from dataclasses import replace
    from pathlib import Path
    from tests.helpers import live_tools as tools
    from adapter.realtime.jobs import Jobs
    from adapter.realtime.loop import run_live

    class Telling(tools.SimulatedArm):
        def read(self):
            sample = super().read()
            if sample.stamp_ns % 20_000_000 == 0:
                os.write(1, b"STAMP %d\\n" % sample.stamp_ns)
            return sample

    front_end, controller = tools.parts()
    arm = Telling(tools.build("nominal", 5).plant())
    result = run_live(
        arm, front_end, controller=controller,
        jobs=Jobs(learner=tools.lasting_job(), recording=tools.recording_job(Path(sys.argv[1]))),
        options=replace(tools.live_options(None), deadman="deadman" in sys.argv),
        say=lambda line: os.write(2, line.encode() + b"\\n"),
    )
    os.write(1, b"RESULT %s %d %d %d %d\\n" % (
        result.ended.encode(), result.samples, result.recorded, result.passed_on,
        result.collected[0]))
"""
ROOT = str(Path(__file__).parents[2])
RUNNING = 60_000  # bytes of a recording that is well under way


@pytest.fixture
def start(tmp_path):
    """Starts a live run; standard input as given. Output goes to the file `out`."""
    script, path = tmp_path / "live.py", tmp_path / "a.mcap"
    script.write_text(SCRIPT)
    environment = {**os.environ, "PYTHONPATH": ROOT}
    started: list[subprocess.Popen] = []
    blocks: list[str] = []

    def go(*arguments: str, size: int = RUNNING, **how):
        with (tmp_path / "out").open("wb") as out, (tmp_path / "err").open("wb") as err:
            command = [sys.executable, str(script), str(path), *arguments]
            before = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the suite may run under nohup
            try:
                process = subprocess.Popen(command, stdout=out, stderr=err, env=environment, **how)
            finally:
                signal.signal(signal.SIGHUP, before)
        started.append(process)
        assert tools.wait_for(lambda: path.exists() and path.stat().st_size > size, 120.0)
        blocks.extend(tools.mapped_blocks(process.pid))
        assert blocks
        return process

    yield go, path, tmp_path / "out", tmp_path / "err"
    for process in started:
        if process.poll() is None:
            process.kill()
        process.wait()
    assert tools.wait_for(lambda: not tools.left_behind(blocks))


def _check_ended_well(process, path: Path, out: Path, err: Path, why: str) -> None:
    assert process.wait(60) == 0, err.read_text()
    ended, *counts = out.read_text().splitlines()[-1].split()[1:]
    samples, recorded, passed_on, learned = map(int, counts)
    assert (ended, recorded, learned) == (why, samples, passed_on)
    log = read_log(path)
    assert len(log) == samples and not log.truncated
    assert abs(log.dq[-1]).max() < 0.1
    assert "Traceback" not in err.read_text() and "leaked" not in err.read_text()


@alone
def test_ctrl_c_to_all_of_it_is_a_safe_stop(start):
    go, *files = start
    process = go(start_new_session=True)
    os.killpg(process.pid, signal.SIGINT)
    _check_ended_well(process, *files, "interrupted")


@alone
@pytest.mark.parametrize("controlling", [False, True])
def test_closing_the_terminal_is_a_safe_stop(start, controlling):
    """With a controlling terminal the system sends SIGHUP; without, the loop has to look."""
    go, *files = start
    master, terminal = pty.openpty()

    def own_it() -> None:
        os.setsid()
        if controlling:
            fcntl.ioctl(0, termios.TIOCSCTTY, 0)

    process = go("deadman", stdin=terminal, preexec_fn=own_it)
    os.close(terminal)
    assert process.poll() is None
    os.close(master)
    process.wait(60)
    why = "interrupted" if b"RESULT interrupted" in files[1].read_bytes() else "operator_gone"
    assert controlling or why == "operator_gone"
    _check_ended_well(process, *files, why)


@alone
def test_without_the_deadman_a_run_outlives_its_terminal(start):
    go, path, out, err = start
    master, terminal = pty.openpty()
    process = go(stdin=terminal, start_new_session=True)
    os.close(terminal)
    os.close(master)
    size = path.stat().st_size
    assert tools.wait_for(lambda: path.stat().st_size > size + RUNNING, 60.0)
    os.killpg(process.pid, signal.SIGTERM)
    _check_ended_well(process, path, out, err, "interrupted")


@alone
def test_the_end_of_the_program_that_started_it_is_a_safe_stop(start, tmp_path):
    """A shell between us and the run is killed; the run has no terminal at all."""
    _, path, out, err = start
    run = [sys.executable, str(tmp_path / "live.py"), str(path), "deadman"]
    shell = subprocess.Popen(
        ["sh", "-c", f'"$@" >{out} 2>{err} & echo $! >{tmp_path}/number; wait', "sh", *run],
        env={**os.environ, "PYTHONPATH": ROOT},
        stdin=subprocess.DEVNULL,
    )
    try:
        assert tools.wait_for(lambda: path.exists() and path.stat().st_size > RUNNING, 120.0)
        blocks = tools.mapped_blocks(int((tmp_path / "number").read_text()))
        shell.kill()
        shell.wait()
        assert tools.wait_for(lambda: b"RESULT" in out.read_bytes(), 60.0)
    finally:
        if b"RESULT" not in out.read_bytes():
            os.kill(int((tmp_path / "number").read_text()), signal.SIGKILL)
    assert b"RESULT operator_gone" in out.read_bytes()
    assert blocks and tools.wait_for(lambda: not tools.left_behind(blocks))
    log = read_log(path)
    assert not log.truncated and abs(log.dq[-1]).max() < 0.1


def _family(pid: int) -> list[int]:
    """A process and its workers, without multiprocessing's own housekeeping."""
    found = [pid]
    for task in Path(f"/proc/{pid}/task").iterdir():
        for child in (task / "children").read_text().split():
            if b"resource_tracker" not in Path(f"/proc/{child}/cmdline").read_bytes():
                found.append(int(child))
    return found


@alone
@pytest.mark.parametrize(
    "size", [140_000, *(pytest.param(size, marks=pytest.mark.slow) for size in (60_000, 310_000))]
)
def test_kill_9_of_all_processes_loses_nothing_older_than_a_second(start, size):
    go, path, out, _ = start
    with Stalls(nice=RECORDER_NICE) as stalls:
        process = go(size=size)
        time.sleep(0.1 * np.random.default_rng(size).random())  # any moment will do
    last_ns = int(out.read_bytes().split(b"STAMP ")[-1].split()[0])
    family = _family(process.pid)
    assert len(family) == 3
    for pid in family:
        os.kill(pid, signal.SIGKILL)
    process.wait()
    stamps = read_log(path).stamp_ns
    assert stamps[-1] >= last_ns - 1_000_000_000 - 1e9 * stalls.total_s
    assert (np.diff(stamps) == 1_000_000).all()
    for folder in path.parent.glob("adapter-learner-*"):  # nobody is left to remove it
        for file in sorted(folder.rglob("*"), reverse=True):
            file.rmdir() if file.is_dir() else file.unlink()
        folder.rmdir()


class Bug(Exception):
    """What nobody expected."""


class Broken(tools.Swinging):
    """An arm whose driver has a bug somewhere."""

    def __init__(self, where: str) -> None:
        super().__init__()
        self._where = where

    def read(self):
        self._fail("read")
        return super().read()

    def command(self, tau) -> None:
        self._fail("command")
        super().command(tau)

    def stop(self) -> None:
        super().stop()
        if self._where == "stop":
            raise OSError("the cable came off")

    def _fail(self, where: str) -> None:
        if self._where == where and self.reads == 700:
            raise Bug(where)


def _failing_at(part, name: str, count: int):
    """The same object, whose method raises when it is called for the count-th time."""
    method, calls = getattr(part, name), [0]

    def fail_then(*arguments):
        calls[0] += 1
        if calls[0] == count:
            raise Bug(name)
        return method(*arguments)

    setattr(part, name, fail_then)
    return part


@pytest.mark.parametrize("where", ["read", "command", "filter", "control"])
def test_a_bug_in_a_tick_stops_the_arm_and_closes_the_recording(tmp_path, where):
    arm, path = Broken(where), tmp_path / "a.mcap"
    front_end, controller = tools.swinging_parts()
    if where == "control":
        controller = _failing_at(controller, "step", 700)
    if where == "filter":
        step = front_end.step

        def fail_then(sample):
            if arm.reads == 700 and sample.stamp_ns == 700_000_000:
                raise Bug(where)
            return step(sample)

        front_end.step = fail_then
    recorded = where in ("read", "control")  # of both sorts one, which takes a process each
    with pytest.raises(Bug):
        run_live(
            arm,
            front_end,
            controller=controller,
            jobs=Jobs(recording=tools.recording_job(path) if recorded else None),
            options=tools.live_options(30.0),
        )
    assert arm.stops == 1 and arm.closes == 1
    if recorded:
        log = read_log(path)
        assert not log.truncated and 690 <= len(log) <= 700


def test_a_driver_that_cannot_stop_is_told_and_all_is_kept(tmp_path):
    path = tmp_path / "a.mcap"
    recording = tools.recording_job(path)
    result = tools.live(Broken("stop"), tools.live_options(0.5), recording=recording)
    assert (result.ended, result.fault) == ("driver_error", "the cable came off")
    assert result.recorded == result.samples == len(read_log(path))


def test_what_is_raised_before_the_motion_leaves_the_arm_alone():
    arm, (front_end, controller) = tools.Swinging(), tools.parts()
    seen = []

    def refuse(stopped) -> None:
        seen.append(controller.reference.q.copy())
        raise DriverError("the operator said no")

    with pytest.raises(DriverError, match="said no"):
        run_live(
            arm,
            front_end,
            controller=controller,
            options=replace(tools.live_options(1.0), before_motion=refuse),
        )
    assert len(seen) == 1 and arm.commands == 0 and arm.stops == 1


def test_an_arm_that_nobody_commands_any_more_is_braked_and_not_dropped():
    arm = tools.simulated_arm()
    front_end, controller = tools.parts()
    controller = _failing_at(controller, "step", 1700)
    plant = arm._plant
    arm.stop = lambda: None  # the loop's process was killed: nobody calls it
    with pytest.raises(Bug):
        run_lockstep(arm, front_end, None, controller, 30.0)
    fast = np.abs(plant.link_state()[1]).max()
    assert fast > 0.3 and not plant.braked
    before = plant.link_state()[0].copy()
    for k in range(400):
        arm.read()
        assert plant.braked == (k + 2 > 20)  # one sample was read in the tick that failed
    q, dq, _ = plant.link_state()
    assert plant.fault is None and np.abs(dq).max() < 0.01
    assert np.abs(q - before).max() < 0.2
    arm.close()


class Stamped(tools.Swinging):
    """An arm whose clock is set in mid-run."""

    def __init__(self, leap_ns: int) -> None:
        super().__init__()
        self._leap_ns = leap_ns

    def read(self):
        sample = super().read()
        leap_ns = self._leap_ns if self.reads > 300 else 0
        return replace(sample, stamp_ns=sample.stamp_ns + leap_ns)


@pytest.mark.parametrize("hours", [3, -3])
def test_a_clock_that_is_set_does_not_end_a_run_early_nor_late(hours):
    result = run_lockstep(
        Stamped(hours * 3600 * 10**9), tools.parts()[0], None, None, duration_s=1.0
    )
    assert result.ended == "duration" and 1000 <= result.samples <= 1010
