"""Requests and commands out, replies in: decoded, checked, counted. The driver's hot path."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from enum import StrEnum

import can

from drivers.damiao import codec
from drivers.damiao.bus import ERROR_FRAME, UNREADABLE, Frame, Wire, message_for
from drivers.damiao.codec import CODES, FRAME_BYTES, Q_CODES, Scales, temperature
from drivers.damiao.connect import NAP_S, fault_sentence
from drivers.damiao.settings import BusSettings
from drivers.damiao.tables import (
    BUS_OFF,
    DISABLED,
    ENABLED,
    HOT_DEGC,
    WARM_DEGC,
    fault_of,
    troubles_of,
)
from drivers.damiao.timing import NOTHING, ArrivalClock, Reading, at_instant
from drivers.interface import DriverError, Intake

SEND_FAILURES = 20  # ticks in a row in which a frame could not be sent
SILENT_NS = 100_000_000
OWN_ID, STRANGER = -1, -2  # in place of a joint's index

# A motor's alarm is believed when it says so so often, not further apart than this: bits can flip.
ALARMS, ALARM_TICKS = 3, 3


class Refusal(StrEnum):
    """Why a frame is not used."""

    UNREADABLE = "unreadable"
    ERROR_FRAME = "error_frame"
    UNKNOWN_ID = "unknown_id"
    OTHER_HOST = "other_host"
    WRONG_LENGTH = "wrong_length"
    WRONG_MOTOR = "wrong_motor"
    UNASKED = "unasked"
    OUT_OF_ORDER = "out_of_order"
    GUARDIANS = "asked_by_guardian"
    UNCONFIRMED = "unconfirmed_alarm"


class ReplyIntake:
    """Takes replies off a bus.

    Args:
        wire: open bus.
        settings: of it.
        limits: of each motor.
        intake: where to count; `intake` of this, too.
        echoes: the bus hands back what was sent on it.
        driven: the motors are enabled and must stay so.

    Attributes:
        pending: requests to each joint that have no reply yet; the sender adds to it.
        arrived_ns: when the last reply used had arrived, CLOCK_MONOTONIC.
        latest: last reading of each joint.
        clock: for arrivals.
        others_ask: the guardian is commanding the motors; replies to it are not ours.
    """

    def __init__(
        self,
        wire: Wire,
        settings: BusSettings,
        limits: Sequence[Scales],
        intake: Intake,
        echoes: bool,
        driven: bool,
    ) -> None:
        n = settings.joints
        self._wire, self._settings, self.intake = wire, settings, intake
        self._echoes, self._driven = echoes, driven
        self._reply_ns = round(1e3 * settings.budget.reply_us)
        self._reach_ns = 5 * 1_000_000_000 // settings.rate_hz  # of prediction
        self._index = dict.fromkeys([*settings.ids, codec.SERVICE_ID], OWN_ID)
        self._index.update({can_id: j for j, can_id in enumerate(settings.reply_ids)})
        self._scales = [
            tuple(
                part
                for most, top in ((x.q_max, Q_CODES), (x.dq_max, CODES), (x.tau_max, CODES))
                for part in (most, 2 * most / top)
            )
            for x in limits
        ]
        status = ENABLED if driven else DISABLED
        self._heads = [status << 4 | can_id & 0xF for can_id in settings.ids]
        self.pending = [0] * n
        self.latest: list[Reading] = [NOTHING] * n
        self._before: list[Reading] = [NOTHING] * n
        self._missed, self._any_missed = [0] * n, False
        self._alarms, self._alarmed_at = [0] * n, [-ALARM_TICKS - 1] * n
        self._unsettled, self._looks, self._ticks = [0] * n, 0, 0
        self.arrived_ns = 0
        self.others_ask = False
        self.clock = ArrivalClock()

    def take(
        self, looked_ns: int, now_ns: int, wall_ns: int, frames: list[Frame], asked_ns: int
    ) -> None:
        """Look at a batch of frames.

        Args:
            looked_ns: before the bus was looked at; now_ns, wall_ns: after it.
            frames: as `Wire.waiting` gave them.
            asked_ns: when the last requests were sent; no reply was measured before its request.

        Raises:
            DriverError: a motor reports a fault or is hot, three times in a row, or the bus is off.
        """
        clock, intake, index = self.clock, self.intake, self._index
        pending, latest, before = self.pending, self.latest, self._before
        clock.begin(looked_ns, now_ns, wall_ns)
        first_ns, offset_ns, reply_ns = clock.first_ns, clock.offset_ns, self._reply_ns
        heads, scales, last_ns, used = self._heads, self._scales, self.arrived_ns, 0
        for can_id, data, stamp_s, kind in frames:
            j = index.get(can_id, STRANGER)
            if j < 0 or kind:
                self._odd(can_id, data, kind, j)
                continue
            if len(data) != FRAME_BYTES:
                self._refuse(
                    Refusal.WRONG_LENGTH, f"a reply of {len(data)} bytes came; replies have 8"
                )
                continue
            if data[0] != heads[j] and not self._look_at_status(j, data[0]):
                continue
            if pending[j] <= 0:
                why = "a motor replied without having been asked by this driver"
                if self.others_ask:
                    self._refuse(Refusal.GUARDIANS)
                else:
                    self._refuse(Refusal.UNASKED, why)
                continue
            pending[j] -= 1
            arrived_ns = int(1e9 * stamp_s) + offset_ns
            if not first_ns <= arrived_ns <= now_ns:
                arrived_ns = clock.unusual(stamp_s)
            at_ns = arrived_ns - reply_ns
            if at_ns < asked_ns <= arrived_ns:
                at_ns = asked_ns
            old = latest[j]
            if at_ns <= old[0]:
                self._refuse(
                    Refusal.OUT_OF_ORDER, "a reply came with a stamp before the last one's"
                )
                continue
            code_tau = (data[4] & 0xF) << 8 | data[5]
            code_dq = data[3] << 4 | data[4] >> 4
            a, a_step, b, b_step, c, c_step = scales[j]
            before[j] = old
            latest[j] = (
                at_ns,
                (data[1] << 8 | data[2]) * a_step - a,
                code_dq * b_step - b,
                code_tau * c_step - c,
            )
            if data[6] >= WARM_DEGC or data[7] >= WARM_DEGC:
                self._look_at_temperatures(j, data[6], data[7])
            if not (0 < code_tau < CODES and 0 < code_dq < CODES):
                what = "torque" if code_tau in (0, CODES) else "speed"
                self.intake.note(
                    f"end of scale {what} {j}",
                    f"motor {j + 1}: {what} at the end of its scale; the true value may lie beyond",
                )
            if arrived_ns > last_ns:
                last_ns = arrived_ns
            used += 1
        self.arrived_ns = last_ns
        intake.received += used
        intake.used += used
        self._ticks += 1
        if self._ticks % 16 == 0:
            self._settle()

    def sample_at(self, stamp_ns: int) -> tuple[list[float], bool]:
        """(3 n) q, dq and tau of all joints at one instant, and whether all replies are there.

        Raises DriverError, naming it, for a joint that has been silent for `SILENT_NS`.
        """
        values, missing = at_instant(stamp_ns, self._before, self.latest, self._reach_ns)
        if missing:
            silent = []
            for j in missing:
                self._missed[j] += 1
                if self._missed[j] >= 10 and stamp_ns - self.latest[j][0] >= SILENT_NS:
                    silent.append(f"{j + 1} (id 0x{self._settings.ids[j]:02x})")
            if silent:
                raise DriverError(
                    f"motor{'s' * (len(silent) > 1)} {', '.join(silent)} silent for "
                    f"{1e-9 * SILENT_NS:g} s: check power, cable and bus-off"
                )
        elif self._any_missed:
            self._missed = [0] * len(self._missed)
        self._any_missed = bool(missing)
        return values, not missing

    def discard(self) -> None:
        """Throw away what waits: the guardian's replies of a pause, and what came between them."""
        for can_id, _, _, kind in self._wire.waiting():
            j = self._index.get(can_id, STRANGER)
            if j < 0 or kind:
                continue
            self.pending[j] = max(self.pending[j] - 1, 0)
            self._refuse(Refusal.GUARDIANS)

    def finish(self, on_the_way: bool) -> None:
        """Count what is still missing as lost, but for one reply of each joint `on_the_way`."""
        self.intake.lost += sum(max(count - on_the_way, 0) for count in self.pending)
        self.pending = [0] * len(self.pending)

    def _refuse(self, reason: Refusal, sentence: str = "") -> None:
        self.intake.received += 1
        self.intake.refused[reason] += 1
        if sentence:
            self.intake.note(reason, f"{sentence}; it was refused")

    def _odd(self, can_id: int, data: bytes | bytearray, kind: int, j: int) -> None:
        """A frame that is no reply."""
        if kind == ERROR_FRAME:
            self._refuse(Refusal.ERROR_FRAME)
            for trouble in troubles_of(can_id, data, self._settings.channel):
                if can_id & BUS_OFF:
                    raise DriverError(trouble)
                self.intake.note(trouble, trouble)
        elif can_id == UNREADABLE:
            self._refuse(Refusal.UNREADABLE, "a datagram that is no CAN frame came")
        elif j == OWN_ID and not kind:
            if not self._echoes:
                self._refuse(
                    Refusal.OTHER_HOST,
                    f"another program sends to these motors (id 0x{can_id:03x}): end it, two "
                    "cannot drive one arm; its frame is not ours",
                )
        else:
            self._refuse(
                Refusal.UNKNOWN_ID, f"a frame with id 0x{can_id:03x} came, which is no motor's"
            )

    def _look_at_status(self, j: int, head: int) -> bool:
        """Whether a reply with an unusual first byte can be used. Raises DriverError."""
        can_id = self._settings.ids[j]
        if head & 0xF != can_id & 0xF:
            self._refuse(
                Refusal.WRONG_MOTOR,
                f"a reply of motor {j + 1} (id 0x{can_id:02x}) carries another motor's number; "
                "have two motors the same reply id?",
            )
            return False
        status = head >> 4
        if fault_of(status) is not None:
            self._alarm(j, fault_sentence(j, can_id, status))
        elif status == DISABLED and self._driven:
            self._alarm(
                j,
                f"motor {j + 1} (id 0x{can_id:02x}) is disabled: it lost its power, or another "
                "program switched it off; support the arm and connect again",
            )
        else:
            self._heads[j] = head
            return True
        self.pending[j] = max(self.pending[j] - 1, 0)
        self._refuse(Refusal.UNCONFIRMED)
        return False

    def _alarm(self, j: int, sentence: str) -> None:
        """A motor says that something is wrong: believed when its next replies say so too."""
        if self._repeats(j):
            raise DriverError(sentence)

    def _repeats(self, j: int) -> bool:
        """Count an unusual reply of a motor; whether there were as many in a row as it takes."""
        in_a_row = self._ticks - self._alarmed_at[j] <= ALARM_TICKS
        self._alarms[j] = self._alarms[j] + 1 if in_a_row else 1
        self._alarmed_at[j] = self._ticks
        return self._alarms[j] >= ALARMS

    def _look_at_temperatures(self, j: int, mosfet: int, rotor: int) -> None:
        for part, degc in (("MOSFETs", temperature(mosfet)), ("rotor", temperature(rotor))):
            who = f"motor {j + 1} (id 0x{self._settings.ids[j]:02x}): its {part}"
            if degc >= HOT_DEGC and self._driven:
                self._alarm(j, f"{who} are at {degc} deg C; stopped: let it cool")
            elif degc >= WARM_DEGC and self._repeats(j):
                self.intake.note(
                    f"warm {part} {j}",
                    f"{who} are at {degc} deg C; the run ends at {HOT_DEGC}: move less or slower",
                )

    def _settle(self) -> None:
        """A reply that was missing at every look of a window is lost."""
        for j, count in enumerate(self.pending):
            if self._looks == 0 or count < self._unsettled[j]:
                self._unsettled[j] = count
        self._looks += 1
        if self._looks == 8:  # then a missing reply counts as lost
            self._looks = 0
            for j, count in enumerate(self._unsettled):
                if count > 0:
                    self.pending[j] -= count
                    self.intake.lost += count


