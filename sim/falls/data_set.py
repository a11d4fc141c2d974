"""Data sets of trees in free fall: made on demand, kept in a cache folder, the same for a seed.

One file per trajectory, its name carrying a hash of everything that decides what is in it. A file
is written under another name and then renamed, so that a cut run leaves no half file behind; one
that cannot be read is made again. A trajectory of ATLAS (10 s at 1 kHz) takes 10.6 MB and 1.4 s
of one core; worker processes share the work and change no bit of it.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import pickle
import subprocess
import sys
import tempfile
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import pybullet as bullet

from sim.falls import fall
from sim.falls.fall import RATE_HZ, FallRecord, TreeTruth, babble
from sim.truth import Array

TRAJECTORIES, SECONDS = 63, 10.0  # the paper's, section IV-A
PART = ".part"  # of files that are being written
FORMAT = 1  # of the files; a new one whenever what they hold is computed otherwise
CACHE_VARIABLE = "PANDA_ADAPTER_CACHE"  # environment variable, folder
SIGNALS = tuple(item.name for item in fields(FallRecord))
UNREADABLE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)
MOTION, NOISE = 1, 2  # streams of random numbers

# What the sensors add; all noise is white and Gaussian, of units up to half the sample rate.
STANDARD_GRAVITY = 9.80665  # m/s² per g, exact by definition (CGPM 1901)
ENCODER_STEP = 2 * np.pi / 2**19  # rad; 19 bits, usual for magnetic absolute encoders on joints
# rad rms, our choice: with the quantisation it makes the differentiated position as noisy
# (6 mrad/s rms) as the velocities of a real Panda's log are (sim/models/panda.toml, [noise]).
ENCODER_NOISE = 0.2 * ENCODER_STEP


def measured(truth: TreeTruth, record: FallRecord, rng: np.random.Generator) -> dict[str, Array]:
    """Signals as they are measured, by name: of encoders, torque sensors, a unit on each body.

    Nothing measures accelerations of joints, angular accelerations or the velocity of a frame:
    those signals are absent.

    Args:
        truth: of the tree.
        record: exact samples.
        rng: all that is random comes from it.

    Returns:
        q (m, n) rad; dq (m, n) rad/s, the difference of two readings of the encoder; tau (m, n)
        N m; base_w (m, 3) and link_w (m, n, 3) rad/s; base_a (m, 3) and link_a (m, n, 3) m/s²,
        minus gravity, at the origins of the frames.
    """
    _, link_w, link_a, _ = record.links(truth)
    # The reading before the first sample too: a step of the simulator ends with q = q' + h dq.
    before = record.q[:1] - record.dq[:1] / RATE_HZ
    # rad/s/√Hz and m/s²/√Hz of a MEMS unit, Xsens MTi-1: data sheet, 0.007 °/s/√Hz, 120 µg/√Hz
    densities = np.radians(0.007), 120e-6 * STANDARD_GRAVITY
    gyro, accel = (d * np.sqrt(RATE_HZ / 2) for d in densities)

    def noisy(x: Array, size: float | Array) -> Array:
        return x + size * rng.standard_normal(x.shape)

    turned = noisy(np.concatenate((before, record.q)), ENCODER_NOISE)
    read = np.round(turned / ENCODER_STEP) * ENCODER_STEP
    return {
        "q": read[1:],
        "dq": np.diff(read, axis=0) * RATE_HZ,
        # of the effort limit, rms; a real Panda's log has 0.15 to 0.22 % at its four large joints
        # (sim/models/panda.toml, [noise] tau_above_50hz over effort)
        "tau": noisy(record.tau, 2e-3 * truth.limits.effort),
        "base_w": noisy(record.base_w, gyro),
        "base_a": noisy(record.base_a, accel),
        "link_w": noisy(link_w, gyro),
        "link_a": noisy(link_a, accel),
    }


@dataclass(frozen=True)
class Flight:
    """How a tree falls.

    Attributes:
        seconds: length of a trajectory.
        seed: of motion and noise.

    Raises:
        ValueError: less than one sample, or a seed below 0.
    """

    seconds: float = SECONDS
    seed: int = 0

    def __post_init__(self) -> None:
        if not 1 <= self.seconds * RATE_HZ < np.inf:
            raise ValueError("seconds * rate_hz must be 1 or more")
        if self.seed < 0:
            raise ValueError(f"seed must be 0 or more, got {self.seed}")


@dataclass(frozen=True)
class _Job:
    """All that decides the content of one file."""

    truth: TreeTruth
    number: int
    flight: Flight
    path: Path

    def make(self) -> FallRecord:
        """Simulate the trajectory and write its file."""
        rng = np.random.default_rng([self.flight.seed, MOTION, self.number])
        record = babble(self.truth, self.flight.seconds, rng)
        handle, name = tempfile.mkstemp(dir=self.path.parent, suffix=PART)
        try:
            with os.fdopen(handle, "wb") as file:
                np.savez(file, **{key: getattr(record, key) for key in SIGNALS})
            os.replace(name, self.path)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
        return record

    def check(self, record: FallRecord) -> None:
        """Raises ValueError where a record is not of this job's length and tree."""
        rows = round(self.flight.seconds * RATE_HZ)
        joints = {"q", "dq", "ddq", "tau"}
        for key in SIGNALS:
            wanted = rows, self.truth.n if key in joints else 3
            if getattr(record, key).shape != wanted:
                raise ValueError(f"{self.path}: {key} must have shape {wanted}")


