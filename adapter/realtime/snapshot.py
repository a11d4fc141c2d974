"""What other processes may know of a run, in shared memory under a name.

The learner publishes its estimate and, as text, what it found; the loop what pushes the arm, 1000
times a second.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapter.errors import MeansError
from adapter.model.self_model import LAMBDA_SOURCES
from adapter.model.spatial import Array
from adapter.realtime.shared import SEQUENCE, SharedBlock, SharedMemoryError, Slots, split
from drivers.files.bounded import parse_json

MAGIC = 0x5041534E41503035  # "PASNAP05"
VERSION, EXTERNAL_VERSION, NEWS_VERSION = 0, 1, 2  # words of the header, as are the next ones
KIND, N, BODIES, EFFECTS, PID, TEXT = range(8, 14)
HEADER_WORDS, TEXT_BYTES, NEWS_BYTES = 16, 8192, 16384
STAMP, LEARNED, PUBLISHED, FLAGS, SOURCE = range(1, 6)  # words of an estimate
LENGTH = LEARNED  # of the news, bytes
CONTACT = FLAGS  # of the external torque: joint (from 1) where it stands out in a contact, or 0
LAM_CONVERGED, THETA_CONVERGED = 1, 2
DEFAULT_NAME = "panda_adapter"
READ_TIMEOUT_S = 0.2

Shapes = dict[str, tuple[int, ...]]


class SnapshotError(MeansError):
    """There is no estimate to read or no place to publish one; the message says why."""


class Board:
    """The block's layout, for both sides."""

    def __init__(self, block: SharedBlock) -> None:
        self._block = block
        self.name = block.name
        if block.size < 8 * HEADER_WORDS:
            block.close()
            raise foreign(block.name)
        self._header: NDArray[np.int64] = block.array((HEADER_WORDS,), np.int64, 0)

    def _map(self) -> None:
        """Lay the arrays over the block. Raises SnapshotError where it is not what it says."""
        head = 8 * HEADER_WORDS
        n, bodies, effects, text = (int(self._header[k]) for k in (N, BODIES, EFFECTS, TEXT))
        least, fits = min(n, bodies, effects, text), text <= TEXT_BYTES
        if least < 0 or not fits or block_size(n, bodies, effects) > self._block.size:
            raise foreign(self.name)
        try:
            names = parse_json(self._block.array((text,), np.uint8, head).tobytes())
            joints, known = names["joints"], names["effects"]
        except (ValueError, KeyError, TypeError):
            raise foreign(self.name) from None
        self.joint_names: tuple[str, ...] = tuple(joints)
        self.effect_names: tuple[str, ...] = tuple(known)
        if (len(self.joint_names), len(self.effect_names)) != (n, effects):
            raise foreign(self.name)
        self.shapes, self._external_shapes = estimate_shapes(n, bodies, effects), push_shapes(n)
        start, size = head + TEXT_BYTES, value_count(self.shapes)
        self._estimate: Slots | None = Slots(self._block, self._header[VERSION:], start, size)
        start, size = start + Slots.bytes_of(size), value_count(self._external_shapes)
        newest = self._header[EXTERNAL_VERSION:]
        self._external: Slots | None = Slots(self._block, newest, start, size)
        start, newest = start + Slots.bytes_of(size), self._header[NEWS_VERSION:]
        self._news: Slots | None = Slots(self._block, newest, start, NEWS_BYTES // 8)

    def close(self) -> None:
        """Let go of the memory; may be called more than once."""
        self._header = np.zeros(0, np.int64)
        self._estimate = self._external = self._news = None
        self._block.close()


def estimate_shapes(n: int, bodies: int, effects: int) -> Shapes:
    """Of an estimate's values, in their order."""
    shapes: Shapes = dict.fromkeys(("lam", "lam_std"), (n, 6))
    shapes |= dict.fromkeys(("theta", "theta_std"), (bodies, 10))
    shapes |= dict.fromkeys(("effects", "effects_std", "effect_shapes"), (effects, n))
    return shapes | {"torque_std": (n,)}


def push_shapes(n: int) -> Shapes:
    """Of what pushes the arm."""
    return {"torque": (n,), "torque_std": (n,), "wrench": (6,), "wrench_std": (6,)}


def value_count(shapes: Shapes) -> int:
    return sum(math.prod(shape) for shape in shapes.values())


def block_size(n: int, bodies: int, effects: int) -> int:
    """Bytes of a block."""
    both = estimate_shapes(n, bodies, effects), push_shapes(n)
    slots = sum(Slots.bytes_of(value_count(shapes)) for shapes in both)
    slots += Slots.bytes_of(NEWS_BYTES // 8)
    return 8 * HEADER_WORDS + TEXT_BYTES + slots


def foreign(name: str) -> SnapshotError:
    """What is said of shared memory that is not ours; it is left alone."""
    return SnapshotError(
        f"'{name}' is in use by another program: shared memory '{name}' is no estimate of this "
        "version"
    )


def attached(name: str) -> SharedBlock:
    """An existing block. Raises FileNotFoundError; SnapshotError for what cannot be ours."""
    try:
        return SharedBlock.attach(name)
    except FileNotFoundError:
        raise
    except (OSError, ValueError):  # of another user, a folder, of no bytes; a name that is none
        raise foreign(name) from None


def allocate(size: int, name: str | None) -> SharedBlock:
    """A block; one that a dead process left under this name is replaced."""
    try:
        try:
            return SharedBlock.create(size, name)
        except FileExistsError:
            assert name is not None
            _remove_leftover(name)
            return SharedBlock.create(size, name)
    except (SharedMemoryError, OSError) as error:
        raise SnapshotError(f"no shared memory for the estimate: {error}") from error


def _remove_leftover(name: str) -> None:
    """Remove what a dead process left. Raises SnapshotError where it is not, or not ours."""
    try:
        board = Board(attached(name))
    except FileNotFoundError:  # gone meanwhile
        return
    kind, owner = int(board._header[KIND]), int(board._header[PID])
    board.close()
    if kind != MAGIC:
        raise foreign(name)
    if _alive(owner):
        raise SnapshotError(f"'{name}' is in use by process {owner}")
    board._block.unlink()


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return pid > 0


@dataclass(frozen=True)
class Snapshot:
    """An estimate at one instant; n joints, b bodies, e effects.

    Attributes:
        lam: (n, 6) λ, rad and m (eq. 3b).
        lam_std: (n, 6) its standard deviations as in `SelfModel.lam_std`.
        theta: (b, 10) θ in the link frames (eq. 4b).
        theta_std: (b, 10) its standard deviations.
        effects: (e, n) parameters of the effects, in the order of `effect_names`.
        effects_std: (e, n) their standard deviations.
        effect_shapes: (e, n) the parameter beside it that was chosen (s0 of bristle friction); NaN
            for effects without one.
        torque_std: (n,) N m, what the estimate leaves unexplained of the torques learned from.
        lam_converged: λ is valid to work with.
        theta_converged: θ and the effects are valid to work with.
        stamp_ns: of the newest filtered state learned from, on the arm's clock.
        learned: states learned from so far.
        lambda_source: one of `model.LAMBDA_SOURCES`; says whether λ was measured.
        version: counts publications; 0 where nothing was published yet (all values NaN).
        published_ns: when, on this machine's CLOCK_MONOTONIC (`time.monotonic_ns`).
    """

    lam: Array
    lam_std: Array
    theta: Array
    theta_std: Array
    effects: Array
    effects_std: Array
    effect_shapes: Array
    torque_std: Array
    lam_converged: bool = False
    theta_converged: bool = False
    stamp_ns: int = 0
    learned: int = 0
    lambda_source: str = LAMBDA_SOURCES[0]
    version: int = 0
    published_ns: int = 0

    @property
    def age_s(self) -> float:
        """Seconds since this was published, on the machine that publishes."""
        return 1e-9 * (time.monotonic_ns() - self.published_ns)


@dataclass(frozen=True)
class ExternalTorque:
    """What pushes the arm from outside, at one instant.

    Attributes:
        torque: (n,) that the surroundings put on the joints, N m.
        torque_std: (n,) its standard deviation without a contact, N m.
        wrench: (6,) [f; m] on the last link at its origin that explains it best, in axes of the
            base, N and N m.
        wrench_std: (6,) its standard deviation; that of not knowing where no torque shows it.
        contact_joint: (from 0) where it stands out most, while there is a contact; else None.
        learned: whether it goes by the learned model, or still by the documented one.
        stamp_ns: of the sample, on the arm's clock; version 0 before the first one (all NaN).
        version, published_ns: as in a `Snapshot`.
    """

    torque: Array
    torque_std: Array
    wrench: Array
    wrench_std: Array
    contact_joint: int | None
    learned: bool
    stamp_ns: int
    version: int = 0
    published_ns: int = 0


class SnapshotWriter(Board):
    """Publishes. Built by `create` in the process that owns the memory, `attach` in a worker."""

    @classmethod
    def create(
        cls,
        joint_names: Sequence[str],
        effect_names: Sequence[str] = (),
        bodies: int | None = None,
        name: str | None = DEFAULT_NAME,
    ) -> SnapshotWriter:
        """A board with nothing on it.

        Args:
            joint_names: of the arm.
            effect_names: of the effects learned beside θ.
            bodies: rows of θ; one for each joint where None.
            name: for readers; any free one where None. A leftover of a dead process is replaced.

        Raises:
            SnapshotError: the name is in use, or too many names.
        """
        n, e = len(joint_names), len(effect_names)
        b = n if bodies is None else bodies
        text = json.dumps({"joints": list(joint_names), "effects": list(effect_names)}).encode()
        if len(text) > TEXT_BYTES:
            raise SnapshotError(f"the joint names take {len(text)} bytes; at most {TEXT_BYTES}")
        board = cls(allocate(block_size(n, b, e), name))
        h = board._header
        h[[N, BODIES, EFFECTS, PID, TEXT]] = n, b, e, os.getpid(), len(text)
        board._block.array((len(text),), np.uint8, 8 * HEADER_WORDS)[:] = list(text)
        board._map()
        for slots in filter(None, (board._estimate, board._external, board._news)):
            slots.blank()
        h[KIND] = MAGIC
        return board

    @classmethod
    def attach(cls, name: str) -> SnapshotWriter:
        """The writer's end in a worker process of the creator. Raises FileNotFoundError."""
        board = cls(SharedBlock.attach(name, own=True))
        board._map()
        return board

    def publish(self, snapshot: Snapshot) -> int:
        """Publish; `version` and `published_ns` are set here. Returns the version.

        Raises ValueError for a shape that doesn't fit the board or an unknown λ source.
        """
        slots = self._filled(self._estimate, self.shapes, snapshot)
        if snapshot.lambda_source not in LAMBDA_SOURCES:
            choices = ", ".join(LAMBDA_SOURCES)
            raise ValueError(f"no lambda_source '{snapshot.lambda_source}'; have: {choices}")
        words = slots.words
        words[STAMP], words[LEARNED] = snapshot.stamp_ns, snapshot.learned
        words[PUBLISHED] = time.monotonic_ns()
        words[FLAGS] = LAM_CONVERGED * bool(snapshot.lam_converged)
        words[FLAGS] += THETA_CONVERGED * bool(snapshot.theta_converged)
        words[SOURCE] = LAMBDA_SOURCES.index(snapshot.lambda_source)
        return slots.put()

    def publish_external(self, push: ExternalTorque) -> int:
        """As `publish`, what pushes the arm; costs some 10 µs."""
        slots = self._filled(self._external, self._external_shapes, push)
        words, joint = slots.words, push.contact_joint
        words[STAMP], words[LEARNED] = push.stamp_ns, push.learned
        words[PUBLISHED] = time.monotonic_ns()
        words[CONTACT] = 0 if joint is None else joint + 1
        return slots.put()

    def publish_news(self, news: Mapping[str, Any]) -> int:
        """As `publish`, what was found so far: anything JSON can hold.

        Raises ValueError for what takes more than `NEWS_BYTES` as JSON, or is none.
        """
        slots, text = self._news, json.dumps(news, allow_nan=False).encode()
        assert slots is not None, "closed"
        if len(text) > NEWS_BYTES:
            raise ValueError(f"news take {len(text)} bytes; at most {NEWS_BYTES}")
        slots.values.view(np.uint8)[: len(text)] = np.frombuffer(text, np.uint8)
        slots.words[LENGTH], slots.words[PUBLISHED] = len(text), time.monotonic_ns()
        return slots.put()

    def _filled(
        self, slots: Slots | None, shapes: Shapes, source: Snapshot | ExternalTorque
    ) -> Slots:
        """The slots with the values of these shapes, one after the other. Raises ValueError."""
        assert slots is not None, "closed"
        start = 0
        for key, shape in shapes.items():
            value = np.asarray(getattr(source, key))
            if value.shape != shape:
                raise ValueError(f"{key} must have shape {shape}, got {value.shape}")
            slots.values[start : start + value.size] = value.reshape(-1)
            start += value.size
        return slots

    def unlink(self) -> None:
        """Creator: remove the name."""
        self._block.unlink()


class SnapshotReader(Board):
    """Reads the estimate of a running adapter from another process.

    `read` takes some 10 µs, never waits for the writer and returns values of one and the same
    estimate. Use as a context manager, or call `close`.

    Args:
        name: as given to `adapter run`.

    Attributes:
        joint_names: order of the rows of λ (and of θ, on a fixed base).
        effect_names: order of the rows of `effects`.

    Raises:
        SnapshotError: nobody publishes under this name.

    >>> import adapter
    >>> from adapter.realtime import SnapshotWriter
    >>> publisher = SnapshotWriter.create(("a", "b"), name="snapshot_example")  # as `run` does
    >>> with adapter.SnapshotReader("snapshot_example") as reader:
    ...     snapshot = reader.read()  # lam, theta, their std, effects; of one and the same instant
    >>> snapshot.version, snapshot.lam.shape
    (0, (2, 6))
    >>> publisher.unlink()
    >>> publisher.close()
    """

    def __init__(self, name: str = DEFAULT_NAME) -> None:
        try:
            block = attached(name)
        except FileNotFoundError:
            raise SnapshotError(
                f"no estimate is published as '{name}'; is `adapter run` running, with this "
                "snapshot name?"
            ) from None
        super().__init__(block)
        if int(self._header[KIND]) != MAGIC:
            self.close()
            raise foreign(name)
        try:
            self._map()
        except SnapshotError:
            self.close()
            raise

    def read(self, timeout_s: float = READ_TIMEOUT_S) -> Snapshot:
        """The newest estimate; of `version` 0 and NaN where nothing was published yet.

        Raises SnapshotError where no whole one could be read in `timeout_s`, or after `close`.
        """
        slots = self._taken(self._estimate, timeout_s)
        words, parts = slots.words, split(slots.values, self.shapes)
        flags, source = int(words[FLAGS]), int(words[SOURCE])
        if not 0 <= source < len(LAMBDA_SOURCES):
            raise foreign(self.name)
        return Snapshot(
            **parts,
            lam_converged=bool(flags & LAM_CONVERGED),
            theta_converged=bool(flags & THETA_CONVERGED),
            stamp_ns=int(words[STAMP]),
            learned=int(words[LEARNED]),
            lambda_source=LAMBDA_SOURCES[source],
            version=int(words[SEQUENCE]),
            published_ns=int(words[PUBLISHED]),
        )

    def read_external(self, timeout_s: float = READ_TIMEOUT_S) -> ExternalTorque:
        """What pushes the arm; of `version` 0 and NaN where nobody watches. Raises as `read`."""
        slots = self._taken(self._external, timeout_s)
        words, joint = slots.words, int(slots.words[CONTACT])
        return ExternalTorque(
            **split(slots.values, self._external_shapes),
            contact_joint=joint - 1 if joint > 0 else None,
            learned=bool(words[LEARNED]),
            stamp_ns=int(words[STAMP]),
            version=int(words[SEQUENCE]),
            published_ns=int(words[PUBLISHED]),
        )

    def read_news(self, timeout_s: float = READ_TIMEOUT_S) -> dict[str, Any]:
        """What the learner found so far; empty before it said anything. Raises as `read`.

        "findings": as `adapter.gap.monitor.Monitor.reports`; "load": what was picked up ("m",
        "m_std" in kg, "since_s" on the arm's clock), or None; "changes_s": at the hand, on the
        same clock; "theta_started": whether θ is being learned already; "notes": what is wrong
        with sensors; "refused": states that were none.
        """
        slots = self._taken(self._news, timeout_s)
        length = int(slots.words[LENGTH])
        if not length:
            return {}
        if not 0 < length <= NEWS_BYTES:
            raise foreign(self.name)
        try:
            found = parse_json(slots.values.view(np.uint8)[:length].tobytes())
        except ValueError:
            raise foreign(self.name) from None
        return dict(found) if isinstance(found, dict) else {}

    def _taken(self, slots: Slots | None, timeout_s: float) -> Slots:
        if slots is None:
            raise SnapshotError(f"the reader of '{self.name}' was closed")
        if not slots.take(timeout_s):
            raise SnapshotError(f"'{self.name}': no whole estimate in {timeout_s} s")
        return slots

    def __enter__(self) -> SnapshotReader:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __del__(self) -> None:
        if hasattr(self, "_estimate"):
            self.close()
