"""Learners and displays for tests of the live process.

Its worker processes import this file, and nothing that takes long.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from adapter.realtime.jobs import LearnerJob
from adapter.realtime.showing import View
from adapter.realtime.snapshot import Snapshot
from adapter.signals.records import stamp_of


def nothing_known(n: int, bodies: int, effects: int) -> Snapshot:
    """A snapshot of NaN for n joints, to be completed with `dataclasses.replace`."""
    per_joint, per_body = np.full((n, 6), np.nan), np.full((bodies, 10), np.nan)
    per_effect = np.full((effects, n), np.nan)
    bodies_too = per_joint, per_joint, per_body, per_body
    return Snapshot(*bodies_too, per_effect, per_effect, per_effect, np.full(n, np.nan))


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
        if self.count == 300:
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


def no_learner() -> Digest:
    """In place of one that cannot be made."""
    raise RuntimeError("no such model")


def save_count(learner: Digest) -> None:
    """A checkpoint in the file named in TEST_CHECKPOINT."""
    Path(os.environ["TEST_CHECKPOINT"]).write_text(str(learner.count))


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


def learner_job(kind: Callable[[], Digest] = Digest, save=None) -> LearnerJob:
    return LearnerJob(kind, Digest.summary, publish, save, publish_s=0.01, save_s=0.5)


def lasting_job(kind: type[Digest] = Digest) -> LearnerJob:
    """The same with successors."""
    return replace(learner_job(kind), keep=Digest.keep, restore=Digest.restore)


class Witness:
    """A view that writes down its process and what it saw last, and does not end by itself."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        (folder / f"{os.getpid()}.view").touch()

    def __call__(self, view: View) -> None:
        ended = "" if view.ended is None else ",".join(view.ended)
        ticks = 0 if view.timing is None else view.timing.of("loop_us").count
        whole = self._folder / f"{os.getpid()}.part"
        whole.write_text(f"{view.samples} {ticks} {view.done} {ended}")
        whole.rename(self._folder / "last")
        if view.done:
            time.sleep(600.0)


class Lines:
    """A display that writes the loop's lines to a file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __call__(self, view: View) -> None:
        self._path.write_text("\n".join(view.lines))


def no_view() -> None:
    """In place of a view that cannot be made."""
    raise RuntimeError("the page cannot be drawn")
