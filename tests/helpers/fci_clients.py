"""The vendor's own clients in processes of their own, and the simulated robot for them.

Run as a script, this file is such a client: `fci_clients.py PROTOCOL ACTION...` does one thing
after the other with panda-python (5) or pylibfranka (10) and prints what it saw of each as JSON.

A shared machine takes the processor away from a client now and then. The robot then ends the
motion, rightly: after 20 ms at once, else because the next command lies too far from where it
went on by itself. Such an action is repeated, and how often is said; a robot at fault fails each.
"""

from __future__ import annotations

import contextlib
import fcntl
import importlib.util
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve()
PACKAGES = {5: "panda_py", 10: "pylibfranka"}
PORT = 1337  # the clients know no other
PORT_S, READY_S, CLIENT_S = 240.0, 120.0, 120.0
PATIENCE_S = 1.0  # of the robot with a client that the machine holds up
LATE_ONCE_S = 0.3
LATE_S, LONGEST_GAP_MS = 3e-3, 1000
DAMPING = np.array([4.0, 4.0, 4.0, 4.0, 0.5, 0.5, 0.1])  # N m s/rad


def demand(protocol: int) -> None:
    """Skip the test where the client is not installed, which CI must have."""
    import pytest

    package = PACKAGES[protocol]
    if importlib.util.find_spec(package) is None:
        assert not os.environ.get("CI"), f"CI needs {package}"
        pytest.skip(f"{package} is not installed")


@contextlib.contextmanager
def robot(protocol: int, *faults: str, patience_s: float = PATIENCE_S, more: tuple[str, ...] = ()):
    """A simulated robot on the port that the clients know, with more of its options; one at a time
    on a machine.

    Yields a function that ends the robot and returns its summary.
    """
    with tempfile.TemporaryDirectory() as folder, _port_to_ourselves():
        summary = Path(folder) / "summary.json"
        options = [word for fault in faults for word in ("--fault", fault)]
        command = [
            sys.executable, "-m", "adapter", "sim", "fci", "--protocol", str(protocol),
            "--seed", "3", "--json", str(summary), "--patience", str(patience_s), *options, *more,
        ]  # fmt: skip
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=HERE.parents[2])
        try:
            ready = f"ready: a simulated arm on fci://127.0.0.1 (protocol {protocol})"
            started = any(line.strip() == ready for line in process.stdout)
            assert started, f"the simulated robot did not start: exit {process.wait()}"

            def end() -> dict:
                process.terminate()
                process.communicate(timeout=READY_S)
                assert process.returncode == 0
                return json.loads(summary.read_text("utf-8"))

            yield end
        finally:
            process.kill()
            process.communicate()


def client(protocol: int, *actions: str) -> dict[str, dict]:
    """What a client saw, by what it did, in this order.

    An action that failed has "failed" and one that was held up each time "held up", with what
    the client was told; all others have "repeats", how often they were held up before.
    """
    command = [sys.executable, str(HERE), str(protocol), *actions]
    done = subprocess.run(command, capture_output=True, text=True, timeout=CLIENT_S)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@contextlib.contextmanager
def _port_to_ourselves():
    """Wait until no other test run uses the port."""
    path = Path(tempfile.gettempdir()) / "simulated-fci-port.lock"
    end = time.monotonic() + PORT_S
    with path.open("w") as lock:
        while True:
            with contextlib.suppress(BlockingIOError):
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            assert time.monotonic() < end, f"{path} is held by another test run"
            time.sleep(0.2)
        yield


class Watch:
    """Whether a client was held up in a motion: states or milliseconds went by unseen."""

    def __init__(self) -> None:
        self.late, self._last = False, (0, 0.0)

    def look(self, now_ms: int) -> None:
        """Once for each state of a motion, which shows this time."""
        before_ms, before_s = self._last
        self._last = now_ms, time.monotonic()
        if 0 < now_ms - before_ms < LONGEST_GAP_MS:  # else another motion
            self.late = self.late or now_ms > before_ms + 1 or self._last[1] - before_s > LATE_S


