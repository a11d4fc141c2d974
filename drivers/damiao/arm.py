"""A CAN arm of Damiao motors in MIT mode behind the driver's protocol."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence

import can
import numpy as np

from drivers.damiao import codec
from drivers.damiao.bus import Wire, open_bus, wire_of
from drivers.damiao.codec import CODES, MIT_MODE, TIMEOUT_UNIT_S, Scales, mit_command
from drivers.damiao.connect import Dialogue
from drivers.damiao.guardian import GuardianMode
from drivers.damiao.guardian_client import GuardianClient, former_guardian
from drivers.damiao.holding import Braker, brake, settle
from drivers.damiao.settings import VIRTUAL, BusSettings
from drivers.damiao.stream import MotorStream, ReplyIntake
from drivers.damiao.tables import type_of
from drivers.damiao.timing import Reading
from drivers.interface import Array, CommandCount, DriverError, Intake, JointSample

WINDOW = 100  # commands that the worst share is taken over, as a Franka's is


class AnsweredCommands:
    """Counts commands to motors that we set the rhythm of, and their replies.

    A command that reached all motors in time is one that all of them replied to before the next one
    went out; the share is taken over joints, so that one silent motor of seven leaves 6/7. Replies
    carry no number: where one comes a period late and each after it, too, only the first counts as
    missing.

    Args:
        count: where to.
        period_ns: from one command to the next.
    """

    def __init__(self, count: CommandCount, period_ns: int) -> None:
        self._count, self._period_ns = count, period_ns
        self._replied, self._asked, self._full = 0, 0, False
        self.pause()

    def pause(self) -> None:
        """The arm is held, by commands that are not the loop's; the next one begins anew."""
        self._last_ns = self._asked_ns = 0
        self._window: deque[int] = deque(maxlen=WINDOW)
        self._window_sum = 0

    def look(self, latest: Sequence[Reading]) -> None:
        """See who replied to the last command; called before the next one goes out.

        Args:
            latest: last reading of each joint.
        """
        asked_ns, self._asked_ns = self._asked_ns, 0
        if not asked_ns:
            return
        replied = 0
        for reading in latest:
            replied += reading[0] >= asked_ns
        self._replied += replied
        self._asked += len(latest)
        window = self._window
        if len(window) == WINDOW:
            self._window_sum -= window[0]
        window.append(replied)
        self._window_sum += replied
        self._count.success_mean = self._replied / self._asked
        if len(window) == WINDOW:
            rate = self._window_sum / (WINDOW * len(latest))
            least = self._count.success_min if self._full else None
            self._count.success_min = rate if least is None else min(least, rate)
            self._full = True
        elif not self._full:
            self._count.success_min = self._count.success_mean

    def sent(self, asked_ns: int, whole: bool, cut: bool) -> None:
        """A command went out.

        Args:
            asked_ns: when, CLOCK_MONOTONIC.
            whole: to every motor; a command that the bus did not take is none.
            cut: a motor's TMAX changed it.
        """
        count = self._count
        count.cut += cut
        if not whole:
            return
        step_ns = asked_ns - self._last_ns
        if self._last_ns and step_ns >= 1.5 * self._period_ns:  # nearer to the next one's turn
            count.holes += 1
            count.longest_hole_ms = max(count.longest_hole_ms, 1e-6 * step_ns)
        self._last_ns = self._asked_ns = asked_ns
        count.sent += 1


FIRST_ROUNDS, ROUND_TIMEOUT_S = 2, 0.1  # replies that the first sample lies between
# The torque command of each code, with nothing else: q, dq, kp, kd zero. The same for all types.
TORQUE_FRAMES = [
    mit_command(Scales(1.0, 1.0, 1.0))[:6] + code.to_bytes(2, "big") for code in range(CODES + 1)
]


