"""Frames out, frames in, and what happens when the bus refuses: the driver's hot path."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import can

from drivers.damiao import codec
from drivers.damiao.bus import Wire, message_for
from drivers.damiao.inbox import Inbox
from drivers.damiao.settings import BusSettings
from drivers.interface import DriverError

SEND_FAILURES = 20  # ticks in a row in which a frame could not be sent
NAP_S = 0.0002


class Link:
    """One arm's traffic.

    Args:
        wire: open bus.
        settings: of it.
        inbox: takes the replies.
        now_ns, wall_ns: CLOCK_MONOTONIC, and the clock that the bus stamps frames with.

    Attributes:
        inbox: see above.
        asked_ns: when the last requests were sent.
        fresh: there have been requests since whoever reads has set it to false.
    """

    def __init__(
        self,
        wire: Wire,
        settings: BusSettings,
        inbox: Inbox,
        now_ns: Callable[[], int],
        wall_ns: Callable[[], int],
    ) -> None:
        self._wire, self._settings, self.inbox = wire, settings, inbox
        self._now_ns, self._wall_ns = now_ns, wall_ns
        self.asked_ns, self.fresh = 0, False
        self._failed_ticks = 0
        self._commands = [message_for(settings, k, codec.ENABLE) for k in settings.ids]
        self._requests = [
            message_for(settings, codec.SERVICE_ID, codec.refresh(k)) for k in settings.ids
        ]

    def receive(self) -> None:
        """Take all that waits. Raises DriverError, as `Inbox.take`, or where the bus is gone."""
        now_ns = self._now_ns
        looked_ns = now_ns()
        try:
            frames = self._wire.waiting()
        except (can.CanError, OSError) as error:
            raise DriverError(
                f"{self._settings.channel} is gone: {error}; check adapter and interface"
            ) from error
        self.inbox.take(looked_ns, now_ns(), self._wall_ns(), frames, self.asked_ns)

    def ask(self) -> None:
        """Ask all motors for their states. Raises DriverError as `command`."""
        self._send(self._requests)

    def command(self, frames: Sequence[bytes]) -> None:
        """Send each motor its command.

        Raises DriverError where frames could not be sent in `SEND_FAILURES` ticks in a row.
        """
        for message, data in zip(self._commands, frames, strict=True):
            message.data = data  # type: ignore[assignment]  # bytes are copied faster
        self._send(self._commands)

    def rounds(self, count: int, timeout_s: float) -> None:
        """Ask for states and wait for them, several times over. Raises DriverError."""
        for _ in range(count):
            self.ask()
            end = time.monotonic() + timeout_s
            while any(self.inbox.pending) and time.monotonic() < end:
                time.sleep(NAP_S)
                self.receive()

    def motion(self) -> tuple[list[float], list[float]]:
        """(q, dq) of each motor as it said last, rad, rad/s."""
        latest = self.inbox.latest
        return [reading[1] for reading in latest], [reading[2] for reading in latest]

    def _send(self, messages: Sequence[can.Message]) -> None:
        asked_ns, pending, send = self._now_ns(), self.inbox.pending, self._wire.bus.send
        failure: Exception | None = None
        for j, message in enumerate(messages):
            try:
                send(message, 0.0)
            except (can.CanError, OSError) as error:
                failure = error
            else:
                pending[j] += 1
                self.asked_ns, self.fresh = asked_ns, True
        if failure is None:
            self._failed_ticks = 0
        else:
            self._fail(failure)

    def _fail(self, failure: Exception) -> None:
        self._failed_ticks += 1
        where = self._settings.channel
        if self._failed_ticks > SEND_FAILURES:
            raise DriverError(
                f"{where}: nothing could be sent for {SEND_FAILURES} ticks ({failure}): check "
                "power, cable and terminators; a longer queue helps against bursts (ip link set "
                f"{where} txqueuelen 100)"
            )
        self.inbox.note("send", f"{where}: a frame could not be sent ({failure})")
