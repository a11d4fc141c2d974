"""Arms and learners for tests of the live process; importable by its worker processes."""

from __future__ import annotations

import hashlib
import os
import pickle
import signal
import time
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np

from adapter.control.controller import ExcitationController
from adapter.control.limits import MotionLimits
from adapter.control.settings import ExcitationSettings
from adapter.model.urdf import read_urdf
from adapter.realtime.jobs import LearnerJob, RecordingJob, View
from adapter.realtime.loop import LiveOptions
from adapter.realtime.snapshot import Snapshot, nothing_known
from adapter.realtime.supervisor import SharedMemoryOptions
from adapter.signals.front_end import FrontEnd
from adapter.signals.records import stamp_of
from drivers.interface import DriverError, Intake, JointSample
from drivers.pybullet_arm import PyBulletArm
from sim.scenarios import build

PANDA = read_urdf(resources.files("adapter") / "model" / "robots" / "panda.urdf")
DYING_AT = 300


class Digest:
    """A learner that remembers what it was fed."""

    def __init__(self) -> None:
        self.count, self.last_ns, self.in_order = 0, -1, True
        self._chain = b""

    def step(self, record) -> None:
        stamp_ns = stamp_of(record)
        self.in_order = self.in_order and stamp_ns > self.last_ns
        self.count, self.last_ns = self.count + 1, stamp_ns
        self._chain = hashlib.sha256(self._chain + record.tobytes()).digest()

    def summary(self) -> tuple[int, bool, str]:
        return self.count, self.in_order, self._chain.hex()

    def keep(self, folder: Path) -> None:
        (folder / "state").write_bytes(pickle.dumps(self.__dict__))

    def restore(self, folder: Path) -> None:
        self.__dict__.update(pickle.loads((folder / "state").read_bytes()))


class Dying(Digest):
    """A learner whose process dies without a word."""

    def step(self, record) -> None:
        super().step(record)
        if self.count == DYING_AT:
            os._exit(3)


class Mortal(Digest):
    """A learner that is killed, once each, when it has learned as many states as TEST_DEATHS says.

    Of those that died it is written in the folder TEST_GRAVES.
    """

    def step(self, record) -> None:
        super().step(record)
        if str(self.count) in os.environ["TEST_DEATHS"].split():
            die_once(str(self.count))


def die_once(name: str) -> None:
    """kill -9 of this process, unless it happened before under this name."""
    try:
        (Path(os.environ["TEST_GRAVES"]) / name).touch(exist_ok=False)
    except FileExistsError:
        return
    os.kill(os.getpid(), signal.SIGKILL)


class Failing(Digest):
    """A learner with a bug."""

    def step(self, record) -> None:
        raise ZeroDivisionError("a bug in the learner")


def publish(learner: Digest) -> Snapshot:
    known = nothing_known(7, 7, 0)
    theta = np.full((7, 10), float(learner.count))
    return replace(known, theta=theta, learned=learner.count, stamp_ns=learner.last_ns)


class Diary:
    """A display that writes what it saw to the file named in TEST_DIARY."""

    def __call__(self, view: View) -> None:
        learned = None if view.snapshot is None else view.snapshot.learned
        with open(os.environ["TEST_DIARY"], "a") as file:
            file.write(f"{view.samples} {view.waiting} {learned} {view.done}\n")


def learner_job(kind: type[Digest] = Digest, save=None) -> LearnerJob:
    return LearnerJob(kind, Digest.summary, publish, save, publish_s=0.01, save_s=0.5)


def lasting_job(kind: type[Digest] = Digest) -> LearnerJob:
    """The same with successors."""
    return replace(learner_job(kind), keep=Digest.keep, restore=Digest.restore)


def simulated_arm(seed: int = 5, scenario: str = "nominal") -> PyBulletArm:
    return PyBulletArm(build(scenario, seed).plant())


def parts(seed: int = 5):
    """Front end and controller of a Panda."""
    motion = ExcitationSettings(seed=seed)
    return FrontEnd(PANDA), ExcitationController(MotionLimits.of(PANDA), motion)


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


def shared_memory() -> set[str]:
    """Names of the blocks that no other process uses: ours, and what was left behind."""
    folder = Path("/dev/shm")
    names = {p.name for p in folder.iterdir()} if folder.is_dir() else set()
    for maps in Path("/proc").glob("[0-9]*/maps"):
        if not names or maps.parent.name == str(os.getpid()):
            continue
        try:
            used = maps.read_text(errors="replace")
        except OSError:  # it ended, or is somebody else's
            continue
        names -= {name for name in names if f"/dev/shm/{name}" in used}
    return names


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