class DamiaoArm:
    """Seven (or so) motors on one CAN bus.

    `read` takes what has arrived and gives the sample of the instant at which its requests were
    sent, one tick ago; without commands it asks for the next states itself. The motors are
    enabled and written to only with leave to move. A stopped arm goes on being held: these
    motors have no brakes, see `drivers.damiao.guardian`.

    Args:
        address: `can://CHANNEL?interface=...`, see `drivers.damiao.settings`.
        joint_names: joint1, joint2, ... where None.
        allow_motion: leave to move.
        bus: open python-can bus to use, not closed here; opened by the address where None.
        now_ns: the clock of stamps, CLOCK_MONOTONIC.
        wall_ns: the clock that the bus stamps frames with.

    Attributes:
        limits: of each motor, as it said itself; empty before `connect`.

    Raises:
        DriverError: the address is wrong, or its frames do not fit on the bus.
    """

    paced = False
    adds_gravity = False

    def __init__(
        self,
        address: str,
        joint_names: Sequence[str] | None = None,
        allow_motion: bool = False,
        bus: can.BusABC | None = None,
        now_ns: Callable[[], int] = time.monotonic_ns,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self.settings = settings = BusSettings.of(address, joint_names)
        self._joints = n = settings.joints
        self.budget = settings.budget
        self.joint_names = tuple(joint_names or (f"joint{j + 1}" for j in range(n)))
        self.link_names = tuple(f"link{j + 1}" for j in range(n))
        self.period_ns = 1_000_000_000 // settings.rate_hz
        self.delay_ns = 5 * self.period_ns // 2  # one old, most of one on the bus, held one
        self.can_move = allow_motion
        self.intake = Intake()
        self.arrived_ns = 0
        self.limits: list[Scales] = []
        self._given_bus, self._now_ns, self._wall_ns = bus, now_ns, wall_ns
        self._bus: can.BusABC | None = None
        self._guardian: GuardianClient | None = None

    def connect(self) -> None:
        """Open the bus, ask the motors who they are; with leave to move, enable and hold them.

        Raises:
            DriverError: bus, motors or guardian are not as they must be; what to do about it.
        """
        if self._bus is not None:
            raise DriverError("this CAN arm is connected already")
        self.intake = Intake()
        self._bus = self._given_bus or open_bus(self.settings)
        self._wire: Wire = wire_of(self._bus)
        try:
            self._get_ready()
        except BaseException:
            self._shut()
            raise

    def _get_ready(self) -> None:
        self._last_ns = 0
        self._commanded = self._driving = False
        self._told: list[float] | None = None
        if self.can_move:
            self.intake.commands = CommandCount()
            self._answered = AnsweredCommands(self.intake.commands, self.period_ns)
        self._wire.waiting()  # what others sent before
        talk = Dialogue(self._wire, self.settings)
        self.limits = talk.limits()
        self._tau_max = [limit.tau_max for limit in self.limits]
        self._carried = [0.0] * self.settings.joints
        self._speed = SpeedCheck(self.joint_names, np.array([x.dq_max for x in self.limits]))
        mode = talk.register(codec.CTRL_MODE)
        if self.can_move:
            self._take_charge(talk, mode)
        else:
            talk.need_health(talk.refresh(self.limits))
        self._replies = replies = ReplyIntake(
            self._wire,
            self.settings,
            self.limits,
            self.intake,
            talk.echoes or (self.settings.guardian and self.settings.interface != VIRTUAL),
            self.can_move,
        )
        self._stream = MotorStream(self._wire, self.settings, replies, self._now_ns, self._wall_ns)
        replies.others_ask = self._guardian is not None
        strange = [j + 1 for j, x in enumerate(self.limits) if type_of(x) == "unknown type"]
        if strange:
            self.intake.note(
                "type",
                f"motors {', '.join(map(str, strange))} scale as no known type does (motor "
                f"{strange[0]}: {self.limits[strange[0] - 1]}); their own registers are used",
            )
        self._say_who_holds()
        self._stream.rounds(FIRST_ROUNDS, ROUND_TIMEOUT_S)
        if self.can_move:
            self._driving = True
            self._beat()
            if self._guardian is not None:  # it watches meanwhile and holds afterwards
                self._guardian.memory.mode = GuardianMode.BRAKE
            hold, self._carried = settle(self._stream, self.limits, self._carried, self._beat)
            self._hand_over(hold)
            self._stream.rounds(FIRST_ROUNDS, ROUND_TIMEOUT_S)

    def _take_charge(self, talk: Dialogue, mode: Sequence[float]) -> None:
        """Enable the motors and hold the arm where it is."""
        self._relieved: int | None = None
        if self.settings.guardian and self.settings.interface != VIRTUAL:
            self._guardian = GuardianClient(self.settings, self.limits, self.joint_names)
        if any(value != MIT_MODE for value in mode):
            talk.write(codec.CTRL_MODE, MIT_MODE)
        if self._guardian is None and any(talk.register(codec.TIMEOUT)):
            talk.write(codec.TIMEOUT, 0)  # nobody feeds it while the loop prepares
        states = talk.enable(self.limits)
        q, dq = [now.q for now in states], [now.dq for now in states]
        self._carried = [now.tau for now in states]
        hold = Braker(self.limits, self._carried, q).commands(0.0, q, dq)
        requests = list(zip(self.settings.ids, hold, strict=True))
        talk.need_health(talk.states(self.limits, requests))
        if self._guardian is not None:
            self._guardian.memory.put(q, dq, self._carried)
            self._guardian.memory.hold(q)
            self._relieved = self._guardian.relieve_former()
            talk.write(codec.TIMEOUT, round(0.5 / TIMEOUT_UNIT_S))  # s, then a motor lets go

    def _hand_over(self, hold: Sequence[float]) -> None:
        """From driving to holding at these angles."""
        self._driving = False
        if self._guardian is not None:
            self._guardian.memory.put(*self._stream.motion(), self._carried)
            self._guardian.memory.hold(hold)
            self._replies.others_ask = True

    def _say_who_holds(self) -> None:
        say = self.intake.note
        if self._guardian is not None:
            pid = self._guardian.pid
            former = f" (it has relieved process {self._relieved})" if self._relieved else ""
            say(
                "guardian",
                f"process {pid}{former} holds the arm whenever this program does not, also after "
                "its end: the motors have no brakes. To let the arm down, support it, then: "
                f"kill {pid}",
            )
        elif self.can_move:
            say(
                "no guardian",
                "no process holds the arm when this program dies: the motors keep their last "
                "command. That suits a simulated arm only",
            )
        elif self.settings.interface != VIRTUAL:
            holder = former_guardian(self.settings)
            if holder is not None:
                self._replies.others_ask = True
                say("held", f"process {holder} holds this arm; this program only listens")

    def read(self) -> JointSample:
        """The sample of the last tick's instant, from what has arrived; returns at once.

        A joint whose reply is missing has its motion predicted for five ticks, its torque is NaN.

        Raises:
            DriverError: a motor is silent, hot or in a fault, or the bus is off or gone.
        """
        self._need_open()
        stream = self._stream
        stream.receive()
        if self._driving:
            self._answered.look(self._replies.latest)
        stamp_ns = stream.asked_ns if stream.fresh else self._now_ns() - self.period_ns
        if stamp_ns <= self._last_ns:
            stamp_ns = self._last_ns + 1
        self._last_ns, stream.fresh = stamp_ns, False
        values, whole = self._replies.sample_at(stamp_ns)
        n = self._joints
        table = np.array(values)
        q, dq, tau = table[:n], table[n : 2 * n], table[2 * n :]
        if whole:
            self._speed.add(stamp_ns, q, dq)
            if self._driving:
                # what the arm must be carried with, here and with the guardian
                pairs = zip(self._carried, values[2 * n :], strict=True)  # a mean over 50 ms
                self._carried = self._told or [old + 0.02 * (new - old) for old, new in pairs]
                if self._guardian is not None:
                    parts = values[:n], values[n : 2 * n], self._carried, values[2 * n :]
                    self._guardian.memory.put(*parts)
        else:
            self._speed.skip()
        self.arrived_ns = self._replies.arrived_ns
        if not self._commanded:
            stream.ask()
        self._commanded = False
        return JointSample(stamp_ns, q, dq, tau)

    def command(self, tau: Array) -> None:
        """Ask for (n,) N m, gravity included; more than a motor's TMAX is cut.

        Raises:
            DriverError: without leave to move, for anything but n finite numbers, or where
                frames could not be sent in 20 ticks in a row.
        """
        self._need_open()
        if not self.can_move:
            raise DriverError("this CAN arm may not be moved; allow motion first")
        self._need_leave()
        frames, cut = torque_frames(tau, self._tau_max)
        if cut:
            self.intake.note("cut", "a torque beyond a motor's TMAX was cut")
        if not self._driving:  # from holding to driving: the guardian's replies are not ours
            if self._guardian is not None:
                self._replies.discard()
                self._beat()
                self._guardian.memory.mode = GuardianMode.DRIVE
            self._answered.pause()
            self._driving, self._replies.others_ask = True, False
        self._beat()
        self._commanded = True
        whole = self._stream.command(frames)
        self._answered.sent(self._stream.asked_ns, whole, cut)

    def carry(self, tau: Array) -> None:
        """What carries the arm here, (n,) N m; a braked arm is carried so, by the guardian too.

        Without it that is the torque measured in the last 50 ms, in which a push is as well.
        """
        if np.isfinite(tau).all():
            self._told = np.asarray(tau, dtype=np.float64).tolist()

    def _need_leave(self) -> None:
        """Raises DriverError where the guardian has forbidden to drive on."""
        push = None if self._guardian is None else self._guardian.memory.forbidden
        if push is not None:
            raise DriverError(
                f"{push.said(self.joint_names[push.joint])}: something holds the arm; the "
                "guardian process has stopped it"
            )

    def stop(self) -> None:
        """Brake a driven arm and hold it where it comes to rest; it goes on being held.

        Raises DriverError where nothing can be sent; the guardian then brakes the arm.
        """
        if self._bus is None or not self._driving:
            return
        self._driving, held = False, "its motors' last command"
        if self._guardian is not None:
            held = "the guardian process"
            self._guardian.memory.mode = GuardianMode.BRAKE
            if not self._guardian.alive:
                gone = "the process that held the arm is gone; start anew"
                self.intake.note("guardian gone", gone)
        self._hand_over(brake(self._stream, self.limits, self._carried, self._beat))
        self.intake.note("stopped", f"the arm was braked and stands; {held} holds it")

    def close(self) -> None:
        """Release the bus; a driven arm is stopped first, and goes on being held."""
        if self._bus is None:
            return
        try:
            self.stop()
        finally:
            self._replies.finish(on_the_way=self._stream.fresh)
            self._shut()

    def _need_open(self) -> None:
        if self._bus is None:
            raise DriverError("the CAN arm is not connected; call connect()")

    def _shut(self) -> None:
        self._wire.close()
        if self._bus is not None and self._given_bus is None:
            self._bus.shutdown()
        self._bus = None
        if self._guardian is not None:
            self._guardian.leave()
            self._guardian = None

    def _beat(self) -> None:
        """Tell the guardian that commands come."""
        if self._guardian is None:
            return
        self._guardian.memory.beat_ns = self._now_ns()
        if self._guardian.memory.taken:
            self.intake.note(
                "taken", "no command came for 50 ms; the guardian braked the arm until the next one"
            )


def torque_frames(tau: Array, tau_max: Sequence[float]) -> tuple[list[bytes], bool]:
    """The MIT commands of (n,) torques, N m, and whether one was cut at its motor's TMAX.

    Raises DriverError for anything but n finite numbers.
    """
    wanted = np.asarray(tau, dtype=np.float64).tolist()
    if not isinstance(wanted, list) or len(wanted) != len(tau_max):
        raise DriverError(f"a command is {len(tau_max)} torques, N m")
    frames, cut = [], False
    for value, most in zip(wanted, tau_max, strict=True):
        if not -most <= value <= most:
            if not math.isfinite(value):
                raise DriverError("a torque to be commanded is not a finite number")
            value, cut = math.copysign(most, value), True
        frames.append(TORQUE_FRAMES[int((value + most) / (most + most) * CODES)])
    return frames, cut


LEAST_WINDOWS, MOST_WINDOWS = 10, 60  # 0.5 s to 3 s of windows
# rad: changes of q are known to a step's 1/sqrt(6), a step being at most 25 rad / 65535
Q_NOISE = 25.0 / 65535 / 6.0**0.5


class SpeedCheck:
    """Whether a motor's speed is the rate of change of its angle; a wrong VMAX shows as a factor.

    Over windows of 50 ms, the integral of dq is fitted against the change of q by a line with an
    offset (codes are truncated, so that dq has a constant error of half a step). The slope is VMAX
    as decoded over VMAX as encoded: 0.8 where a DM4340 is read with another source's table.

    Args:
        joint_names: for the sentence.
        dq_max: (n,) VMAX as read from the motors, rad/s.
    """

    def __init__(self, joint_names: tuple[str, ...], dq_max: Array) -> None:
        self._names, self._dq_max = joint_names, dq_max
        n = len(joint_names)
        self._sum, self._count = np.zeros(n), 0
        self._start_ns, self._start_q, self._start_dq = 0, np.zeros(n), np.zeros(n)
        self._windows = np.zeros((2, MOST_WINDOWS, n))  # change of q, integral of dq
        self._filled = 0

    def add(self, stamp_ns: int, q: Array, dq: Array) -> None:
        """One sample without gaps. Raises DriverError where a speed is clearly off."""
        if self._count:
            self._sum += dq
            self._count += 1
            span_ns = stamp_ns - self._start_ns
            if span_ns < 50_000_000:  # ns
                return
            mean = (self._sum - 0.5 * (self._start_dq + dq)) / (self._count - 1)
            self._windows[:, self._filled] = q - self._start_q, mean * (1e-9 * span_ns)
            self._filled += 1
            if self._filled % LEAST_WINDOWS == 0:
                self._judge(self._filled)
            if self._filled == MOST_WINDOWS:
                self._filled = 0
        self._start_ns, self._start_q, self._start_dq = stamp_ns, q, dq
        self._sum[:] = dq
        self._count = 1

    def skip(self) -> None:
        """A sample with a gap came; the window that it lies in is left out."""
        self._count = 0

    def _judge(self, m: int) -> None:
        change, integral = self._windows[:, :m]
        change = change - change.mean(axis=0)
        integral = integral - integral.mean(axis=0)
        square = np.maximum((change**2).sum(axis=0), 1e-300)
        slope = (change * integral).sum(axis=0) / square
        rest = ((integral - slope * change) ** 2).sum(axis=0)
        deviation = np.sqrt((rest / (m - 2) + Q_NOISE**2) / square)
        fit = 1.0 - rest / np.maximum((integral**2).sum(axis=0), 1e-300)
        off = np.abs(slope - 1.0)
        wrong = (
            (off > 0.1)  # of the slope
            & (off > 6.0 * deviation)  # standard deviations that a wrong slope must lie off
            & (deviation < 0.02)  # standard deviation of a slope that counts
            & (fit > 0.995**2)  # correlation; a stuck encoder is something else
        )
        for j in np.flatnonzero(wrong)[:1]:
            raise DriverError(
                f"{self._names[j]}: its speed is {slope[j]:.2f} times the rate of change of its "
                f"angle; VMAX {self._dq_max[j]:g} rad/s is not what the motor scales with (that "
                f"would be about {self._dq_max[j] / slope[j]:.3g}): check register 22 (VMAX)"
            )