class MotorStream:
    """One arm's traffic.

    Args:
        wire: open bus.
        settings: of it.
        replies: takes the replies.
        now_ns, wall_ns: CLOCK_MONOTONIC, and the clock that the bus stamps frames with.

    Attributes:
        replies: see above.
        asked_ns: when the last requests were sent.
        fresh: there have been requests since whoever reads has set it to false.
    """

    def __init__(
        self,
        wire: Wire,
        settings: BusSettings,
        replies: ReplyIntake,
        now_ns: Callable[[], int],
        wall_ns: Callable[[], int],
    ) -> None:
        self._wire, self._settings, self.replies = wire, settings, replies
        self._now_ns, self._wall_ns = now_ns, wall_ns
        self.asked_ns, self.fresh = 0, False
        self._failed_ticks = 0
        self._commands = [message_for(settings, k, codec.ENABLE) for k in settings.ids]
        self._requests = [
            message_for(settings, codec.SERVICE_ID, codec.refresh(k)) for k in settings.ids
        ]

    def receive(self) -> None:
        """Take all that waits.

        Raises DriverError, as `ReplyIntake.take`, or where the bus is gone.
        """
        now_ns = self._now_ns
        looked_ns = now_ns()
        try:
            frames = self._wire.waiting()
        except (can.CanError, OSError) as error:
            raise DriverError(
                f"{self._settings.channel} is gone: {error}; check adapter and interface"
            ) from error
        self.replies.take(looked_ns, now_ns(), self._wall_ns(), frames, self.asked_ns)

    def ask(self) -> None:
        """Ask all motors for their states. Raises DriverError as `command`."""
        self._send(self._requests)

    def command(self, frames: Sequence[bytes]) -> bool:
        """Send each motor its command; whether the bus took them all.

        Raises DriverError where frames could not be sent in `SEND_FAILURES` ticks in a row.
        """
        for message, data in zip(self._commands, frames, strict=True):
            message.data = data  # type: ignore[assignment]  # bytes are copied faster
        self._send(self._commands)
        return not self._failed_ticks

    def rounds(self, count: int, timeout_s: float) -> None:
        """Ask for states and wait for them, several times over. Raises DriverError."""
        for _ in range(count):
            self.ask()
            end = time.monotonic() + timeout_s
            while any(self.replies.pending) and time.monotonic() < end:
                time.sleep(NAP_S)
                self.receive()

    def motion(self) -> tuple[list[float], list[float]]:
        """(q, dq) of each motor as it said last, rad, rad/s."""
        latest = self.replies.latest
        return [reading[1] for reading in latest], [reading[2] for reading in latest]

    def _send(self, messages: Sequence[can.Message]) -> None:
        asked_ns, pending, send = self._now_ns(), self.replies.pending, self._wire.bus.send
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
            return
        self._failed_ticks += 1
        where = self._settings.channel
        if self._failed_ticks > SEND_FAILURES:
            raise DriverError(
                f"{where}: nothing could be sent for {SEND_FAILURES} ticks ({failure}): check "
                "power, cable and terminators; a longer queue helps against bursts (ip link set "
                f"{where} txqueuelen 100)"
            )
        self.replies.intake.note("send", f"{where}: a frame could not be sent ({failure})")
