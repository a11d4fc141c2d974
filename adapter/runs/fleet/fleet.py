"""A fleet: recordings are found, their moments taken or known already, and arms learned."""

from __future__ import annotations

import csv
import glob
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from adapter.errors import SettingsError
from adapter.model import model_file
from adapter.model.self_model import SelfModel
from adapter.runs.fleet.arm import FleetArm, learn_arm
from adapter.runs.fleet.engine import here, in_threads, on_cluster
from adapter.runs.fleet.moments import (
    Broken,
    LogMoments,
    Task,
    content_of,
    moments_of,
    opened,
)
from adapter.runs.fleet.store import Store
from drivers.files.names import RECORDINGS, is_recording

LOG_COLUMNS, ARM_COLUMN = ("log", "path", "file"), "arm"
BY = ("log", "folder")


class Manifest(NamedTuple):
    """What a table tells of recordings, by the path as it stands there.

    Attributes:
        arms: names of arms.
        told: numbers by column (temperature, age, ...).
    """

    arms: Mapping[str, str]
    told: Mapping[str, Mapping[str, float]]


class Settings(NamedTuple):
    """How a fleet is learned.

    Attributes:
        folder: of the store; what it holds joins what is given.
        workers: processes of this machine; 0: this one alone.
        cluster: address of a Dask scheduler, None for this machine.
        by: "log": logs tell their arm; "folder": those of one folder are of one arm.
        manifest: goes before both.
        topic: of the joint states.
        progress: called with recordings done, and how many there are.
    """

    folder: Path
    workers: int = 2
    cluster: str | None = None
    by: str = "log"
    manifest: Manifest = Manifest({}, {})
    topic: str | None = None
    progress: Callable[[int, int], None] = lambda done, whole: None


@dataclass(frozen=True, eq=False)
class Fleet:
    """What a fleet found.

    Attributes:
        arms: by name.
        broken: recordings that could not be used.
        read: how many recordings were read for this; known: whose moments were there already.
        forgotten: given, and left out as they were asked to be.
        alike: (path, path) of recordings with the same content, which count once.
    """

    arms: tuple[FleetArm, ...]
    broken: tuple[Broken, ...]
    read: int
    known: int
    forgotten: tuple[str, ...]
    alike: tuple[tuple[str, str], ...]


def found_logs(given: Iterable[str]) -> list[str]:
    """Recordings of files, folders (with those inside them), patterns and addresses.

    Raises:
        SettingsError: one of them is no recording and has none.
    """
    found: list[str] = []
    for text in given:
        inside = list(_behind(text)) if "://" in text else list(_on_disk(text))
        if not inside:
            listed = ", ".join(RECORDINGS)
            raise SettingsError(f"{text}: no recording there (a file, or {listed} in a folder)")
        found += inside
    return list(dict.fromkeys(found))


def _on_disk(text: str) -> Iterator[str]:
    named = (
        [Path(text)] if Path(text).exists() else sorted(map(Path, glob.glob(text, recursive=True)))
    )
    for path in named:
        if path.is_dir() and not (path / "metadata.yaml").is_file():
            inside = sorted(x for x in path.rglob("*") if is_recording(x))
            bags = {x for x in inside if x.is_dir()}
            yield from (str(x.resolve()) for x in inside if not bags & set(x.parents))
        else:
            yield str(path.resolve())


def _behind(address: str) -> Iterator[str]:
    filesystem, inside = opened(address)
    scheme = address.partition("://")[0]
    if any(sign in inside for sign in "*?["):
        names = filesystem.glob(inside)
    else:
        names = filesystem.find(inside) if filesystem.isdir(inside) else [inside]
        names = [x for x in names if x == inside or is_recording(Path(x))]
    yield from (f"{scheme}://{name}" for name in sorted(names))


def read_manifest(path: Path) -> Manifest:
    """A CSV table with a column `log` (or path, file), and `arm` or numbers by column.

    Raises:
        SettingsError: it has no such column, or tells of a log twice.
    """
    with path.open(newline="", encoding="utf-8-sig") as file:
        reader = csv.DictReader(file)
        columns = list(reader.fieldnames or ())
        key = next((x for x in columns if x.strip().lower() in LOG_COLUMNS), None)
        if key is None:
            raise SettingsError(
                f"{path}: needs a column named one of {', '.join(LOG_COLUMNS)}; has: "
                f"{', '.join(columns) or 'nothing'}"
            )
        arms: dict[str, str] = {}
        told: dict[str, dict[str, float]] = {}
        for number, row in enumerate(reader, start=2):
            log = _resolved((row[key] or "").strip(), path.parent)
            if log in told:
                raise SettingsError(f"{path}, line {number}: tells of {log} a second time")
            told[log] = {}
            for name, text in row.items():
                if name is None or name == key or not (text or "").strip():
                    continue
                if name.strip().lower() == ARM_COLUMN:
                    arms[log] = text.strip()
                else:
                    _number(told[log], name.strip(), text)
    return Manifest(arms, told)


