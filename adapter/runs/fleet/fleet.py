"""A fleet: recordings are found, moments taken (here, or on a Dask cluster), arms learned."""

from __future__ import annotations

import csv
import glob
import logging
import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path, PurePosixPath
from threading import Thread
from typing import Any, NamedTuple, TypeVar

from adapter import optional
from adapter.errors import MeansError, SettingsError
from adapter.model import model_file
from adapter.model.self_model import SelfModel
from adapter.runs.fleet.arm import FleetArm, learn_arm
from adapter.runs.fleet.moments import (
    Broken,
    LogMoments,
    Store,
    Task,
    content_of,
    mark_of,
    moments_of,
    opened,
)
from adapter.signals.told import AS_RECORDED, Told
from drivers.files.names import RECORDINGS, is_recording
from drivers.files.ros_types import JOINT_TRAJECTORY

LOG_COLUMNS, ARM_COLUMN = ("log", "path", "file"), "arm"
Found = TypeVar("Found")


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
        topic: of the joint states; told: how all tell joints and efforts, gains not learned.
        progress: called with recordings done, and how many there are.
    """

    folder: Path
    workers: int = 2
    cluster: str | None = None
    by: str = "log"
    manifest: Manifest = Manifest({}, {})
    topic: str | None = None
    told: Told = AS_RECORDED
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
        plans: motions of somebody's design, which are no recordings.
    """

    arms: tuple[FleetArm, ...]
    broken: tuple[Broken, ...]
    read: int
    known: int
    forgotten: tuple[str, ...]
    alike: tuple[tuple[str, str], ...]
    plans: tuple[str, ...] = ()


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
    if any(sign in inside for sign in "*?["):
        names = filesystem.glob(inside)
    elif filesystem.isdir(inside):
        files = filesystem.find(inside)
        bags = {str(PurePosixPath(x).parent) for x in files if x.endswith("/metadata.yaml")}
        loose = [x for x in files if is_recording(Path(x))]
        parents = {x: {str(y) for y in PurePosixPath(x).parents} for x in loose}
        names = [*bags, *(x for x in loose if not bags & parents[x])]
    else:
        names = [inside] if filesystem.exists(inside) else []
    yield from (str(filesystem.unstrip_protocol(name)) for name in sorted(names))


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
            has = f"{', '.join(LOG_COLUMNS)}; has: {', '.join(columns) or 'nothing'}"
            raise SettingsError(f"{path}: needs a column named one of {has}")
        arms: dict[str, str] = {}
        told: dict[str, dict[str, float]] = {}
        for number, row in enumerate(reader, start=2):
            log = (row[key] or "").strip()
            log = log if _is_address(log) else str((path.parent / log).resolve())
            if log in told:
                raise SettingsError(f"{path}, line {number}: tells of {log} a second time")
            told[log] = {}
            for name, text in row.items():
                if name is None or name == key or not (text or "").strip():
                    continue
                if name.strip().lower() == ARM_COLUMN:
                    arms[log] = text.strip()
                else:
                    # words (an operator's name) say nothing that can be fitted
                    with suppress(ValueError):
                        told[log][name.strip()] = float(text)
    return Manifest(arms, told)


def learn_fleet(given: Sequence[str], documented: SelfModel, settings: Settings) -> Fleet:
    """Learn one model per arm from these recordings and those that the store knows.

    Args:
        given: as `found_logs` returns them.
        documented: what all arms are documented to be.
        settings: how.

    Raises:
        SettingsError: the model's base floats.
    """
    if documented.tree.floating:
        said = f"that of {documented.name} floats"
        raise SettingsError(f"a fleet is of arms whose base stands; {said}")
    model = model_file.dumps(documented)
    store = _store(documented, settings)
    tasks = [Task(path, model, settings.topic, settings.told) for path in dict.fromkeys(given)]
    work = _Work(store, {task.path: mark_of(task.path) for task in tasks})
    work.look_up(tasks, settings)
    left = work.left(tasks)
    settings.progress(0, len(left))
    for number, (task, result) in enumerate(_done(moments_of, left, settings), start=1):
        if isinstance(result, LogMoments):
            if not store.has(result.content):
                store.add(result)
            work.found(task.path, result.content)
        else:
            work.broken.append(result)
        settings.progress(number, len(left))
    places = {**store.places(), **{content: path for path, content in work.contents.items()}}
    # by the places where they were read: what has moved since is still what it grew from
    heads = [replace(x, path=places.get(x.content, x.path)) for x in _newest(store.heads())]
    read = len(left) - sum(x.path in {task.path for task in left} for x in work.broken)
    gone = tuple(path for path, content in work.contents.items() if store.forgotten(content))
    arms = _arms(store, heads, documented, settings)
    plans = tuple(x.path for x in work.broken if f"(1 {JOINT_TRAJECTORY})" in x.why)
    broken = tuple(x for x in work.broken if x.path not in plans)
    return Fleet(arms, broken, read, len(heads) - read, gone, work.alike(tasks), plans)


