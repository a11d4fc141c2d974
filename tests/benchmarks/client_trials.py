"""Unmodified clients of a Franka arm at the simulated one, one process a trial: `make trials`.

A trial does what a user's script does, every kind of motion once, with the package's own calls and
nothing else; it passes where the arm and the hand went where they were sent. A shared machine takes
the processor away from a client now and then, and a robot then ends the motion, rightly: such
stalls are counted apart, by the robot's own error (20 commands missing in a row, or a step after
missing ones).
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np

from tests.helpers import fci_clients
from tests.helpers.benchmark import options, write

HOST, THING_M = "127.0.0.1", 0.03
FLOOR_M, PRESS_N = 0.5, 5.0  # what Force presses on, 9 cm below the start
FEEL_M = 0.03  # so far Force may go to feel it: a soft motion ends some mm before its goal
PROTOCOLS = {"panda_py": 5, "franky": 10}
TRIAL_S = 300.0
Kinds = dict[str, Callable[[], None]]


def panda_py_kinds() -> tuple[Kinds, Callable[[], None]]:
    """What is done with panda-python, and how an error is left behind.

    Where nothing is in the way, `Force` with a force ends by its own "Distance threshold exceeded",
    at a real robot as here.
    """
    import panda_py
    from panda_py import controllers, libfranka

    arm = panda_py.Panda(HOST)

    def held(controller: Any, seconds: float, step: Callable[[float], None]) -> None:
        arm.start_controller(controller)
        try:
            with arm.create_context(frequency=200, max_runtime=TRIAL_S) as context:
                while context.ok() and controller.get_time() < seconds:
                    step(controller.get_time())  # the robot's time
        finally:
            arm.stop_controller()

    def start() -> None:
        arm.set_default_behavior()
        assert arm.move_to_start()

    def pose() -> None:
        goal = arm.get_pose()
        goal[:3, 3] += 0.03, 0.02, -0.05
        assert arm.move_to_pose(goal)

    def impedance() -> None:
        control, seen = controllers.CartesianImpedance(), []
        x, turn = arm.get_position(), arm.get_orientation()

        def step(t: float) -> None:
            aside = 0.08 * np.sin(2 * np.pi * t / 3)
            control.set_control(x + np.array([0.0, aside, 0.0]), turn)
            seen.append(arm.get_position()[1] - x[1])

        held(control, 3.0, step)
        assert max(seen) > 0.06 and min(seen) < -0.06, (min(seen), max(seen))

    def velocity() -> None:
        control, before, seen = controllers.IntegratedVelocity(), arm.q[6], []

        def step(t: float) -> None:
            control.set_control(np.array([*np.zeros(6), 0.3 * np.sin(np.pi * t / 2)]))
            seen.append(arm.q[6] - before)

        held(control, 2.0, step)
        assert abs(max(seen) - 0.6 * 2 / np.pi) < 0.03, max(seen)

    def force_in_the_air() -> None:
        control = controllers.Force()
        held(control, 2.0, lambda t: control.set_control(np.zeros(3)))

    def force() -> None:
        goal = arm.get_pose()
        goal[2, 3] = FLOOR_M
        assert arm.move_to_pose(goal)
        control, felt = controllers.Force(threshold=FEEL_M), []

        def step(t: float) -> None:
            control.set_control(np.array([0.0, 0.0, -PRESS_N]))
            felt.append(arm.get_state().O_F_ext_hat_K[2])

        held(control, 4.0, step)
        assert abs(np.mean(felt[-200:]) + PRESS_N) < 2.5, np.mean(felt[-200:])

    def gripper() -> None:
        hand = libfranka.Gripper(HOST)
        assert hand.homing() and hand.move(0.05, 0.1)
        assert abs(hand.read_once().width - 0.05) < 1e-3
        assert hand.grasp(THING_M, 0.1, 20.0) and hand.read_once().is_grasped
        assert hand.stop()

    def impedance_after_force() -> None:
        impedance()

    todo = (start, pose, impedance, velocity, force_in_the_air, force, impedance_after_force)
    return {what.__name__: what for what in (*todo, gripper)}, arm.recover


def franky_kinds() -> tuple[Kinds, Callable[[], None]]:
    """What is done with franky, and how an error is left behind."""
    import franky as f

    arm = f.Robot(HOST, realtime_config=f.RealtimeConfig.Ignore)
    arm.relative_dynamics_factor = 0.1
    home = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]
    relative = f.ReferenceType.Relative

    def place() -> Any:
        return arm.current_cartesian_state.pose.end_effector_pose.translation.copy()

    def went(begun: Any, by: tuple[float, ...], within_m: float = 5e-3) -> None:
        assert np.abs(place() - begun - by).max() < within_m, place() - begun

    def joints() -> None:
        arm.move(f.JointMotion(f.JointState(home)))
        assert np.abs(arm.current_joint_state.position - home).max() < 5e-3

    def pose() -> None:
        begun, by = arm.current_cartesian_state.pose.end_effector_pose, (0.05, 0.03, -0.05)
        goal = f.Affine(begun.translation + by, begun.quaternion)
        arm.move(f.CartesianMotion(goal))
        went(begun.translation, by)
        arm.move(f.CartesianMotion(begun))

    def turn() -> None:
        begun = place()
        for sine in (0.1, -0.1):
            arm.move(f.CartesianMotion(f.Affine([0, 0, 0], [0, 0, sine, 0.995]), relative))
        went(begun, (0.0, 0.0, 0.0))

    def waypoints() -> None:
        begun, steps = place(), ((0.05, 0, 0), (0, 0.05, 0), (-0.05, -0.05, 0))
        arm.move(
            f.CartesianWaypointMotion([f.CartesianWaypoint(f.Affine(x), relative) for x in steps])
        )
        went(begun, (0.0, 0.0, 0.0))

    def velocity() -> None:
        begun, waypoint, still = place(), f.CartesianVelocityWaypoint, [0.0, 0.0, 0.0]
        speeds = [f.Twist([x, 0.0, 0.0], still) for x in (0.05, -0.05, 0.0)]
        held = [waypoint(x, hold_target_duration=f.Duration(500)) for x in speeds[:2]]
        arm.move(f.CartesianVelocityWaypointMotion([*held, waypoint(speeds[2])]))
        went(begun, (0.0, 0.0, 0.0), 1e-2)

    def joint_velocity() -> None:
        waypoint = f.JointVelocityWaypoint
        held = [waypoint([x] * 7, hold_target_duration=f.Duration(300)) for x in (0.1, -0.1)]
        arm.move(f.JointVelocityWaypointMotion([*held, waypoint([0.0] * 7)]))

    def elbow() -> None:
        now = arm.current_cartesian_state.pose
        goal = now.elbow_state.joint_3_pos + 0.15
        arm.move(f.CartesianMotion(f.RobotPose(now.end_effector_pose, f.ElbowState(goal))))
        assert abs(arm.current_joint_state.position[2] - goal) < 1e-2
        joints()

    def impedance() -> None:
        begun = place()
        motion = f.CartesianImpedanceMotion(f.Affine([0.0, 0.0, 0.03]), target_type=relative)
        arm.move(motion, asynchronous=True)
        time.sleep(2.0)
        went(begun, (0.0, 0.0, -0.03), 1.5e-2)
        arm.move(f.TorqueStopMotion())  # `stop` would raise at the next motion, on a real arm too
        joints()

    def settings() -> None:
        arm.set_collision_behavior([20.0] * 7, [25.0] * 7, [20.0] * 6, [25.0] * 6)
        arm.set_cartesian_impedance([2000.0] * 3 + [200.0] * 3)
        arm.set_joint_impedance([3000.0] * 7)
        joints()

    def gripper() -> None:
        hand = f.Gripper(HOST)
        assert hand.homing() and hand.move(0.05, 0.1) and abs(hand.width - 0.05) < 1e-3
        assert hand.grasp(0.0, 0.1, 20.0, epsilon_outer=1.0) and hand.open(0.1)

    todo = (joints, settings, pose, turn, waypoints, velocity, joint_velocity, elbow, impedance)
    return {what.__name__: what for what in (*todo, gripper)}, arm.recover_from_errors


def one_trial(client: str) -> None:
    """Every kind once, in this process; prints what was wrong with each as JSON."""
    kinds, recover = {"panda_py": panda_py_kinds, "franky": franky_kinds}[client]()
    said = {}
    for name, what in kinds.items():
        try:
            what()
            said[name] = ""
        except Exception as error:
            said[name] = f"{type(error).__name__}: {error}"
            recover()
    print(json.dumps(said), flush=True)


def trials(client: str, count: int) -> dict[str, Any]:
    """The account of so many trials at one robot."""
    passed, stalled, failed = Counter[str](), Counter[str](), dict[str, list[str]]()
    floor = ("--set", f'trouble={{"floor": {FLOOR_M}}}', "--object", str(THING_M))
    with fci_clients.robot(PROTOCOLS[client], more=floor, patience_s=0.0) as end:
        for _ in range(count):
            words = [sys.executable, __file__, "--client", client, "--one"]
            done = subprocess.run(words, capture_output=True, text=True, timeout=TRIAL_S)
            lines = done.stdout.splitlines()
            if done.returncode != 0 or not lines:
                failed.setdefault("script", []).append(done.stderr[-400:])
                continue
            for name, error in json.loads(lines[-1]).items():
                if not error:
                    passed[name] += 1
                elif fci_clients.held_up(error):
                    stalled[name] += 1
                else:
                    failed.setdefault(name, []).append(error)
        summary = end()
    names = dict.fromkeys([*passed, *stalled, *failed])
    kinds = {x: (passed[x], stalled[x], len(failed.get(x, ()))) for x in names}
    return {"trials": count, "kinds": kinds, "failed": failed, "robot": summary}


def main() -> int:
    """All trials of the clients that are installed; 1 where one failed."""
    parser = options(__doc__, trials=20)
    add = parser.add_argument
    add("--client", choices=PROTOCOLS, nargs="+", default=list(PROTOCOLS))
    add("--one", action="store_true", help="one trial, in this process")
    args = parser.parse_args()
    if args.one:
        one_trial(args.client[0])
        return 0
    account = {}
    for client in args.client:
        if importlib.util.find_spec(client) is None:
            print(f"{client}: left out, it is not installed")
            continue
        found = account[client] = trials(client, args.trials)
        for name, (passed, stalled, failed) in found["kinds"].items():
            print(f"{client:9} {name:22} {passed} passed, {stalled} stalled, {failed} failed")
        for name, errors in found["failed"].items():
            print(f"{client} {name}: {errors[0]}")
        seen = ("ticks", "stalled_ms", "commands_received", "commands_missed", "violations")
        print({key: found["robot"][key] for key in seen}, flush=True)
    write(args.json, account)
    return int(any(found["failed"] for found in account.values()))


if __name__ == "__main__":
    sys.exit(main())