class Connected:
    """A connection by one of the vendor's libraries, which are much alike."""

    def __init__(self, lib) -> None:
        self.watch, self.lib = Watch(), lib
        self.robot = lib.Robot("127.0.0.1", lib.RealtimeConfig.kIgnore)

    def state(self):
        return self.robot.read_once()


class Panda(Connected):
    """panda-python's Robot."""

    def __init__(self) -> None:
        super().__init__(importlib.import_module("panda_py").libfranka)

    def millisecond(self, state) -> int:
        return state.time.to_msec()

    def ids(self, count: int) -> list[int]:
        found: list[int] = []

        def look(state) -> bool:
            found.append(self.millisecond(state))
            return len(found) < count

        self.robot.read(look)
        return found

    def torques(self, count: int, law) -> list[int]:
        """A torque motion: law(k, state) -> torques (7,)."""
        found: list[int] = []

        def control(state, _period):
            found.append(self.millisecond(state))
            tau = self.lib.Torques([float(x) for x in law(len(found), state)])
            return self.lib.motion_finished(tau) if len(found) >= count else tau

        self.robot.control(control, False, 1000.0)  # neither rate limit nor low pass
        return found

    def joints(self, count: int, law) -> None:
        """A motion by joint positions: law(ms since, q at the start) -> positions (7,)."""
        start: list[tuple[int, np.ndarray]] = []

        def control(state, _period):
            now = self.millisecond(state)
            self.watch.look(now)
            if not start:
                start.append((now, np.array(state.q_d)))
            k = now - start[0][0] + 1
            x = self.lib.JointPositions([float(v) for v in law(min(k, count), start[0][1])])
            return self.lib.motion_finished(x) if k > count else x

        mode = self.lib.ControllerMode.kJointImpedance
        self.robot.control_joint_position(control, mode, False, 1000.0)


class FR3(Connected):
    """pylibfranka's Robot."""

    def __init__(self) -> None:
        super().__init__(importlib.import_module("pylibfranka"))

    def millisecond(self, state) -> int:
        return round(1000 * state.time.to_sec())

    def ids(self, count: int) -> list[int]:
        return [self.millisecond(self.state()) for _ in range(count)]

    def torques(self, count: int, law) -> list[int]:
        control, found = self.robot.start_torque_control(), []
        for k in range(1, count + 1):
            state, _ = control.readOnce()
            found.append(self.millisecond(state))
            tau = self.lib.Torques([float(x) for x in law(k, state)])
            tau.motion_finished = k == count
            control.writeOnce(tau)
        return found

    def joints(self, count: int, law) -> None:
        control = self.robot.start_joint_position_control(self.lib.ControllerMode.JointImpedance)
        start, k = None, 0
        while k <= count:  # by the robot's time: a state that was missed shall not slow it down
            state, _ = control.readOnce()
            now = self.millisecond(state)
            self.watch.look(now)
            start = start or (now, np.array(state.q_d))
            k = now - start[0] + 1
            x = self.lib.JointPositions([float(v) for v in law(min(k, count), start[1])])
            x.motion_finished = k > count
            control.writeOnce(x)


def swing(k: int, state) -> np.ndarray:
    """Small torques to and fro, damped; once late, which a patient robot waits for."""
    if k == 500:
        time.sleep(LATE_ONCE_S)
    return 0.025 * DAMPING * np.sin(k / 200) - DAMPING * np.array(state.dq)


def hold(k: int, state) -> np.ndarray:
    """Damping alone."""
    return -DAMPING * np.array(state.dq)


def step(k: int, state) -> np.ndarray:
    """5 N m at once on joint 1."""
    return np.array([5.0 * (k > 50), 0, 0, 0, 0, 0, 0])


def pause(k: int, state) -> np.ndarray:
    """A client that leaves the robot without an answer."""
    if k == 50:
        time.sleep(PATIENCE_S + 0.5)
    return hold(k, state)