def _store(documented: SelfModel, settings: Settings) -> Store:
    """Of the moments of recordings that are so understood."""
    told = "" if settings.told == AS_RECORDED else repr(settings.told)
    return Store(settings.folder, model_file.dumps(documented) + told)


class _Work:
    """What is known of given recordings: `contents` by path, `broken` ones, what is left to do.

    Args:
        store: of the fleet; marks: of the recordings by path, as they were before all reading.
    """

    def __init__(self, store: Store, marks: Mapping[str, str]) -> None:
        self._store, self._marks = store, marks
        self.contents: dict[str, str] = {}
        self.broken: list[Broken] = []

    def found(self, path: str, content: str) -> None:
        """Keep what a recording's content is."""
        self.contents[path] = content
        self._store.remember(path, self._marks[path], content)

    def look_up(self, tasks: Sequence[Task], settings: Settings, remote: bool = False) -> None:
        """Find contents; only what has changed since it was seen is read.

        What lies behind an address is fetched once, for its moments, unless `remote`.
        """
        unseen = []
        for task in tasks:
            content = self._store.content_seen(task.path, self._marks[task.path])
            if content is not None:
                self.contents[task.path] = content
            elif remote or not _is_address(task.path):
                unseen.append(task)
        for task, result in _done(content_of, unseen, settings):
            if isinstance(result, Broken):
                self.broken.append(result)
            else:
                self.found(task.path, result)

    def left(self, tasks: Sequence[Task]) -> list[Task]:
        """Those that have to be read, of each content one."""
        first: dict[str, Task] = {}
        without = {x.path for x in self.broken}
        for task in tasks:
            if task.path not in without:
                first.setdefault(self.contents.get(task.path, task.path), task)
        return [task for content, task in first.items() if not self._store.has(content)]

    def alike(self, tasks: Sequence[Task]) -> tuple[tuple[str, str], ...]:
        """(path, path) of recordings whose content is that of one before."""
        first: dict[str, str] = {}
        contents = [(x.path, self.contents[x.path]) for x in tasks if x.path in self.contents]
        pairs = [(path, first.setdefault(content, path)) for path, content in contents]
        return tuple((path, other) for path, other in pairs if path != other)


def forget(
    given: Sequence[str], documented: SelfModel, settings: Settings, back: bool = False
) -> None:
    """Leave recordings out of the store from here on; or take that `back`, to be read again.

    Args:
        given: paths that the store knows, though they may be gone by now, or what `found_logs`
            takes.

    Raises:
        SettingsError: one of them is neither.
    """
    store = _store(documented, settings)
    known: dict[str, set[str]] = {}
    for content, path in [*((x.content, x.path) for x in store.heads()), *store.places().items()]:
        known.setdefault(path, set()).add(content)
    found, unknown = set[str](), list[str]()
    for text in given:
        path = text if _is_address(text) else str(Path(text).resolve())
        found |= known.get(path, set())
        unknown += [] if path in known else [text]
    tasks = [Task(path, "", settings.topic) for path in found_logs(unknown)]
    work = _Work(store, {task.path: mark_of(task.path) for task in tasks})
    work.look_up(tasks, settings, remote=True)
    if work.broken:
        raise SettingsError(f"{work.broken[0].path}: cannot be looked at: {work.broken[0].why}")
    (store.recall if back else store.forget)(found | set(work.contents.values()))


def _is_address(path: str) -> bool:
    return "://" in path


def _done(
    function: Callable[[Task], Found | Broken], tasks: Sequence[Task], settings: Settings
) -> Iterator[tuple[Task, Found | Broken]]:
    """Results of tasks as they are ready; what waits for disks is done by threads."""
    if not tasks:
        return iter(())
    if settings.cluster is not None:
        return on_cluster(function, tasks, settings.cluster)
    if function is content_of:
        with ThreadPoolExecutor() as pool:
            return zip(tasks, list(pool.map(function, tasks)), strict=True)
    if not settings.workers:
        return ((task, function(task)) for task in tasks)
    return here(function, tasks, settings.workers)


def _newest(heads: Sequence[LogMoments]) -> list[LogMoments]:
    """Without what a recording was while it still grew: same place and begin, a shorter span."""
    longest: dict[tuple[str, float], LogMoments] = {}
    for head in heads:
        key = head.path, head.begin_s
        if key not in longest or head.span_s > longest[key].span_s:
            longest[key] = head
    return sorted(longest.values(), key=lambda x: x.content)


def _arms(
    store: Store, heads: Sequence[LogMoments], documented: SelfModel, settings: Settings
) -> tuple[FleetArm, ...]:
    """One after the other, so that no more than the moments of one are in memory."""
    groups: dict[str, list[LogMoments]] = {}
    for head in heads:
        name = settings.manifest.arms.get(head.path)
        if name is None:
            by_folder = settings.by == "folder"
            name = Path(head.path).parent.name if by_folder else head.arm or documented.name
        groups.setdefault(name, []).append(head)
    told = {x.content: settings.manifest.told.get(x.path, {}) for x in heads}
    found = []
    for name in sorted(groups):
        places = {x.content: x.path for x in groups[name]}
        logs = [replace(x, path=places[x.content]) for x in store.whole(groups[name])]
        if logs:
            found.append(learn_arm(name, logs, documented, told))
    return tuple(found)


