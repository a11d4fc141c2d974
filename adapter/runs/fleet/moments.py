"""Moments of one recording, all that a fleet keeps of it, and where it keeps them.

They are taken with the λ of the model and add up (eq. 19): of how many recordings, in which order
and on which machine does not matter, and leaving one out of the sum forgets it.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import tempfile
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import datetime
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from adapter.effects.catalogue import REAL_ARM_EFFECTS, effects_by_name
from adapter.errors import MeansError
from adapter.learning.known_effects import learnable
from adapter.learning.learner import OnlineLearner
from adapter.learning.settings import LearnerSettings
from adapter.model import model_file
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.runs.config import PipelineSettings
from adapter.runs.pipeline import make_front_end, make_learner
from adapter.runs.replay import filtered_tables, fitted_to
from adapter.screening.screen import check_torque
from adapter.signals.importer import read_log
from adapter.signals.matching import matching
from adapter.signals.told import AS_RECORDED, Told
from drivers.files.mcap import Log
from drivers.interface import DriverError

FORMAT = 2  # of the files of moments; another one is computed anew
EPOCH_S = 1e9  # stamps below are no dates: a clock that counts from its start
SEEN, FOLDER, GONE = "seen.jsonl", "moments", ".forgotten"


class Task(NamedTuple):
    """What a worker needs to know of a recording.

    Attributes:
        path: of the file or folder, or an address that fsspec opens.
        model: the documented arm as the text of a model file.
        topic: of the joint states, None for the only one; told: what is said of the recording.
    """

    path: str
    model: str
    topic: str | None = None
    told: Told = AS_RECORDED


class Broken(NamedTuple):
    """A file that could not be used, and the sentence that says why."""

    path: str
    why: str


@dataclass(frozen=True, eq=False)
class LogMoments:
    """What is kept of a recording.

    Attributes:
        content: SHA-256 of the recording's bytes.
        path: where it was read.
        arm: name or serial number that the recording tells, None if it tells none.
        begin_s, span_s: first stamp (s, since 1970 where the recording tells its date), and to the
            last one.
        samples: filtered states in the moments.
        count: independent samples that these are worth.
        A: moments of the joints' torques (see `Moments`), of samples that are independent.
        notes: on the recording, a sentence each.
    """

    content: str
    path: str
    arm: str | None
    begin_s: float
    span_s: float
    samples: int
    count: float
    A: Array
    notes: Sequence[str] = ()

    def save(self, path: Path) -> None:
        """Write them, whole or not at all."""
        said = {key: value for key, value in asdict(self).items() if key != "A"}
        with model_file.whole_file(path) as part, part.open("wb") as file:
            np.savez(file, A=self.A, said=np.array(json.dumps(said)))

    @classmethod
    def load(cls, path: Path, whole: bool = True) -> LogMoments:
        """Read them back, to the last bit; without the moments themselves where not `whole`."""
        with np.load(path) as kept:
            A = kept["A"] if whole else np.empty(0)
            return cls(A=A, **json.loads(str(kept["said"])))


def learning_of(model: SelfModel) -> LearnerSettings:
    """Beside θ the effects of a real arm are learned, but for those that need θ to be seen."""
    names = tuple(x.name for x in effects_by_name(REAL_ARM_EFFECTS) if not x.by_rates)
    return LearnerSettings(effects=learnable(model, names))


def learner_of(model: SelfModel) -> OnlineLearner:
    """A learner for moments of independent samples, none in it yet."""
    learner = make_learner(model, PipelineSettings(learner=learning_of(model)))
    learner.theta.noise_gain = 1.0
    return learner


def content_of(task: Task) -> str | Broken:
    """SHA-256 of a recording's bytes, of a folder's files in the order of their names."""
    try:
        with at_hand(task.path) as path:
            return _content(path)
    except (OSError, ValueError, MeansError) as error:
        return _broken(task.path, error)


def files_of(path: Path) -> list[Path]:
    """A recording's files, of a folder in the order of their names."""
    return sorted(x for x in path.rglob("*") if x.is_file()) if path.is_dir() else [path]