def arc(k: int, q: np.ndarray) -> np.ndarray:
    """Joints 1 and 4 by 0.2 rad and back in 2 s."""
    return q + 0.1 * (1 - np.cos(np.pi * k / 1000)) * np.array([1, 0, 0, 1, 0, 0, 0])


def too_far(k: int, q: np.ndarray) -> np.ndarray:
    """A first position that is not where the robot stands."""
    return q + 0.1


def jerky(k: int, q: np.ndarray) -> np.ndarray:
    """Joint 7 at 0.5 rad/s all of a sudden."""
    return q + 5e-4 * max(k - 50, 0) * np.array([0, 0, 0, 0, 0, 0, 1])


def _failure(what) -> str:
    try:
        what()
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


def provoke(arm, what) -> dict:
    """An error, a motion that is refused, recovery, a motion that is not."""
    out = {"error": _failure(what)}
    out["mode"], out["flags"] = str(arm.state().robot_mode), str(arm.state().current_errors)
    out["refused"] = _failure(lambda: arm.torques(100, hold))
    arm.robot.automatic_error_recovery()
    out["again"] = len(arm.torques(100, hold))
    arm.ids(50)  # states that queued up during the recovery are older than its end
    out["mode_after"] = str(arm.state().robot_mode)
    return out


def wait_for_stop(arm) -> dict:
    """The user stop during a motion; a motion while it is pressed, and one when it is not."""
    out = {"error": _failure(lambda: arm.torques(20_000, hold))}
    out["mode"] = str(arm.state().robot_mode)
    out["refused"] = _failure(lambda: arm.torques(100, hold))
    end = time.monotonic() + 60.0
    while "Stop" in str(arm.state().robot_mode) and time.monotonic() < end:
        pass
    out["again"] = len(arm.torques(100, hold))
    return out


def move_joints(arm) -> dict:
    """Where a motion by joint positions led half way and at its end."""
    before = np.array(arm.state().q_d)
    arm.joints(1000, arc)
    middle = np.array(arm.state().q_d)
    arm.joints(2000, lambda k, q: 2 * q - arc(k, q))
    after = np.array(arm.state().q)
    return {"moved": (middle - before).tolist(), "back": (after - middle).tolist()}


def settings(arm) -> dict:
    """What the robot makes of settings, good and bad."""
    robot = arm.robot
    set_ee = getattr(robot, "set_ee", None) or robot.set_EE
    shifted = [*np.eye(4).ravel()[:12], 0.0, 0.0, 0.1, 1.0]
    ball = [1e-3, 0, 0, 0, 1e-3, 0, 0, 0, 1e-3]
    before = arm.state()
    set_ee(shifted)
    robot.set_load(0.5, [0.0, 0.01, 0.05], ball)
    robot.set_joint_impedance([1000.0] * 7)
    robot.set_collision_behavior([30.0] * 7, [40.0] * 7, [30.0] * 6, [40.0] * 6)
    arm.ids(5)
    after = arm.state()
    return {
        "raised": float(after.O_T_EE[14] - before.O_T_EE[14]),
        "upward": float(before.O_T_EE[10]),
        "load": [float(after.m_load), *map(float, after.F_x_Cload), *map(float, after.I_load)],
        "bad_load": _failure(lambda: robot.set_load(-1.0, [0.0] * 3, ball)),
        "bad_frame": _failure(lambda: set_ee([2.0, *shifted[1:]])),
        "stiff": _failure(lambda: robot.set_joint_impedance([15000.0] * 7)),
    }