@dataclass(frozen=True)
class FallData:
    """Trajectories of a tree in free fall; an item is a dictionary of signals by name.

    Without noise an item holds the exact signals (attributes of `FallRecord`); with noise what
    sensors make of them (see `measured`). Items are read from the folder each time.

    Attributes:
        truth: the tree.
        folder: where the files are.
        noise: whether items are what sensors measure.
        jobs: what decides each trajectory, and the path of its file.
    """

    truth: TreeTruth
    folder: Path
    noise: bool
    jobs: tuple[_Job, ...]

    def __len__(self) -> int:
        return len(self.jobs)

    def __getitem__(self, k: int) -> dict[str, Array]:
        record = self.exact(k)
        if not self.noise:
            return {key: getattr(record, key) for key in SIGNALS}
        job = self.jobs[k]
        rng = np.random.default_rng([job.flight.seed, NOISE, job.number])
        return measured(self.truth, record, rng)

    def exact(self, k: int) -> FallRecord:
        """Trajectory k without noise; made again if its file cannot be read."""
        job = self.jobs[k]
        try:
            with np.load(job.path, allow_pickle=False) as file:
                record = FallRecord(**{key: file[key] for key in SIGNALS})
            job.check(record)
            return record
        except UNREADABLE:
            return job.make()


def data_set(
    robot: TreeTruth,
    trajectories: int = TRAJECTORIES,
    flight: Flight = Flight(),
    folder: str | Path | None = None,
    noise: bool = False,
    processes: int = 2,
) -> FallData:
    """Trajectories of a robot that falls and babbles; those that are not there yet are made.

    Args:
        robot: the tree, as `fall.atlas`.
        trajectories: how many; a longer set begins with the same ones.
        flight: how it falls.
        folder: for the files; `cache_folder()` where None.
        noise: whether items are what sensors measure.
        processes: at work at once; of no influence on the data.

    Raises:
        ValueError: a count that is not above 0.
        RuntimeError: a motion that leaves the joints' ranges, or a worker process that failed;
            what it said is in the message.
    """
    if trajectories < 1 or processes < 1:
        raise ValueError("trajectories and processes must be 1 or more")
    place = cache_folder() if folder is None else Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    for left in place.glob(f"*{PART}"):  # of a killed run; nobody writes at one file for so long
        with contextlib.suppress(FileNotFoundError):
            if time.time() - left.stat().st_mtime > 3600.0:  # s
                left.unlink()
    # 16 hexadecimal digits that change with anything that decides a trajectory's content
    facts = {
        "format": FORMAT,
        "simulator": bullet.getAPIVersion(),
        "tree": [robot.parent, *(x.tolist() for x in (robot.R, robot.p, robot.theta))],
        "limits": {k: getattr(robot.limits, k).tolist() for k in fall.BOUNDS},
        "gravity": robot.gravity.tolist(),
        "feedback": [fall.BANDWIDTH, fall.DAMPING],
        "babbling": {
            "sines": fall.SINES,
            "low_hz": fall.LOW_HZ,
            "high_hz": fall.HIGH_HZ,
            "share": fall.RANGE_SHARE,
            "top_speed": fall.TOP_SPEED,
            "speed_share": fall.SPEED_SHARE,
            "tumble": fall.TUMBLE,
        },
        "run": [flight.seconds, RATE_HZ, flight.seed],
    }
    key = hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]
    jobs = tuple(
        _Job(robot, k, flight, place / f"{robot.name}_{k:04d}_{key}.npz")
        for k in range(trajectories)
    )
    _make([job for job in jobs if not _sound(job.path)], processes)
    return FallData(robot, place, noise, jobs)


def cache_folder() -> Path:
    """Where data sets are kept: $PANDA_ADAPTER_CACHE, or the user's cache folder (XDG)."""
    if chosen := os.environ.get(CACHE_VARIABLE):
        return Path(chosen)
    general = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(general) / "panda-adapter" / "free_fall"


def _sound(path: Path) -> bool:
    """Whether a file is there and complete, by its directory, which is written last."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return set(file.files) == set(SIGNALS)
    except UNREADABLE:
        return False


def _make(jobs: list[_Job], processes: int) -> None:
    """Make all files, in this process or shared out to several of their own.

    The workers are fresh interpreters: unlike a forked one they share no library's threads with
    this process, and unlike a spawned one they do not run the caller's script again.
    """
    count = min(processes, len(jobs))
    if count < 2:
        for job in jobs:
            job.make()
        return
    command = [sys.executable, "-P", "-c", f"from {__name__} import work; work()"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path))}

    def run(share: list[_Job]) -> subprocess.CompletedProcess[bytes]:
        return subprocess.run(
            command, env=environment, input=pickle.dumps(share), capture_output=True
        )

    with ThreadPoolExecutor(count) as pool:
        for worker in pool.map(run, [jobs[k::count] for k in range(count)]):
            if worker.returncode:
                said = worker.stderr.decode(errors="replace").strip()
                raise RuntimeError(f"a worker ended with {worker.returncode}: {said}")


def work() -> None:
    """A worker process: makes the files of the jobs that come in on standard input."""
    for job in pickle.load(sys.stdin.buffer):
        job.make()
