"""Where a fleet's tasks are done: processes of this machine, or a Dask cluster that is there."""

from __future__ import annotations

import importlib
import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

from adapter.errors import MeansError
from adapter.runs.fleet.moments import Broken, Task

Result = TypeVar("Result")
ROUNDS = 3  # how often a task is tried whose process died
ANSWER_S = 5.0  # until nobody is there
DIED = f"the process that read it died, {ROUNDS} times"


def here(
    function: Callable[[Task], Result], tasks: Sequence[Task], workers: int
) -> Iterator[tuple[Task, Result | Broken]]:
    """Do tasks in processes of this machine; results come as they are ready.

    A process that dies takes its task and those of its neighbours with it; these are done again,
    in the last round each in a process of its own.
    """
    left = list(tasks)
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # of the processes: they share the processors
    for number in range(ROUNDS):
        if not left:
            return
        alone = number == ROUNDS - 1
        again: list[Task] = []
        for group in [[x] for x in left] if alone else [left]:
            for task, result in _round(function, group, min(workers, len(group))):
                if isinstance(result, BrokenProcessPool):
                    again.append(task)
                else:
                    yield task, result
        left = again
    for task in left:
        yield task, Broken(task.path, DIED)


def in_threads(
    function: Callable[[Task], Result], tasks: Sequence[Task]
) -> Iterator[tuple[Task, Result]]:
    """Do tasks that wait for disks rather than compute in threads of this process, in order."""
    with ThreadPoolExecutor() as pool:
        yield from zip(tasks, pool.map(function, tasks), strict=True)


def _round(
    function: Callable[[Task], Result], tasks: Sequence[Task], workers: int
) -> Iterator[tuple[Task, Result | BrokenProcessPool]]:
    spawn = multiprocessing.get_context("spawn")  # a fork would copy threads' locks
    with ProcessPoolExecutor(workers, mp_context=spawn) as pool:
        asked = {pool.submit(function, task): task for task in tasks}
        for future in as_completed(asked):
            try:
                yield asked[future], future.result()
            except BrokenProcessPool as error:
                yield asked[future], error


def on_cluster(
    function: Callable[[Task], Result], tasks: Sequence[Task], address: str
) -> Iterator[tuple[Task, Result | Broken]]:
    """Send tasks to the Dask scheduler at an address; results come as they are ready.

    Its workers must have this package, and see the recordings under the same paths. A worker that
    dies costs time: the scheduler gives its tasks to others.

    Raises:
        MeansError: Dask is not installed, or nobody answers at the address.
    """
    try:
        distributed = importlib.import_module("distributed")
    except ImportError:
        raise MeansError(
            "--cluster needs Dask distributed: pip install 'panda-adapter[cluster]'"
        ) from None
    try:
        client = distributed.Client(address, timeout=ANSWER_S)
    except (OSError, ValueError, ImportError) as error:
        raise MeansError(f"--cluster {address}: no Dask scheduler there ({error})") from None
    with client:
        asked: dict[Any, Task] = dict(
            zip(client.map(function, tasks, pure=False), tasks, strict=True)
        )
        for future in distributed.as_completed(list(asked)):
            task = asked.pop(future)
            if future.status == "finished":
                yield task, future.result()
            else:
                yield task, Broken(task.path, f"the cluster gave it up: {future.exception()}")
            future.release()