def _number(into: dict[str, float], name: str, text: str) -> None:
    """Keep it where it is one; words (an operator's name) say nothing that can be fitted."""
    try:
        into[name] = float(text)
    except ValueError:
        return


def _resolved(text: str, folder: Path) -> str:
    return text if "://" in text else str((folder / text).resolve())


def learn_fleet(given: Sequence[str], documented: SelfModel, settings: Settings) -> Fleet:
    """Learn one model per arm from these recordings and those that the store knows.

    Args:
        given: as `found_logs` returns them.
        documented: what all arms are documented to be.
        settings: how.
    """
    model = model_file.dumps(documented)
    store = Store(settings.folder, model)
    tasks = [Task(path, model, settings.topic) for path in given]
    broken: list[Broken] = []
    contents = _contents(store, tasks, settings, broken)
    first: dict[str, Task] = {}
    alike = []
    for task in tasks:
        if task.path not in contents:
            continue
        content = contents[task.path]
        if content in first:
            alike.append((task.path, first[content].path))
        first.setdefault(content, task)
    left = [task for content, task in first.items() if not store.has(content)]
    for number, (_, result) in enumerate(_taken(left, settings), start=1):
        if isinstance(result, LogMoments):
            store.add(result)
        else:
            broken.append(result)
        settings.progress(number, len(left))
    gone = tuple(task.path for content, task in first.items() if store.forgotten(content))
    known = store.all()
    arms = _arms(known, documented, settings)
    read = len(left) - sum(1 for x in broken if x.path in {task.path for task in left})
    return Fleet(arms, tuple(broken), read, len(known) - read, gone, tuple(alike))


def forget(given: Sequence[str], documented: SelfModel, settings: Settings) -> None:
    """Leave recordings out of the store from here on."""
    model = model_file.dumps(documented)
    store, broken = Store(settings.folder, model), list[Broken]()
    tasks = [Task(path, model, settings.topic) for path in given]
    store.forget(_contents(store, tasks, settings, broken).values())
    if broken:
        raise SettingsError(f"{broken[0].path}: cannot be forgotten: {broken[0].why}")


def _contents(
    store: Store, tasks: Sequence[Task], settings: Settings, broken: list[Broken]
) -> dict[str, str]:
    """Content by path; only what has changed since it was seen is read."""
    found = {task.path: store.content_seen(task.path) for task in tasks}
    unseen = [task for task in tasks if found[task.path] is None]
    if settings.cluster is None:
        results = in_threads(content_of, unseen)
    else:
        results = on_cluster(content_of, unseen, settings.cluster)
    for task, result in results if unseen else ():
        if isinstance(result, Broken):
            broken.append(result)
        else:
            found[task.path] = result
    contents = {path: content for path, content in found.items() if content is not None}
    store.remember(contents)
    return contents


def _taken(tasks: Sequence[Task], settings: Settings) -> Iterator[tuple[Task, LogMoments | Broken]]:
    if not tasks:
        return iter(())
    if settings.cluster is not None:
        return on_cluster(moments_of, tasks, settings.cluster)
    if not settings.workers or len(tasks) == 1:
        return ((task, moments_of(task)) for task in tasks)
    return here(moments_of, tasks, settings.workers)


def _arms(
    known: Sequence[LogMoments], documented: SelfModel, settings: Settings
) -> tuple[FleetArm, ...]:
    groups: dict[str, list[LogMoments]] = {}
    for log in known:
        groups.setdefault(_arm_of(log, documented, settings), []).append(log)
    told = {x.content: settings.manifest.told.get(x.path, {}) for x in known}
    return tuple(learn_arm(name, groups[name], documented, told) for name in sorted(groups))


def _arm_of(log: LogMoments, documented: SelfModel, settings: Settings) -> str:
    if log.path in settings.manifest.arms:
        return settings.manifest.arms[log.path]
    if settings.by == "folder":
        return Path(log.path).parent.name
    return log.arm or documented.name