def model_of_panda() -> dict:
    """Everything that the model library computes, by panda_py.Panda."""
    import panda_py

    model, frames = panda_py.Panda("127.0.0.1").get_model(), panda_py.libfranka.Frame
    rng = np.random.default_rng(8)
    q, dq = rng.uniform(-1, 1, 7).tolist(), rng.uniform(-1, 1, 7).tolist()
    tool = np.eye(4)
    tool[:3, 3] = 0.02, -0.03, 0.1
    pose = tool.ravel("F").tolist()
    none = np.eye(4).ravel().tolist()
    inertia, mass, com = [1e-3, 0, 0, 0, 2e-3, 0, 0, 0, 3e-3], 0.7, [0.01, 0.02, 0.06]
    names = [f"kJoint{k}" for k in range(1, 8)] + ["kFlange", "kEndEffector"]
    chosen = [getattr(frames, name) for name in names]
    return {
        "q": q, "dq": dq, "tool": tool.tolist(), "load": [mass, com, inertia],
        "mass": model.mass(q, inertia, mass, com),
        "coriolis": model.coriolis(q, dq, inertia, mass, com),
        "gravity": model.gravity(q, mass, com, [0.0, 0.0, -9.81]),
        "poses": [model.pose(frame, q, pose, none) for frame in chosen],
        "zero": [model.zero_jacobian(frame, q, pose, none) for frame in chosen],
        "body": [model.body_jacobian(frame, q, pose, none) for frame in chosen],
    }  # fmt: skip


def model_of_fr3(arm) -> dict:
    """Gravity and mass by the URDF that the robot sent."""
    model, state = arm.robot.load_model(), arm.state()
    return {
        "q": list(map(float, state.q)),
        "gravity": list(map(float, model.gravity(state))),
        "mass": list(map(float, np.ravel(model.mass(state)))),
    }


ACTIONS = {
    "read": lambda arm: {"ids": arm.ids(1000)},
    "torque": lambda arm: {"ids": arm.torques(1000, swing)},
    "step": lambda arm: provoke(arm, lambda: arm.torques(500, step)),
    "pause": lambda arm: provoke(arm, lambda: arm.torques(500, pause)),
    "too_far": lambda arm: provoke(arm, lambda: arm.joints(500, too_far)),
    "jerky": lambda arm: provoke(arm, lambda: arm.joints(500, jerky)),
    "tripped": lambda arm: provoke(arm, lambda: arm.torques(20_000, hold)),
    "user_stop": wait_for_stop,
    "joints": move_joints,
    "settings": settings,
    "fr3_model": model_of_fr3,
}
SILENT = "communication_constraints_violation"
TOLD = {  # what each provocation has to be told
    "step": "controller_torque_discontinuity",
    "pause": SILENT,
    "too_far": "joint_position_motion_generator_start_pose_invalid",
    "jerky": "joint_motion_generator_velocity_discontinuity",
    "tripped": "cartesian_reflex",
    "user_stop": "User Stop",
}
ATTEMPTS = 3


def held_up(error: str) -> bool:
    """Whether a motion ended because commands came too late."""
    share = re.search(r"control_command_success_rate: ([\d.]+)", error)
    return SILENT in error or (share is not None and float(share[1]) < 1.0)


def carry_out(arm, action: str) -> dict:
    """One action, again where the machine held it up; see `client`."""
    for repeats in range(ATTEMPTS):
        arm.watch.late = False
        try:
            seen = ACTIONS[action](arm)
            error = seen.get("error", "")
            if TOLD.get(action, "") in error:
                return {**seen, "repeats": repeats}
        except Exception as raised:
            error = f"{type(raised).__name__}: {raised}"
        if not (arm.watch.late or held_up(error)):
            return {"failed": error}
        _failure(arm.robot.automatic_error_recovery)
    return {"held up": error}


def connected(kind):
    """A client; the robot takes a moment to notice that the one before is gone."""
    while True:
        try:
            return kind()
        except Exception:
            time.sleep(0.1)


def main() -> None:
    """All actions of one client."""
    kind, actions = {5: Panda, 10: FR3}[int(sys.argv[1])], sys.argv[2:]
    found = {}
    if "connect" in actions:
        found["connect"] = {"error": _failure(kind)}
    if "panda_model" in actions:  # makes its own connection, and the robot takes one at a time
        found["panda_model"] = model_of_panda()
    rest = [action for action in actions if action in ACTIONS]
    if rest:
        arm = connected(kind)
        found |= {action: carry_out(arm, action) for action in rest}
    print(json.dumps(found))


if __name__ == "__main__":
    main()
