"""What a fleet has learned so far, on disk: moments by the content of log and model."""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from collections.abc import Iterable
from pathlib import Path

from adapter.model.model_file import whole_file
from adapter.runs.fleet.moments import FORMAT, LogMoments

SEEN, FOLDER, GONE = "seen.json", "moments", ".forgotten"


class Store:
    """Moments of recordings in a folder, each written whole once it is there.

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

    def _read_seen(self) -> dict[str, list[object]]:
        try:
            seen = json.loads(self._seen_file.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}  # it saves reading files again, no more
        return seen if isinstance(seen, dict) else {}

    def content_seen(self, path: str) -> str | None:
        """The content of a file as it was when it was read last, None if it may be another."""
        kept = self._seen.get(path)
        return str(kept[-1]) if kept is not None and kept[:-1] == _stat(path) else None

    def remember(self, contents: dict[str, str]) -> None:
        """Keep contents by path, so that files that do not change are not read again."""
        for path, content in contents.items():
            stat = _stat(path)
            if stat:
                self._seen[path] = [*stat, content]
        with whole_file(self._seen_file) as part:
            part.write_text(json.dumps(self._seen, indent=0), encoding="utf-8")

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

    def all(self) -> list[LogMoments]:
        """All moments, in the order of the recordings' content: a sum is the same to the last bit.

        A file that was damaged is taken away, so that its recording is read again.
        """
        found = []
        for path in sorted(self._folder.glob(f"{self._model}-*.npz")):
            try:
                found.append(LogMoments.load(path))
            except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile):
                path.unlink(missing_ok=True)
        return found


def _stat(path: str) -> list[object]:
    """Size and time of change; of a folder or an address nothing, so that it is looked into."""
    try:
        there = os.stat(path)
    except OSError:
        return []
    return [] if os.path.isdir(path) else [there.st_size, there.st_mtime_ns]
