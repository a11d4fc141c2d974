"""Requests and replies one after the other: what happens before and after the ticks."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TypeVar

import can

from drivers.damiao import codec
from drivers.damiao.bus import Wire, message_for
from drivers.damiao.codec import Scales, State, WireError
from drivers.damiao.settings import BusSettings
from drivers.damiao.tables import COMMUNICATION_LOST, DISABLED, ENABLED, fault_of
from drivers.interface import DriverError

REPLY_TIMEOUT_S, TRIES = 0.05, 4
NAP_S = 0.0002

T = TypeVar("T")


class Dialogue:
    """Asks motors, waits for their replies, asks again where none comes.

    Args:
        wire: open bus.
        settings: of it.

    Attributes:
        echoes: the bus hands back what was sent on it.
    """

    def __init__(self, wire: Wire, settings: BusSettings) -> None:
        self._wire, self._settings = wire, settings
        self.echoes = False

    def ask(
        self, requests: Sequence[tuple[int, bytes]], parse: Callable[[int, bytes | bytearray], T]
    ) -> list[T]:
        """Send one request to each motor until each has replied.

        Args:
            requests: (id, data) for each motor, in their order.
            parse: reads the data of motor j's reply; WireError refuses it.

        Raises:
            DriverError: motors stay silent (named), or the bus fails.
        """
        index = {can_id: j for j, can_id in enumerate(self._settings.reply_ids)}
        replies: dict[int, T] = {}
        for attempt in range(TRIES):
            for j, (can_id, data) in enumerate(requests):
                if j not in replies:
                    self.send(can_id, data)
            end, over = time.monotonic() + REPLY_TIMEOUT_S, False
            while len(replies) < len(requests) and not over:
                over = time.monotonic() >= end  # what came while this process was held up counts
                self._take(index, replies, parse)
            if len(replies) == len(requests):
                if attempt:  # a first reply may come after the second's and be taken for another
                    time.sleep(REPLY_TIMEOUT_S)
                    self._take(index, {}, parse)
                return [replies[j] for j in range(len(requests))]
        if not replies:
            raise DriverError(
                f"no motor answers on {self._settings.channel}: check power, cable, terminators, "
                f"bit rates and whether the motors speak {'CAN FD' if self._settings.fd else 'CAN'}"
                f" ({'?fd=0' if self._settings.fd else '?fd=1'} for the other)"
            )
        silent = [j for j in range(len(requests)) if j not in replies]
        names = ", ".join(f"{j + 1} (id 0x{self._settings.ids[j]:02x})" for j in silent)
        many = len(silent) > 1
        raise DriverError(
            f"motor{'s' * many} {names} do{'es' * (not many)} not answer; check power, cable and "
            f"id (first_id={self._settings.first_id}, joints={self._settings.joints})"
        )

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame now. Raises DriverError."""
        try:
            self._wire.bus.send(message_for(self._settings, can_id, data), timeout=0.1)
        except (can.CanError, OSError) as error:
            raise DriverError(f"{self._settings.channel}: cannot send: {error}") from error

    def _take(
        self,
        index: dict[int, int],
        replies: dict[int, T],
        parse: Callable[[int, bytes | bytearray], T],
    ) -> None:
        try:
            frames = self._wire.waiting()
        except (can.CanError, OSError) as error:
            raise DriverError(f"{self._settings.channel}: cannot receive: {error}") from error
        if not frames:
            time.sleep(NAP_S)
        for can_id, data, _, kind in frames:
            j = index.get(can_id)
            if kind or j is None:
                self.echoes = self.echoes or can_id == codec.SERVICE_ID
                continue
            try:
                replies.setdefault(j, parse(j, data))
            except WireError:
                continue  # somebody else asked for this one

    def register(self, register: int) -> list[float]:
        """The register's value in every motor. Raises DriverError."""
        ids = self._settings.ids
        return self.ask(
            [(codec.SERVICE_ID, codec.read_register(can_id, register)) for can_id in ids],
            lambda j, data: codec.register_reply(data, ids[j], codec.READ, register),
        )

    def write(self, register: int, value: float) -> None:
        """Set the register in every motor, in memory only. Raises DriverError."""
        ids = self._settings.ids
        said = self.ask(
            [(codec.SERVICE_ID, codec.write_register(can_id, register, value)) for can_id in ids],
            lambda j, data: codec.register_reply(data, ids[j], codec.WRITE, register),
        )
        for can_id, got in zip(ids, said, strict=True):
            if got != value:
                raise DriverError(
                    f"motor {can_id} did not take {value:g} in register {register}, it has {got:g}"
                )

    def limits(self) -> list[Scales]:
        """PMAX, VMAX and TMAX of every motor. Raises DriverError for values that cannot be."""
        columns = [self.register(number) for number in (codec.PMAX, codec.VMAX, codec.TMAX)]
        found = []
        for can_id, values in zip(self._settings.ids, zip(*columns, strict=True), strict=True):
            try:
                limits = Scales(*values)
            except WireError as error:
                raise DriverError(f"motor {can_id}: {error}; check registers 21 to 23") from error
            if max(values) > 1000.0:  # rad, rad/s, N m: no motor's register says more
                raise DriverError(f"motor {can_id} says {limits}; check registers 21 to 23")
            found.append(limits)
        return found

    def states(
        self, limits: Sequence[Scales], requests: Sequence[tuple[int, bytes]]
    ) -> list[State]:
        """What the motors reply to requests that are answered by a state. Raises DriverError."""
        ids = self._settings.ids

        def parse(j: int, data: bytes | bytearray) -> State:
            found = codec.state(limits[j], data)
            if found.motor != ids[j] & 0xF:
                raise WireError("another motor's number")
            return found

        return self.ask(requests, parse)

    def refresh(self, limits: Sequence[Scales]) -> list[State]:
        """All motors' states, nothing commanded. Raises DriverError."""
        ids = self._settings.ids
        return self.states(limits, [(codec.SERVICE_ID, codec.refresh(k)) for k in ids])

    def enable(self, limits: Sequence[Scales]) -> list[State]:
        """Enable the motors that are not. Raises DriverError, naming faults and what to do."""
        found = self.refresh(limits)
        for j, now in enumerate(found):
            if now.status == COMMUNICATION_LOST:  # a former run's end, nothing broken
                self.send(self._settings.ids[j], codec.CLEAR_ERROR)
        self.need_health(self.refresh(limits))
        for _ in range(TRIES):
            found = self.refresh(limits)
            asleep = [j for j, now in enumerate(found) if now.status == DISABLED]
            if not asleep:
                break
            for j in asleep:
                self.send(self._settings.ids[j], codec.ENABLE)
        self.need_health(found)
        for j, now in enumerate(found):
            if now.status != ENABLED:
                raise DriverError(
                    f"motor {j + 1} (id 0x{self._settings.ids[j]:02x}) stays disabled; check its "
                    "supply and whether an emergency stop is pressed"
                )
        return found

    def need_health(self, states: Sequence[State]) -> None:
        """Raises DriverError where a motor reports a fault."""
        for j, now in enumerate(states):
            fault = fault_of(now.status)
            if fault is not None:
                raise DriverError(fault_sentence(j, self._settings.ids[j], now.status))


def fault_sentence(j: int, can_id: int, status: int) -> str:
    """What a motor in a fault is said to have."""
    fault = fault_of(status)
    assert fault is not None
    return (
        f"motor {j + 1} (id 0x{can_id:02x}) reports {fault.name} (status {status:X}): "
        f"{fault.advice}"
    )
