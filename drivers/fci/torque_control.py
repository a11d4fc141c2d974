"""One torque-controlled motion after the other: started, fed, watched and ended.

The robot answers Move twice: when the motion starts and when it has ended. In between it sends
its modes with every state and takes one command for each.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from drivers.fci import codec, tables
from drivers.fci.codec import JOINTS, CommandEncoder, State, Status, WireError
from drivers.fci.connect import Channel
from drivers.fci.reader import SLOTS
from drivers.fci.tables import raised, told
from drivers.interface import Array, CommandCount, DriverError, NotReady

START_LIMIT_S = 2.0  # from Move to the running modes
END_LIMIT_S = 0.1  # for the second answer once the modes are left; TCP may hold it back 40 ms
BRAKE_S, EASE_S, FINISH_S, STOP_MOVE_S = 0.3, 0.2, 0.3, 0.5
QUIET_S = 0.1  # without a state for so long, a motion is stopped over TCP
# N m s/rad, damping of a Panda's joints that an ordinary 1 kHz loop keeps stable.
BRAKE_DAMPING = np.array([15.0, 25.0, 8.0, 15.0, 1.2, 1.6, 0.3])

Send = Callable[[bytearray], None]
NextState = Callable[[float], State | None]  # waits at most so many seconds

_IDLE, _STARTING, _RUNNING = "idle", "starting", "running"


class TorqueControl:
    """Torque control over one connection.

    Args:
        version: of the protocol.
        channel: connected.
        send: sends a datagram to the robot.

    Attributes:
        fault: why the last motion ended by itself; None where it did not. Kept until `stop`.
        count: of the commands; holes in ticks of the robot.
        limiter: the limits on what is sent.
    """

    def __init__(self, version: int, channel: Channel, send: Send) -> None:
        self._version, self._channel, self._send = version, channel, send
        self._encoder, self.limiter = CommandEncoder(version), TorqueLimiter()
        self._phase, self._move_id, self._deadline = _IDLE, -1, 0.0
        self._accepted, self._ticks, self._answered = False, 0, -SLOTS
        self._sent_id = self._rates = self._rate_count = 0
        self._rate_sum = 0.0
        self._status: Status | None = None
        self._odd = self._odd_tick = 0  # states in a row that say the motion is over; the last
        self.fault: str | None = None
        self.count = CommandCount()

    @property
    def active(self) -> bool:
        """A motion was asked for and has not ended."""
        return self._phase != _IDLE

    def command(self, tau: Array, state: State, message_id: int, accepted: Array) -> None:
        """Drive with (7,) N m; the first command starts the motion and is kept back itself.

        Args:
            tau: wanted, checked.
            state: read last.
            message_id: of the state to answer, which may be a later one.
            accepted: (7,) what the robot had accepted there, N m.

        Raises:
            DriverError: the motion has ended or cannot be asked for.
        """
        if self.fault is not None:
            raise DriverError(self.fault)
        if self._phase == _IDLE:
            if (mode := state.status.robot_mode) != tables.ROBOT_IDLE:
                raise NotReady(f"no motion: the robot {tables.ROBOT_MODE_MEANING[mode]}")
            payload = codec.move_payload(self._version)
            self._move_id = self._channel.send(tables.MOVE[self._version], payload)
            self._phase, self._accepted = _STARTING, False
            self._deadline = time.monotonic() + START_LIMIT_S
            self.limiter.reset()
            self._answered, self._sent_id, self._rates = -SLOTS, -1, -100
        elif self._phase == _RUNNING:
            self._drive(tau.tolist(), accepted, message_id)

    def _drive(
        self, tau: list[float], accepted: Array, message_id: int, finished: bool = False
    ) -> None:
        """Answer a state, each one once: two steps must not fall into one tick of the robot."""
        if 0 <= self._answered - message_id < SLOTS:
            return
        self._answered = message_id
        allowed = tau if finished else self.limiter.limit(tau, accepted.tolist())
        if allowed is not None:
            self._send(self._encoder.encode(message_id, allowed, finished))
            ticks, count = message_id - self._sent_id, self.count
            if self._sent_id >= 0 and ticks > 1:  # the last one answered no neighbouring tick
                count.holes += 1
                count.longest_hole_ms = max(count.longest_hole_ms, float(ticks))
            self._sent_id = message_id
            count.sent += 1
        self.count.cut = self.limiter.cut

    def _note_rate(self, rate: float) -> None:
        """Count the robot's success rate, once it is about commands of this motion alone."""
        count = self.count
        self._rates += 1
        if self._rates <= 0 or not 0.0 <= rate <= 1.0:
            return
        self._rate_sum += rate
        self._rate_count += 1
        count.success_mean = self._rate_sum / self._rate_count
        count.success_min = rate if count.success_min is None else min(count.success_min, rate)

    def look(self, state: State) -> None:
        """See what a state means for the motion; trouble goes to `fault`."""
        self._ticks += 1
        try:
            if self._phase == _STARTING:
                self._look_at_start(state)
            elif self._phase == _RUNNING:
                self._note_rate(state.success_rate)
                if state.status is not self._status and self._runs(state.status):
                    self._status, self._odd = state.status, 0
                elif state.status is not self._status:
                    self._odd = self._odd + 1 if self._ticks == self._odd_tick + 1 else 1
                    self._odd_tick = self._ticks
                    if self._odd >= 2:  # one may be a damaged datagram
                        self._ended(state)
                elif self._ticks % 100 == 0:
                    self._channel.poll()
                    if self._channel.closed:
                        self._fail("the robot cut the connection; it brakes by itself: see Desk")
        except WireError as error:
            self._fail(f"the robot answers on TCP with {error}: connect again")

    def _runs(self, status: Status) -> bool:
        return (
            status.robot_mode == tables.ROBOT_MOVE
            and status.controller == tables.CONTROLLER_TORQUE
            and status.generator == tables.RUNNING_GENERATOR[self._version]
        )

    def _look_at_start(self, state: State) -> None:
        self._channel.poll()
        reply = self._channel.take(self._move_id)
        if reply is not None:
            name = self._move_status(reply)
            if name != "motion_started" or self._accepted:
                self._fail(f"the robot refused the motion: {tables.meaning(name)}")
                return
            self._accepted = True
        if self._channel.closed:
            self._fail("the robot cut the connection before the motion began: see Desk")
        elif self._accepted and self._runs(state.status):
            self._phase, self._status = _RUNNING, state.status
        elif self._accepted and state.status.robot_mode >= tables.ROBOT_REFLEX:
            self._ended(state)
        elif time.monotonic() > self._deadline:
            self._fail(
                f"the robot did not begin to move within {START_LIMIT_S:.0f} s: look at Desk, "
                "connect again"
            )

    def _move_status(self, payload: bytes) -> str:
        return tables.status_name(tables.MOVE_STATUS[self._version], codec.status_reply(payload))

    def _ended(self, state: State) -> None:
        """The robot left the motion by itself: say why."""
        reply = self._channel.wait(self._move_id, END_LIMIT_S)
        name = "" if reply is None else self._move_status(reply)
        status = state.status
        if status.robot_mode == tables.ROBOT_REFLEX or name == "reflex":
            flags = status.reflex_reason if any(status.reflex_reason) else status.errors
            share = f"{100.0 * state.success_rate:.0f} % of the last commands had arrived"
            self._fail(f"a reflex stopped the arm: {told(flags)}; {share}; recover with ?recover=1")
        elif status.robot_mode == tables.ROBOT_USER_STOP or name == "user_stop":
            self._fail(f"the arm was stopped: {tables.meaning('user_stop')}")
        else:
            why = tables.meaning(name) if name else "it does not say why: look at Desk"
            flags = status.errors if raised(status.errors) else status.reflex_reason
            named = f"; {told(flags)}" if any(flags) else ""
            self._fail(f"the robot ended the motion: {why}{named}")

    def _fail(self, sentence: str) -> None:
        self.fault, self._phase = sentence, _IDLE

    def stop(self, next_state: NextState) -> None:
        """Brake the arm, let its torque go and end the motion; takes a second at most.

        Braking is damping against the measured velocity: the robot carries its weight itself.
        Without states, or if that fails, the motion is ended over TCP.

        Raises:
            DriverError: the robot stopped by a fault of its own meanwhile, or does not say that
                it stopped.
        """
        self.fault = None
        if self._phase == _RUNNING:
            self._brake(next_state)
        if self._phase == _RUNNING:
            self._finish(next_state)
        if self._phase != _IDLE:
            self._stop_move(next_state)
        self._phase = _IDLE
        if self.fault is not None:
            fault, self.fault = self.fault, None
            raise DriverError(f"while stopping: {fault}")

    def _brake(self, next_state: NextState) -> None:
        """Damp until the arm rests, then lower the torque step by step."""
        begin = time.monotonic()
        while time.monotonic() - begin < BRAKE_S + EASE_S:
            state = next_state(QUIET_S)
            if state is None:
                return
            self.look(state)
            if self._phase != _RUNNING:
                return
            moving = np.isfinite(state.dq).all() and np.abs(state.dq).max() > 0.02  # rad/s
            brakes = moving and time.monotonic() - begin < BRAKE_S
            tau = -BRAKE_DAMPING * state.dq if brakes else np.zeros_like(state.dq)
            self._drive(tau.tolist(), state.tau_J_d, state.message_id)
            if not brakes and max(map(abs, self.limiter.last)) < TORQUE_STEP:
                return

    def _finish(self, next_state: NextState) -> None:
        """Repeat the last command with the finish flag until the robot has left the motion."""
        deadline = time.monotonic() + FINISH_S
        while time.monotonic() < deadline:
            state = next_state(QUIET_S)
            if state is None:
                return
            if not self._runs(state.status):
                if state.status.robot_mode in (tables.ROBOT_REFLEX, tables.ROBOT_USER_STOP):
                    self._ended(state)
                else:
                    self._channel.wait(self._move_id, END_LIMIT_S)
                    self._phase = _IDLE
                return
            self._drive(self.limiter.last, state.tau_J_d, state.message_id, finished=True)

    def _stop_move(self, next_state: NextState) -> None:
        """End the motion by request; what cannot be confirmed becomes a fault."""
        unsure = (
            "the robot does not say that it stopped: press its user stop; without commands it "
            "stops by itself after 20 ms"
        )
        try:
            stop_id = self._channel.send(tables.STOP_MOVE[self._version])
            reply = self._channel.wait(stop_id, STOP_MOVE_S)
            if reply is None:
                raise DriverError("it does not answer StopMove")
            number = codec.status_reply(reply)
        except DriverError as error:
            self.fault = f"{unsure} ({error})"
            return
        name = tables.status_name(tables.STOP_STATUS[self._version], number)
        state, deadline = next_state(QUIET_S), time.monotonic() + STOP_MOVE_S
        late = False
        while state is not None and state.status.robot_mode == tables.ROBOT_MOVE and not late:
            late = time.monotonic() > deadline
            state = state if late else next_state(QUIET_S)
        if late or (state is None and name != "success"):
            self.fault = f"{unsure} (StopMove: {tables.meaning(name)})"


