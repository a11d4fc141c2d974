"""Processes beside the loop: started clean, watched, ended through their own handle alone."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from typing import Any

from drivers.interface import DriverError

# One thread per worker: libraries that bring a pool of their own read this when they are loaded.
ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMBA")}
START_TIMEOUT_S = 180.0  # a first start compiles
STALL_S = 30.0  # a worker that does nothing for so long at the end is given up
KILL_WAIT_S = 5.0
POLL_S = 0.05
IDLE_S = 1e-3  # a worker without work looks again after so long
ROWS_AT_ONCE = 16  # records between two looks at the clock
READY, DONE, FAILED, REFUSED = "ready", "done", "failed", "refused"

Body = Callable[["Port"], Any]


class WorkerError(RuntimeError):
    """A worker could not start; the message says why."""


class Port:
    """A worker's side: says that it is ready, learns whether the loop's process still lives."""

    def __init__(self, connection: Connection, parent: int) -> None:
        self._connection, self._parent = connection, parent

    def ready(self) -> None:
        """The loop may begin."""
        self._connection.send((READY, None))

    @property
    def orphaned(self) -> bool:
        """The process that started this one is gone."""
        return os.getppid() != self._parent


def main(connection: Connection, parent: int, cores: set[int], nice: int, body: Body) -> None:
    """What a worker process runs: `body`, and its result or its error back through the pipe."""
    # Ctrl-C and `kill` reach the whole process group; a worker ends when the loop says so.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    with suppress(OSError):  # only wishes; the loop reports its own grants
        os.sched_setaffinity(0, cores)
        os.nice(nice)
    port = Port(connection, parent)
    try:
        answer = DONE, body(port)
    except DriverError as error:
        answer = REFUSED, str(error)
    except Exception:
        answer = FAILED, traceback.format_exc()
    with suppress(BrokenPipeError, ConnectionResetError):  # nobody may be left to hear it
        connection.send(answer)
    connection.close()


class Worker:
    """The loop's side of a worker process.

    Args:
        name: for messages.
        body: what it does; picklable, by name. Takes the `Port`, returns the result.
        cores: where it may run.
        nice: how much it yields.

    Attributes:
        trouble: why it ended without a result, or None.
        result: what it returned.
        mortal: it failed in a way that a successor need not: it died or had an error, and was
            not refused what it needs, nor given up.
    """

    def __init__(self, name: str, body: Body, cores: set[int], nice: int = 0) -> None:
        self.name = name
        self.trouble: str | None = None
        self.result: Any = None
        self.mortal = False
        self._is_ready = False
        self._finished = False
        context = multiprocessing.get_context("spawn")
        self._connection, there = context.Pipe()
        arguments = (there, os.getpid(), cores, nice, body)
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
        if kind == READY:
            self._is_ready = True
            return
        if kind == REFUSED:
            raise DriverError(value)
        raise WorkerError(f"the {self.name} could not start: {value}")

    def finish(
        self,
        progress: Callable[[], int],
        stall_s: float = STALL_S,
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
        if kind == READY:  # nobody waited for it
            self._is_ready = True
            self.finish(progress, stall_s, hurry)
            return
        if kind == DONE:
            self.result = value
        else:
            self.trouble = f"the {self.name} failed: {value}"
            self.mortal = kind == FAILED
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
            return FAILED, f"its process died (exit code {self.process.exitcode})"
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
