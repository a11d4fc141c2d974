"""The live process: nothing gets lost, whatever fails."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from adapter.realtime.loop import LiveOptions
from adapter.realtime.session import Session, run_lockstep
from adapter.realtime.showing import DisplayJob
from adapter.realtime.worker import WorkerError
from drivers.files.mcap import read_estimates, read_log
from drivers.interface import DriverError
from drivers.process import sleep_until
from tests.helpers import live_tools as tools

pytestmark = [pytest.mark.alone, pytest.mark.usefixtures("no_leftovers")]

SCRIPT = """
if __name__ == "__main__":  # the workers load this file as well, and need none of it
    import sys
    from pathlib import Path
    from tests.helpers import live_tools as tools

    jobs = dict(learner=tools.learner_job(), recording=tools.recording_job(Path(sys.argv[1])))
    tools.live(tools.simulated_arm(), tools.live_options(None), moving=True, **jobs)
"""


def _wait_for_display(diary: Path, stopped=None) -> None:
    """Nobody else does, and it yields to whatever runs."""
    assert tools.wait_for(lambda: diary.exists() and diary.stat().st_size > 0, 120.0)


def _diary(path: Path) -> list[list[str]]:
    """What a display saw: samples, waiting, learned, done; all but the last of a run under way."""
    lines = [line.split() for line in path.read_text().splitlines()]
    assert [line[3] for line in lines[:-1]] == ["False"] * (len(lines) - 1)
    assert lines[-1][1:] == ["0", lines[-1][2], "True"]
    return lines


def test_every_state_arrives_in_order_and_as_in_one_thread(tmp_path, monkeypatch):
    monkeypatch.setenv("TEST_CHECKPOINT", str(tmp_path / "checkpoint"))
    monkeypatch.setenv("TEST_DIARY", str(tmp_path / "diary"))
    path, diary = tmp_path / "a.mcap", tmp_path / "diary"
    result = tools.live(
        tools.simulated_arm(),
        replace(tools.live_options(2.0), before_motion=partial(_wait_for_display, diary)),
        moving=True,
        learner=tools.learner_job(save=tools.save_count),
        recording=tools.recording_job(path),
        display=DisplayJob(tools.Diary, period_s=0.05),
    )
    print("\n".join(result.timing.lines()))
    assert (result.ended, result.fault, result.troubles) == ("duration", None, [])
    assert result.samples == result.recorded >= 3000
    assert (result.unlearned, result.unrecorded) == (0, 0)
    assert [line.partition(":")[0] for line in result.grants] == [
        "collector",
        "memory",
        "core",
        "priority",
    ]

    again, learner = tools.simulated_arm(), tools.Digest()
    front_end, controller = tools.parts()
    lockstep = run_lockstep(again, front_end, learner, controller, 2.0)
    assert result.collected == learner.summary()
    assert result.collected[:2] == (result.passed_on, True)
    assert (lockstep.samples, lockstep.ended) == (result.samples, "duration")
    assert lockstep.tracking == result.tracking

    log = read_log(path)
    assert len(log) == result.samples and not log.truncated and log.metadata["note"] == "test"
    assert log.commands is not None and len(log.commands.stamp_ns) == result.samples
    estimates = list(read_estimates(path))
    assert len(estimates) > 10 and estimates[-1]["learned"] == result.passed_on
    assert (tmp_path / "checkpoint").read_text() == str(result.passed_on)
    seen = _diary(diary)
    assert len(seen) > 1 and int(seen[-1][0]) == result.passed_on


@pytest.mark.parametrize("fault", [{"fail_read": 700}, {"fail_command": 700}])
def test_a_driver_that_fails_is_stopped_and_all_is_kept(tmp_path, fault):
    arm, path = tools.Swinging(**fault), tmp_path / "a.mcap"
    jobs = {"learner": tools.learner_job(), "recording": tools.recording_job(path)}
    result = tools.live(arm, tools.live_options(30.0), moving=True, **jobs)
    assert result.ended == "driver_error"
    assert result.fault in ("the cable came off", "the arm refused")
    assert arm.stops == 1 and arm.closes == 1
    assert result.samples == result.recorded == len(read_log(path)) == arm.reads
    assert result.collected[:2] == (result.passed_on, True) and result.passed_on > 300


def test_passive_only_listens_and_needs_no_workers():
    arm = tools.Swinging()
    result = tools.live(arm, tools.live_options(0.3))
    assert (result.ended, arm.commands, result.tracking) == ("duration", 0, None)
    assert result.samples == 301 and result.recorded is None and result.collected is None


class Paced(tools.Swinging):
    """An arm that sets the rhythm itself; a sample is a millisecond old when it is given out."""

    paced = True

    def read(self):
        sample = super().read()
        self.arrived_ns = time.monotonic_ns()
        sleep_until(self.arrived_ns + 1_000_000)
        self.intake.received += 1
        self.intake.used += 1
        return sample


def test_every_sample_is_accounted_for_and_its_age_is_told():
    arm = Paced()
    result = tools.live(arm, tools.live_options(0.5))
    assert result.samples + result.set_aside == result.intake.received == arm.reads
    assert result.intake == arm.intake and result.intake is not arm.intake
    assert result.timing.age_us["p50"] >= 1000.0
    assert any("age of a sample" in line for line in result.timing.lines())
    unpaced = tools.live(tools.Swinging(), tools.live_options(0.2))
    assert unpaced.timing.age_us["p50"] is None and unpaced.set_aside == 0


class Waking(tools.Swinging):
    """An arm whose torques are there 20 ms after it was first read, and which never waits."""

    def read(self):
        sample = super().read()
        self.arrived_ns = time.monotonic_ns()
        self._first_ns = min(getattr(self, "_first_ns", self.arrived_ns), self.arrived_ns)
        if self.arrived_ns - self._first_ns < 20_000_000:
            return replace(sample, tau=np.full(7, np.nan))
        return sample


def test_a_motion_starts_with_the_first_whole_sample():
    """As of a CAN arm, whose next replies need a tick: reading faster finds nothing new."""
    arm = Waking()
    front_end, controller = tools.parts()
    arm.connect()
    session = Session(arm, front_end, controller, lambda record: None, lambda *kept: None, 1.0)
    sample = session.get_ready(controller.prepare)
    assert np.isfinite(sample.tau).all()
    assert 0 < session.set_aside < 30


@pytest.mark.parametrize(("kind", "said"), [(tools.Dying, "exit code 3"), (tools.Failing, "a bug")])
def test_a_learner_that_dies_stops_neither_arm_nor_display(tmp_path, monkeypatch, kind, said):
    monkeypatch.setenv("TEST_DIARY", str(tmp_path / "diary"))
    lines: list[str] = []
    path, diary = tmp_path / "a.mcap", tmp_path / "diary"
    result = tools.live(
        tools.Swinging(),
        replace(tools.live_options(1.0), before_motion=partial(_wait_for_display, diary)),
        moving=True,
        say=lines.append,
        learner=tools.learner_job(kind),
        recording=tools.recording_job(path) if kind is tools.Dying else None,
        display=DisplayJob(tools.Diary, period_s=0.05),
    )
    assert result.ended == "duration" and result.samples > 1000
    assert result.collected is None and result.passed_on + result.unlearned > 500
    assert len(result.troubles) == 1 and said in result.troubles[0]
    assert "the arm goes on" in result.troubles[0] and result.troubles[0] in lines
    assert len(_diary(diary)) > 1
    assert kind is not tools.Dying or len(read_log(path)) == result.samples


def test_what_cannot_start_says_so_and_leaves_nothing(tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(b"precious")
    arm = tools.Swinging()
    with pytest.raises(DriverError, match="exists"):
        tools.live(arm, LiveOptions(), recording=tools.recording_job(path))
    assert path.read_bytes() == b"precious"
    job = tools.learner_job(tools.no_learner)
    with pytest.raises(WorkerError, match="no such model"):
        tools.live(arm, tools.live_options(1.0), learner=job)
    arm.can_move = False
    with pytest.raises(DriverError, match="passive"):
        tools.live(arm, LiveOptions(), moving=True)


@pytest.fixture
def running(tmp_path):
    script, path = tmp_path / "live.py", tmp_path / "a.mcap"
    script.write_text(SCRIPT)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    process = subprocess.Popen(
        [sys.executable, str(script), str(path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        start_new_session=True,
    )
    assert tools.wait_for(lambda: path.exists() and path.stat().st_size > 60_000, 120.0)
    blocks = tools.mapped_blocks(process.pid)
    assert blocks
    yield process, path
    if process.poll() is None:
        process.kill()
    process.communicate()
    assert tools.wait_for(lambda: not tools.left_behind(blocks))


def test_after_kill_9_the_workers_close_the_recording_and_go(running):
    process, path = running
    process.kill()
    process.wait()
    assert tools.wait_for(lambda: not _truncated(path))
    assert len(read_log(path)) > 100  # what 60 kB held at the least


def _truncated(path: Path) -> bool:
    try:
        return read_log(path).truncated
    except DriverError:
        return True
