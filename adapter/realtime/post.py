"""A worker's post: who holds it, and who follows when the holder dies."""

from __future__ import annotations

from collections.abc import Callable

from adapter.realtime.nurse import Birth, Nurse
from adapter.realtime.worker import POLL_S, Worker

RESTARTS = 3  # successors of a worker; a fourth death is no accident


class Post:
    """Holds one worker after the other.

    Args:
        name: of the worker, for messages.
        build: starts worker number k = 0, 1, ...
        nurse: starts those that follow.
        restarts: how many may follow.
        tell: takes a sentence on each that died.
        lost: what it means for the run when nobody follows.

    Attributes:
        restarts: how many followed.
        worker: the holder, None while there is none.
    """

    def __init__(
        self,
        name: str,
        build: Callable[[int], Worker],
        nurse: Nurse,
        restarts: int,
        tell: Callable[[str], None],
        lost: str,
    ) -> None:
        self.name, self.restarts = name, 0
        self._build, self._nurse, self._most = build, nurse, restarts
        self._tell, self._lost = tell, lost
        self._birth: Birth | None = None
        self._births: list[Birth] = []
        self.worker: Worker | None = build(0)

    @property
    def held(self) -> bool:
        """Somebody works here, or will soon."""
        return self.worker is not None or self._birth is not None

    def look_after(self) -> None:
        """Notice a death and have a successor started; never waits."""
        if self._birth is not None:
            self._welcome(self._birth)
        elif self.worker is not None and not self.worker.alive:
            worker, self.worker = self.worker, None
            worker.finish(lambda: 0, stall_s=0.0)
            self._succeed(worker)

    def finish(self, progress: Callable[[], int], hurry: Callable[[], bool]) -> Worker | None:
        """Wait for the end of the work, whoever does it; the worker that did, or None."""
        while self.held:
            if self._birth is not None:
                self._await(self._birth, hurry)
                continue
            worker = self.worker
            assert worker is not None
            worker.finish(progress, hurry=hurry)
            if worker.trouble is None:
                return worker
            self.worker = None
            self._succeed(worker)
        return None

    def kill(self) -> None:
        """End whoever works here, once the nurse is gone; may be called more than once."""
        for worker in (self.worker, *(birth.worker for birth in self._births)):
            if worker is not None:
                worker.kill()

    def _succeed(self, worker: Worker) -> None:
        trouble = worker.trouble or f"the {self.name} ended early"
        if worker.mortal and self.restarts < self._most:
            self.restarts += 1
            k = self.restarts
            self._tell(f"{trouble}; a new one starts ({k} of {self._most})")
            self._birth = self._nurse.ask(lambda: self._build(k))
            self._births.append(self._birth)
        else:
            self._tell(f"{trouble}; {self._lost}")

    def _await(self, birth: Birth, hurry: Callable[[], bool]) -> None:
        while not birth.wait(POLL_S):
            if hurry():
                self._birth = None
                self._tell(f"nobody waited for a new {self.name}; {self._lost}")
                return
        self._welcome(birth)

    def _welcome(self, birth: Birth) -> None:
        if not birth.over:
            return
        self._birth, self.worker = None, birth.worker
        if birth.worker is None:
            self._tell(f"a new {self.name} could not start: {birth.trouble}; {self._lost}")