# N m, the same for Panda/FER and FR3; Franka FCI documentation, robot limits.
TORQUE_LIMIT = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)
# N m from one command to the next; the robot allows 1 (1000 N m/s at 1 kHz) and stops beyond.
TORQUE_STEP = 0.99

SETTLE_TICKS = 3  # an accepted torque that stays for so long is not on its way to ours
OWN_COMMANDS = 32  # an accepted torque is one of so many that were sent last
STRANGE_TICKS = 3  # a torque that is none of ours is believed when it comes so often in a row


class TorqueLimiter:
    """Keeps commands within the torque and torque rate limits.

    A step counts from the command sent last and from the one that the robot says it accepted
    last, for a step from the wrong one is answered by a reflex. Where these are more than two
    steps apart, commands are still on their way, or they got lost: then nothing goes out until
    the accepted torque comes near or stands still, and in the latter case it is what counts. The
    robot holds its torque meanwhile; it puts up with 20 missing commands.

    Plain floats: for seven joints they take a third of the time of arrays.

    Attributes:
        last: 7 torques, N m, of the last command.
        cut: commands that were changed or kept back.
    """

    def __init__(self) -> None:
        self.last = [0.0] * JOINTS
        self.cut = 0
        self._fresh, self._waited, self._strange = True, 0, 0
        self._seen: list[float] = self.last
        self._accepted: list[float] = self.last
        self._sent: deque[list[float]] = deque(maxlen=OWN_COMMANDS)

    def reset(self) -> None:
        """A new motion begins; its first step counts from what the robot then drives with."""
        self.last, self._fresh = [0.0] * JOINTS, True
        self._waited = self._strange = 0
        self._sent.clear()

    def limit(self, tau: list[float], accepted: list[float]) -> list[float] | None:
        """The command that may go out for a wanted one; None where none should.

        Args:
            tau: 7 torques, N m, wanted, finite.
            accepted: 7 torques, N m, that the robot says it accepted last.
        """
        if self._fresh:
            finite = all(map(math.isfinite, accepted))
            self.last = self._accepted = accepted if finite else self.last
            self._fresh = False
        believed = self._believed(accepted)
        if believed is None:
            self.cut += 1
            return None
        accepted = self._accepted = believed
        both = zip(self.last, accepted, strict=True)
        if any(abs(last - own) > 2.0 * TORQUE_STEP for last, own in both):
            self._waited = self._waited + 1 if accepted == self._seen else 0
            self._seen = accepted
            if self._waited < SETTLE_TICKS:
                self.cut += 1
                return None
            self.last = accepted  # it stands still: it is not on its way to the one sent last
        self._waited = 0
        out = []
        for want, last, own, limit in zip(tau, self.last, accepted, TORQUE_LIMIT, strict=True):
            low, high = max(last, own) - TORQUE_STEP, min(last, own) + TORQUE_STEP
            out.append(min(max(want, low, -limit), high, limit))
        self.cut += out != tau
        self.last = out
        self._sent.append(out)
        return out

    def _believed(self, accepted: list[float]) -> list[float] | None:
        """The torque that the robot drives with: one of ours. None for any other: bits can flip."""
        for known in (self._accepted, *reversed(self._sent)):
            if all(abs(own - other) <= 1e-3 for own, other in zip(accepted, known, strict=True)):
                self._strange = 0
                return known
        self._strange += 1
        if self._strange < STRANGE_TICKS or not all(map(math.isfinite, accepted)):
            return None
        return accepted