def _content(path: Path) -> str:
    digest = hashlib.sha256()
    for file in files_of(path):
        if path.is_dir():
            digest.update(str(file.relative_to(path)).encode() + b"\0")
        with file.open("rb") as opened:
            while block := opened.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def moments_of(task: Task) -> LogMoments | Broken:
    """Read a recording and take its moments; whatever is wrong with it becomes a sentence.

    One that lies behind an address is fetched once, for its content and for its moments.
    """
    try:
        with at_hand(task.path) as path:
            content = _content(path)
            log = read_log(path, topic=task.topic)
        model = _model(task.model)
        return taken(task.told.log(log, model), model, content, task.path)
    except Exception as error:  # of thousands of files one has what no reader has thought of
        return _broken(task.path, error)


def taken(log: Log, model: SelfModel, content: str, path: str) -> LogMoments:
    """Moments of a recording in memory.

    Args:
        log: as it was read; model: the documented arm.
        content, path: what it is to be known by.

    Raises:
        DriverError, RecordingRefused: nothing can be learned from it.
    """
    named = arm_named(log.metadata)
    log = matching(log, model)
    if not len(log):
        raise DriverError("no samples to learn from")
    log, model, said = check_torque(log, model)
    settings, rate = fitted_to(log, PipelineSettings().filter)
    said = [x.removeprefix(f"{log.path}: ") for x in dict.fromkeys([*log.warnings, *said, *rate])]
    both = PipelineSettings(filter=settings, learner=learning_of(model))
    front_end, learner = make_front_end(model, both), make_learner(model, both)
    frames = model.joint_rotation(), model.lam[:, 3:]
    into, samples = learner.theta.empty_moments(), 0
    learner.theta.rests[:] = 1.0  # how friction holds is told by all logs together
    for table in filtered_tables(log, len(log), front_end):
        states = learner.without_known(learner.sound(table))
        if len(states):
            learner.theta.absorb_again(frames, states[:, learner.layout.before_links], into)
            samples += len(states)
    if not samples:
        reasons = ", ".join(reason for reason, _ in front_end.refused.most_common())
        raise DriverError(f"nothing can be learned from it: {reasons or 'no states'}")
    if not np.isfinite(into.A).all():
        raise DriverError("its numbers are beyond what can be added up")
    share = 1.0 / learner.theta.noise_gain
    begin, end = int(log.stamp_ns.min()), int(log.stamp_ns.max())
    begin_s, begun = 1e-9 * begin, log.metadata.get("begun")
    if begin_s < EPOCH_S and isinstance(begun, str):
        begin_s += datetime.fromisoformat(begun).timestamp()
    spans = begin_s, 1e-9 * (end - begin)
    return LogMoments(content, path, named, *spans, samples, share * samples, share * into.A, said)


def arm_named(metadata: dict[str, Any]) -> str | None:
    """Name or serial number of the arm that a recording tells, if it does."""
    entries = (metadata, *(x for x in metadata.values() if isinstance(x, dict)))
    keys = "arm", "serial", "serial_number", "robot_serial", "arm_id"
    told = (entry.get(key) for entry in entries for key in keys)
    return next(filter(None, (str(x).strip() for x in told if isinstance(x, str | int))), None)


_model = lru_cache(maxsize=4)(model_file.loads)


@contextmanager
def at_hand(address: str) -> Iterator[Path]:
    """The recording on this machine; one behind an address is copied for as long as it takes."""
    if "://" not in address:
        yield Path(address)
        return
    filesystem, inside = opened(address)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / Path(inside).name
        filesystem.get(inside, str(path), recursive=filesystem.isdir(inside))
        yield path


def opened(address: str) -> tuple[Any, str]:
    """What fsspec makes of an address: the file system, and the path on it.

    Raises:
        MeansError: fsspec, or what it needs for such an address, is not installed.
        ValueError: nobody knows such addresses.
    """
    try:
        core = importlib.import_module("fsspec.core")
        filesystem, inside = core.url_to_fs(address)
    except ImportError as error:
        raise MeansError(f"{address}: {error}; pip install 'panda-adapter[cluster]'") from None
    return filesystem, str(inside)


def _broken(path: str, error: Exception) -> Broken:
    if isinstance(error, MemoryError):
        return Broken(path, "there is not enough memory for it")
    said = error.strerror if isinstance(error, OSError) else None
    told, name = said or str(error), Path(path).name
    place, there, rest = told.partition(f"{name}: ")  # it is said where the sentence goes
    if there and (not place or place.endswith("/")):
        told = rest
    expected = isinstance(error, DriverError | OSError | ValueError | MeansError)
    return Broken(path, told if expected and told else f"{type(error).__name__}: {told}")


