"""Arms, jobs and waiting for tests of the live process."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from adapter.control.controller import ControlSettings, ExcitationController
from adapter.control.limits import MotionLimits
from adapter.control.settings import ExcitationSettings
from adapter.model.robots import documented
from adapter.realtime.jobs import Jobs, RecordingJob
from adapter.realtime.loop import LiveOptions, LiveResult, run_live
from adapter.realtime.shared import SharedBlock
from adapter.realtime.supervisor import SharedMemoryOptions
from adapter.signals.front_end import FrontEnd
from drivers.interface import DriverError, Intake, JointSample
from sim.plant import SimulatedArm
from sim.scenarios import build
from tests.helpers.live_learners import (  # noqa: F401  # these are the tests' as well
    Diary,
    Digest,
    Dying,
    Failing,
    Lines,
    Mortal,
    Witness,
    die_once,
    lasting_job,
    learner_job,
    no_learner,
    no_view,
    save_count,
)

PANDA = documented("panda")


def simulated_arm(seed: int = 5) -> SimulatedArm:
    return SimulatedArm(build("nominal", seed).plant())


def parts(seed: int = 5):
    """Front end and controller of a Panda."""
    motion = ExcitationSettings(seed=seed)
    return FrontEnd(PANDA), ExcitationController(MotionLimits.of(PANDA), motion)


def swinging_parts():
    """The same of an arm that swings by itself: held softly near where it is, it is no trouble."""
    motion = ExcitationSettings(seed=5, range_share=0.05)
    soft = ControlSettings(stiffness=[20.0] * 7)
    return FrontEnd(PANDA), ExcitationController(MotionLimits.of(PANDA), motion, soft)


def live_options(duration_s: float | None, ring_s: float = 5.0) -> LiveOptions:
    return LiveOptions(
        duration_s, shared_memory=SharedMemoryOptions(ring_s=ring_s, snapshot_name=None)
    )


class Swinging:
    """An arm that swings by itself and fails, where asked, at a sample or a command."""

    paced, can_move, adds_gravity, arrived_ns = False, True, False, 0
    delay_ns = 1_000_000
    joint_names = tuple(f"panda_joint{j}" for j in range(1, 8))
    link_names: tuple[str, ...] = ()
    period_ns = 1_000_000

    def __init__(self, fail_read: int | None = None, fail_command: int | None = None) -> None:
        self._fail_read, self._fail_command = fail_read, fail_command
        self.reads = self.commands = self.stops = self.closes = 0
        self.intake = Intake()
        self._q0 = build("nominal").truth.ready

    def connect(self) -> None:
        self.reads = 0

    def read(self) -> JointSample:
        if self.reads == self._fail_read:
            raise DriverError("the cable came off")
        t = 1e-3 * self.reads
        self.reads += 1
        swing = 0.1 * np.sin(3.0 * t), np.full(7, 0.3 * np.cos(3.0 * t))
        return JointSample(self.reads * self.period_ns, self._q0 + swing[0], swing[1], swing[1])

    def command(self, tau) -> None:
        if self.commands == self._fail_command:
            raise DriverError("the arm refused")
        self.commands += 1

    def stop(self) -> None:
        self.stops += 1

    def close(self) -> None:
        self.closes += 1


def live(arm, options: LiveOptions, moving: bool = False, say=print, **jobs) -> LiveResult:
    """A live run with new parts, in motion where asked for; workers by their name in `Jobs`."""
    front_end, controller = swinging_parts() if isinstance(arm, Swinging) else parts()
    return run_live(arm, front_end, controller if moving else None, Jobs(**jobs), options, say)


def mapped_blocks(pid: int) -> list[str]:
    """Names of the blocks of shared memory that a process uses now."""
    lines = Path(f"/proc/{pid}/maps").read_text(errors="replace").splitlines()
    return sorted({line.partition("/dev/shm/")[2] for line in lines if "/dev/shm/" in line})


def created_blocks(monkeypatch) -> list[str]:
    """Names of the blocks that this process creates from here on, as they come."""
    names: list[str] = []
    create = SharedBlock.create

    def noted(size: int, name: str | None = None) -> SharedBlock:
        block = create(size, name)
        names.append(block.name)
        return block

    monkeypatch.setattr(SharedBlock, "create", noted)
    return names


def left_behind(names: list[str]) -> list[str]:
    """Those of some blocks that are still there."""
    return [name for name in names if (Path("/dev/shm") / name.lstrip("/")).exists()]


def played(motion, stop_s, dt_s):
    """q, dq, ddq (m, n) every dt_s, the stop asked for at stop_s."""
    rows = [[motion.q, motion.dq, motion.ddq]]
    while not motion.at_rest:
        if motion.time_s >= stop_s:
            motion.begin_stop()
        motion.advance(dt_s)
        rows.append([motion.q, motion.dq, motion.ddq])
    return np.moveaxis(np.array(rows), 1, 0)


def check_course(motion, course, dt_s):
    """Assert that q, dq, ddq (m, n), every dt_s, fit together inside what the motion promises."""
    (q, dq, ddq), (lower, upper, *most) = course, motion.bounds()
    assert (q >= lower - 1e-9).all() and (q <= upper + 1e-9).all()
    for rate, bound in zip((dq, ddq, np.diff(ddq, axis=0) / dt_s), most, strict=True):
        assert (np.abs(rate) <= bound + 1e-6).all()
    np.testing.assert_allclose(np.diff(q, axis=0) / dt_s, 0.5 * (dq[1:] + dq[:-1]), atol=2e-4)
    np.testing.assert_allclose(np.diff(dq, axis=0) / dt_s, 0.5 * (ddq[1:] + ddq[:-1]), atol=5e-2)


def wait_for(condition, timeout_s: float = 30.0) -> bool:
    """Whether it came true in time."""
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.05)
    return False


def recording_job(path: Path) -> RecordingJob:
    return RecordingJob(path, {"note": "test"}, {"model.json": b"{}"})
