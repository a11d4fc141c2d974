"""What the workers are asked to do: learn, record, show. All of it is picklable."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

from adapter.realtime.snapshot import Snapshot
from adapter.records import Array


class LearnerLike(Protocol):
    """What is fed: every filtered state once, in order. It must copy what it keeps."""

    def step(self, record: Array) -> None:
        """Learn from one record of `StateLayout`."""


@dataclass(frozen=True)
class LearnerJob:
    """The learner process. The callables are top-level functions or partials of such.

    Attributes:
        make: builds the learner there (and imports torch there).
        collect: what comes back at the end, picklable.
        publish: the estimate as it stands; None publishes nothing.
        save: writes a checkpoint; None writes none.
        keep: writes the whole state into an empty folder (learner, folder), for a successor if
            this process dies; restore: puts a fresh learner into it. Where None, nobody succeeds.
        effect_names: effects in the published estimate.
        bodies: rows of θ in it; one per joint where None.
        publish_s, save_s: how often.
    """

    make: Callable[[], LearnerLike]
    collect: Callable[[Any], Any]
    publish: Callable[[Any], Snapshot] | None = None
    save: Callable[[Any], None] | None = None
    keep: Callable[[Any, Path], None] | None = None
    restore: Callable[[Any, Path], None] | None = None
    effect_names: tuple[str, ...] = ()
    bodies: int | None = None
    publish_s: float = 0.01
    save_s: float = 5.0


@dataclass(frozen=True)
class RecordingJob:
    """The recorder process.

    Attributes:
        path: of the MCAP file.
        metadata: configuration, version, ...: written at the start.
        attachments: files to put inside, by name.
        overwrite: whether an existing file may be replaced.
        describe: what of an estimate goes to /estimates; everything where None.
        estimate_s: how often.
    """

    path: Path
    metadata: Mapping[str, Any] = field(default_factory=dict)
    attachments: Mapping[str, bytes] = field(default_factory=dict)
    overwrite: bool = False
    describe: Callable[[Snapshot], Mapping[str, Any]] | None = None
    estimate_s: float = 0.1

    def part(self, k: int) -> RecordingJob:
        """The same for the k-th successor of a recorder that died: a file of its own."""
        if k == 0:
            return self
        path = self.path.with_name(f"{self.path.stem}.part{k + 1}{self.path.suffix}")
        return replace(self, path=path)


@dataclass(frozen=True)
class View:
    """What a display shows.

    Attributes:
        samples: passed on by the loop so far (filtered states where it learns).
        waiting: of these, not taken by their worker yet.
        elapsed_s: since the display began.
        snapshot: the newest estimate, None where none is published.
        done: nothing comes any more.
    """

    samples: int
    waiting: int
    elapsed_s: float
    snapshot: Snapshot | None
    done: bool


@dataclass(frozen=True)
class WatchJob:
    """A display in its own process, so that a slow terminal never holds up the loop.

    Attributes:
        make: builds the display there; it is called with a `View` again and again, at last with
            one that is `done`.
        period_s: how often.
    """

    make: Callable[[], Callable[[View], None]]
    period_s: float = 0.25