class Store:
    """What a fleet has learned so far, on disk: moments by the content of log and model.

    Args:
        folder: made if it is not there.
        model: text of the model that the moments are taken with; those of others are not seen.
    """

    def __init__(self, folder: Path, model: str) -> None:
        self._folder = folder / FOLDER
        self._folder.mkdir(parents=True, exist_ok=True)
        self._model = hashlib.sha256(f"{FORMAT}\n{model}".encode()).hexdigest()[:16]
        self._seen_file = folder / SEEN
        self._seen = self._read_seen()

    def _path(self, content: str) -> Path:
        return self._folder / f"{self._model}-{content}.npz"

    def _read_seen(self) -> dict[str, tuple[str, str]]:
        """Marks and contents by path: a line each, the last one counts, a torn one does not."""
        seen: dict[str, tuple[str, str]] = {}
        try:
            text = self._seen_file.read_text(encoding="utf-8", errors="replace")
        except OSError:
            return seen  # it saves reading recordings again, no more
        for line in text.splitlines():
            try:
                path, mark, content = json.loads(line)
            except (ValueError, TypeError):
                continue
            seen[path] = mark, content
        return seen

    def content_seen(self, path: str, mark: str) -> str | None:
        """The content of a recording whose mark was this when it was read, None if unknown."""
        before, content = self._seen.get(path, ("", ""))
        return content if mark and mark == before else None

    def remember(self, path: str, mark: str, content: str) -> None:
        """Keep the content of a recording, by `mark_of` it before it was read, for next time."""
        if mark and self._seen.get(path) != (mark, content):
            self._seen[path] = mark, content
            with self._seen_file.open("a", encoding="utf-8") as file:
                file.write("\n" + json.dumps([path, mark, content]))

    def places(self) -> dict[str, str]:
        """Where contents were seen last."""
        return {content: path for path, (_, content) in self._seen.items()}

    def has(self, content: str) -> bool:
        """Whether nothing is to be done for it: its moments are there, or it was forgotten."""
        return self._path(content).exists() or self.forgotten(content)

    def forgotten(self, content: str) -> bool:
        """Whether it must not count."""
        return self._path(content).with_suffix(GONE).exists()

    def add(self, moments: LogMoments) -> None:
        """Keep moments."""
        moments.save(self._path(moments.content))

    def forget(self, contents: Iterable[str]) -> None:
        """Leave recordings out from here on, though they are given again."""
        for content in contents:
            self._path(content).with_suffix(GONE).touch()
            self._path(content).unlink(missing_ok=True)

    def recall(self, contents: Iterable[str]) -> None:
        """Take back what `forget` did; they are read again when they are given."""
        for content in contents:
            self._path(content).with_suffix(GONE).unlink(missing_ok=True)

    def heads(self) -> list[LogMoments]:
        """All that is known, without the moments, by content; damaged ones go, to be read again."""
        paths = sorted(self._folder.glob(f"{self._model}-*.npz"))
        return [x for x in (self._read(path, False) for path in paths) if x is not None]

    def whole(self, heads: Iterable[LogMoments]) -> list[LogMoments]:
        """These with their moments."""
        found = (self._read(self._path(head.content), True) for head in heads)
        return [x for x in found if x is not None]

    def _read(self, path: Path, whole: bool) -> LogMoments | None:
        try:
            return LogMoments.load(path, whole)
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
            path.unlink(missing_ok=True)
            return None


def mark_of(path: str) -> str:
    """What changes with a recording's content and is known without reading it, "" if nothing is.

    Size and time of change of a file, or of all files in a folder; behind an address what its file
    system knows (an ETag, a version, a time).
    """
    try:
        if "://" in path:
            filesystem, inside = opened(path)
            files = filesystem.find(inside) if filesystem.isdir(inside) else [inside]
            said = [(str(file), str(filesystem.ukey(file))) for file in files]
        else:
            stats = [(str(file), os.stat(file)) for file in files_of(Path(path))]
            said = [(name, f"{x.st_size} {x.st_mtime_ns} {x.st_ino}") for name, x in stats]
    except (OSError, ValueError, RuntimeError, NotImplementedError):
        return ""
    return hashlib.sha256(json.dumps(said).encode()).hexdigest()[:32]