Result = TypeVar("Result")
Done = Iterator[tuple[Task, Result | Broken]]
TRIES = 2  # of a task whose process died, in a process of its own
AT_HAND = 2  # tasks of each process: one that it does, and the next
ANSWER_S, WORKER_S = 10.0, 60.0  # until nobody is there; until no worker is


def here(function: Callable[[Task], Result], tasks: Sequence[Task], workers: int) -> Done[Result]:
    """Do tasks in processes of this machine; results come as they are ready.

    A process that dies takes what its neighbours were doing with it. Each of these few tasks is
    done again in a process of its own, which shows whose fault it was; the others go on.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # of the processes: they share the processors
    left = deque(tasks)
    while left:
        suspects = yield from _together(function, left, min(workers, len(left)))
        for task in suspects:
            yield task, _alone(function, task)


def _together(
    function: Callable[[Task], Result], left: deque[Task], workers: int
) -> Generator[tuple[Task, Result], None, list[Task]]:
    """Do tasks from the left until none is left or a process dies; those that it leaves undone."""
    asked: dict[Future[Result], Task] = {}
    undone: list[Task] = []
    with _processes(workers) as pool:
        while (left and not undone) or asked:
            while left and not undone and len(asked) < AT_HAND * workers:
                task = left.popleft()
                try:
                    asked[pool.submit(function, task)] = task
                except BrokenProcessPool:
                    undone.append(task)
            for future in wait(asked, return_when=FIRST_COMPLETED).done:
                task = asked.pop(future)
                try:
                    result = future.result()
                except BrokenProcessPool:
                    undone.append(task)
                else:
                    yield task, result
    return undone


def _alone(function: Callable[[Task], Result], task: Task) -> Result | Broken:
    """Do a task in a process of its own."""
    for _ in range(TRIES):
        with _processes(1) as pool:
            try:
                return pool.submit(function, task).result()
            except BrokenProcessPool:
                continue
    return Broken(task.path, f"the process that read it died, {TRIES + 1} times")


def _processes(count: int) -> ProcessPoolExecutor:
    """Copies of a process that has loaded everything and runs no threads, whose locks they had."""
    forks = "forkserver" in multiprocessing.get_all_start_methods()
    context = multiprocessing.get_context("forkserver" if forks else "spawn")
    if forks:
        context.set_forkserver_preload(["adapter.runs.fleet.moments"])
    return ProcessPoolExecutor(count, mp_context=context, initializer=_end_with_parent)


def _end_with_parent() -> None:
    """Let this process end when the one that asked for it has died without a word."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(1)

    Thread(target=watch, daemon=True).start()


def on_cluster(
    function: Callable[[Task], Result], tasks: Sequence[Task], address: str
) -> Done[Result]:
    """Send tasks to the Dask scheduler at an address; results come as they are ready.

    Its workers must have this package, and see the recordings under the same paths. A worker that
    dies costs time: the scheduler gives its tasks to others.

    Raises:
        MeansError: Dask is not installed, nobody answers at the address, nobody works there, or
            the scheduler was lost; what came before is done.
    """
    distributed = optional.load("distributed")
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters is said here
    left = dict.fromkeys(tasks)
    for number in range(3):  # a scheduler that is lost again and again
        try:
            client = distributed.Client(address, timeout=ANSWER_S)
        except (OSError, ValueError, ImportError) as error:
            if number:
                break
            raise MeansError(f"--cluster {address}: no Dask scheduler there ({error})") from None
        with client:
            try:
                client.wait_for_workers(1, timeout=WORKER_S)
            except TimeoutError:
                raise MeansError(f"--cluster {address}: no worker in {WORKER_S:.0f} s") from None
            for task, result in _sent(function, list(left), client, distributed):
                del left[task]
                yield task, result
        if not left:
            return
    raise MeansError(
        f"--cluster {address}: the scheduler was lost; the same command goes on from what is done"
    )


def _sent(
    function: Callable[[Task], Result], tasks: Sequence[Task], client: Any, distributed: Any
) -> Done[Result]:
    """Keep some tasks with the scheduler until all are done, or it is lost."""
    left = iter(tasks)

    def send(task: Task) -> Any:
        future = client.submit(function, task, pure=False)
        asked[future] = task
        return future

    asked: dict[Any, Task] = {}
    waiting = distributed.as_completed([send(task) for task in islice(left, 1000)])  # at once
    for future in waiting:
        task = asked.pop(future)
        if future.status == "finished":
            yield task, future.result()
        elif future.status == "error":
            yield task, Broken(task.path, f"the cluster gave it up: {future.exception()}")
        else:  # the scheduler is gone, and all that it knew
            return
        future.release()
        for following in islice(left, 1):
            waiting.add(send(following))
