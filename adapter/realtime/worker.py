"""Processes beside the loop: started clean, watched, followed by another where they die.

A process is ended through its own handle alone.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from enum import StrEnum
from multiprocessing.connection import Connection
from typing import Any

from adapter.errors import MeansError
from drivers.interface import DriverError

# One thread per worker: libraries that bring a pool of their own read this when they are loaded.
ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMBA")}
START_TIMEOUT_S = 180.0  # a first start compiles
KILL_WAIT_S = 5.0
POLL_S = 0.05
IDLE_S = 1e-3  # a worker without work looks again after so long
ROWS_AT_ONCE = 16  # records between two looks at the clock

Task = Callable[["Port"], Any]
RESTARTS = 3  # successors of a worker; a fourth death is no accident


class Answer(StrEnum):
    """What comes back from a worker process."""

    READY = "ready"
    DONE = "done"
    FAILED = "failed"
    REFUSED = "refused"


class WorkerError(MeansError):
    """A worker could not start; the message says why."""


class Port:
    """A worker's side: says that it is ready, learns whether the loop's process still lives."""

    def __init__(self, connection: Connection, parent: int) -> None:
        self._connection, self._parent = connection, parent

    def ready(self) -> None:
        """The loop may begin."""
        self._connection.send((Answer.READY, None))

    @property
    def orphaned(self) -> bool:
        """The process that started this one is gone."""
        return os.getppid() != self._parent


def main(connection: Connection, parent: int, cores: set[int], nice: int, task: Task) -> None:
    """What a worker process runs: `task`, and its result or its error back through the pipe."""
    # Ctrl-C and `kill` reach the whole process group; a worker ends when the loop says so.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    with suppress(OSError):  # only wishes; the loop reports its own grants
        os.sched_setaffinity(0, cores)
        os.nice(nice)
    port = Port(connection, parent)
    try:
        answer = Answer.DONE, task(port)
    except DriverError as error:
        answer = Answer.REFUSED, str(error)
    except Exception:
        answer = Answer.FAILED, traceback.format_exc()
    with suppress(BrokenPipeError, ConnectionResetError):  # nobody may be left to hear it
        connection.send(answer)
    connection.close()


class Worker:
    """The loop's side of a worker process.

    Args:
        name: for messages.
        task: what it does; picklable, by name. Takes the `Port`, returns the result.
        cores: where it may run.
        nice: how much it yields.

    Attributes:
        trouble: why it ended without a result, or None.
        result: what it returned.
        replaceable: it died or had an error, which a successor need not; it was not refused what
            it needs, nor given up.
    """

    def __init__(self, name: str, task: Task, cores: set[int], nice: int = 0) -> None:
        self.name = name
        self.trouble: str | None = None
        self.result: Any = None
        self.replaceable = False
        self._is_ready = False
        self._finished = False
        context = multiprocessing.get_context("spawn")
        self._connection, there = context.Pipe()
        arguments = (there, os.getpid(), cores, nice, task)
        self.process = context.Process(target=main, args=arguments, name=name, daemon=True)
        with _environment(ONE_THREAD):
            self.process.start()
        there.close()

    @property
    def alive(self) -> bool:
        """Whether it runs."""
        return self.process.is_alive()

    def wait_ready(
        self, timeout_s: float = START_TIMEOUT_S, cancelled: Callable[[], bool] = lambda: False
    ) -> None:
        """Wait until it says that it is ready.

        Raises:
            DriverError: what it has to open cannot be opened.
            WorkerError: it failed, died, took too long, or the wait was cancelled.
        """
        deadline = time.monotonic() + timeout_s
        while not self._connection.poll(POLL_S):
            if cancelled():
                self.kill()
                raise WorkerError("stopped before the start")
            if time.monotonic() > deadline:
                self.kill()
                raise WorkerError(f"the {self.name} was not ready within {timeout_s:.0f} s")
        kind, value = self._receive()
        if kind == Answer.READY:
            self._is_ready = True
            return
        if kind == Answer.REFUSED:
            raise DriverError(value)
        raise WorkerError(f"the {self.name} could not start: {value}")

    def finish(
        self,
        progress: Callable[[], int],
        stall_s: float = 30.0,  # a worker that does nothing for so long at the end is given up
        hurry: Callable[[], bool] = lambda: False,
    ) -> None:
        """Wait for its result as long as `progress` changes; then end it.

        The result is in `result`, or the reason for there being none in `trouble`.
        """
        if self._finished:
            return
        if not self._await_end(progress, stall_s, hurry):
            self.trouble = f"the {self.name} did not come to an end and was stopped"
            self.kill()
            return
        kind, value = self._receive()
        if kind == Answer.READY:  # nobody waited for it
            self._is_ready = True
            self.finish(progress, stall_s, hurry)
            return
        if kind == Answer.DONE:
            self.result = value
        else:
            self.trouble = f"the {self.name} failed: {value}"
            self.replaceable = kind == Answer.FAILED
        self.process.join(KILL_WAIT_S)
        self.kill()

    def _await_end(
        self, progress: Callable[[], int], stall_s: float, hurry: Callable[[], bool]
    ) -> bool:
        """Whether something came through the pipe before it took too long."""
        seen, since = progress(), time.monotonic()
        while not self._connection.poll(POLL_S):
            now, count = time.monotonic(), progress()
            if count != seen:
                seen, since = count, now
            limit_s = stall_s if self._is_ready else max(stall_s, START_TIMEOUT_S)
            if now - since > limit_s or hurry():
                return False
        return True

    def kill(self) -> None:
        """End the process now, whatever it does; may be called more than once."""
        if self._finished:
            return
        self._finished = True
        if self.process.is_alive():
            self.process.kill()
        self.process.join(KILL_WAIT_S)
        self._connection.close()

    def _receive(self) -> tuple[str, Any]:
        try:
            message: tuple[str, Any] = self._connection.recv()
        except (EOFError, OSError):
            self.process.join(KILL_WAIT_S)
            return Answer.FAILED, f"its process died (exit code {self.process.exitcode})"
        return message


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """These environment variables for the time being; a process started meanwhile keeps them."""
    before = {key: os.environ.get(key) for key in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for key, value in before.items():
            if value is None:
                os.environ.pop(key, None)
            else:
                os.environ[key] = value


def worker_starter(cores: set[int]) -> ThreadPoolExecutor:
    """A thread that starts workers: that takes milliseconds, which a tick does not have.

    It stays on `cores`, off the loop's, and takes no priority. To be made before the loop asks for
    its own, so that it inherits none of that.
    """

    def stay() -> None:
        with suppress(OSError):
            os.sched_setaffinity(0, cores)

    starter = ThreadPoolExecutor(1, "worker starter", stay)
    starter.submit(int).result()  # the thread exists from here on
    return starter


class RestartableWorker:
    """A worker that is followed by another when it dies.

    Args:
        name: of the worker, for messages.
        build: starts worker number k = 0, 1, ...
        starter: starts those that follow; most: how many may.
        tell: takes a sentence on each that died; lost: what it means for the run when nobody
            follows.

    Attributes:
        restarts: how many followed.
        worker: the present one, None while there is none.
    """

    def __init__(
        self,
        name: str,
        build: Callable[[int], Worker],
        starter: ThreadPoolExecutor,
        most: int,
        tell: Callable[[str], None],
        lost: str,
    ) -> None:
        self.name, self.restarts = name, 0
        self._build, self._starter, self._most = build, starter, most
        self._tell, self._lost = tell, lost
        self._next: Future[Worker] | None = None  # being started
        self._started: list[Future[Worker]] = []
        self.worker: Worker | None = build(0)

    @property
    def held(self) -> bool:
        """A worker is here, or will be soon."""
        return self.worker is not None or self._next is not None

    def look_after(self) -> None:
        """Notice a death and have a successor started; never waits."""
        if self._next is not None:
            if self._next.done():
                self._take(self._next)
        elif self.worker is not None and not self.worker.alive:
            worker, self.worker = self.worker, None
            worker.finish(lambda: 0, stall_s=0.0)
            self._replace(worker)

    def finish(self, progress: Callable[[], int], hurry: Callable[[], bool]) -> Worker | None:
        """Wait for the end of the work, whoever does it; the worker that did, or None."""
        while self.held:
            if self._next is not None:
                if wait([self._next], POLL_S).done:
                    self._take(self._next)
                elif hurry():
                    self._next = None
                    self._tell(f"nobody waited for a new {self.name}; {self._lost}")
                continue
            worker = self.worker
            assert worker is not None
            worker.finish(progress, hurry=hurry)
            if worker.trouble is None:
                return worker
            self.worker = None
            self._replace(worker)
        return None

    def kill(self) -> None:
        """End every worker started, once the starter is closed; may be called more than once."""
        if self.worker is not None:
            self.worker.kill()
        for future in self._started:
            if future.exception() is None:
                future.result().kill()

    def _replace(self, worker: Worker) -> None:
        trouble = worker.trouble or f"the {self.name} ended early"
        if worker.replaceable and self.restarts < self._most:
            self.restarts += 1
            k = self.restarts
            self._tell(f"{trouble}; a new one starts ({k} of {self._most})")
            self._next = self._starter.submit(self._build, k)
            self._started.append(self._next)
        else:
            self._tell(f"{trouble}; {self._lost}")

    def _take(self, future: Future[Worker]) -> None:
        self._next, error = None, future.exception()
        if error is None:
            self.worker = future.result()
        else:
            why = f"{type(error).__name__}: {error}"
            self._tell(f"a new {self.name} could not start: {why}; {self._lost}")
