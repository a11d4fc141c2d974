"""Where a fleet's tasks are done: processes of this machine, or a Dask cluster that is there."""

from __future__ import annotations

import importlib
import logging
import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from threading import Thread
from typing import Any, TypeVar

from adapter.errors import MeansError
from adapter.runs.fleet.moments import Broken, Task

Result = TypeVar("Result")
Done = Iterator[tuple[Task, Result | Broken]]
TRIES = 2  # of a task whose process died, in a process of its own
AT_HAND = 2  # tasks of each process: one that it does, and the next
ANSWER_S, WORKER_S = 10.0, 60.0  # until nobody is there; until no worker is
CONNECTIONS = 3  # with a scheduler that is lost again and again


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
    """Copies of a process that has loaded everything and runs no threads.

    A copy of this very process would copy its threads' locks; a fresh one loads for seconds.
    """
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
    try:
        distributed = importlib.import_module("distributed")
    except ImportError:
        raise MeansError(
            "--cluster needs Dask distributed: pip install 'panda-adapter[cluster]'"
        ) from None
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters is said here
    left = dict.fromkeys(tasks)
    for number in range(CONNECTIONS):
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
                said = f"--cluster {address}: no worker came in {WORKER_S:.0f} s"
                raise MeansError(said) from None
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
