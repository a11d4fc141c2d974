"""What a fleet has learned so far, on disk: moments by the content of log and model."""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from collections.abc import Iterable
from pathlib import Path

from adapter.runs.fleet.moments import FORMAT, LogMoments, files_of, opened

SEEN, FOLDER, GONE = "seen.jsonl", "moments", ".forgotten"


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
        """Keep the content of a recording, so that it is not read again while it does not change.

        Args:
            mark: as it was before it was read, see `mark_of`.
        """
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
        """All that is known, without the moments themselves, in the order of content.

        What was damaged is taken away, so that its recording is read again.
        """
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
