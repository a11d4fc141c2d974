"""A blocked arm, a wall, a load that drops: stopped in time, by name, and without a push left.

And an arm that something holds and pushes before it starts, or with a load nobody told.
"""

from __future__ import annotations

import numpy as np
import pytest

from adapter.control.controller import ControlSettings, ExcitationController
from adapter.control.feedforward import ModelFeedforward
from adapter.control.limits import MotionLimits
from adapter.control.observer import ContactObserver
from adapter.control.push_bound import left_at_most
from adapter.control.resting import CarriedWeight
from adapter.control.safety import CALM, ArmWatch, Now
from adapter.control.settings import ExcitationSettings, SafetySettings
from adapter.errors import ControlError, SettingsError
from adapter.model.robots import documented
from adapter.realtime.session import run_lockstep
from adapter.signals.front_end import FrontEnd
from drivers.interface import JointSample
from sim.scenarios import SIDE_STEP_M, STAND_OFF_M, build
from sim.truth import FLANGE_M
from tests.helpers.lockstep_drivers import BEGINS_LOADED_S, BEGINS_S, LET_GO, FciLockstep, opened

PANDA = documented("panda")
LIMITS = MotionLimits.of(PANDA)
N, T_S = PANDA.tree.n, 1.0
# Limits so far away that one of them is left to be seen.
FAR = {"tracking_share": 1.0, "tracking_rad": 3.0, "external_share": 1.0, "power_share": 1.0}


WALL_S, DROP_S = BEGINS_S["can"] + 1.5, BEGINS_LOADED_S["can"] + T_S
FOLLOWS = {**FAR, "tracking_share": 0.3}
SATURATES = {**FAR, "saturated_s": 0.03, "start_share": 0.2}
ON_DRIVERS = [
    ("sim", {"held": [2]}, {}, "joint 2 (panda_joint2) is pushed"),
    ("sim", {"held": [2]}, FOLLOWS, "from where it should be"),
    ("sim", {"held": [2]}, SATURATES, "was cut at"),
    ("sim", {"held": [1, 2, 3, 4, 5, 6, 7]}, {}, "is pushed"),
    ("sim", {"wall": 0.01, "t_s": 1.5}, {}, "is pushed"),
    ("sim", {"load": 4.0}, {**FAR, "power_share": 0.1}, "would move with"),
    ("sim", {"load": 4.0}, {**FAR, "external_share": 0.3}, "is pushed"),
    ("fci", {"held": [2]}, {}, "joint 2 (panda_joint2)"),
    ("fci", {"held": [2]}, FOLLOWS, "from where it should be"),
    ("fci", {"held": [2]}, SATURATES, "was cut at"),
    ("fci", {"wall": 0.01, "t_s": 1.5}, {**FAR, "external_share": 0.2}, "is pushed"),
    ("fci", {"load": 4.0}, {**FAR, "power_share": 0.1}, "would move with"),
    ("can", {"held": [2]}, FOLLOWS, "joint 2 (panda_joint2) is "),
    ("can", {"held": [2]}, SATURATES, "was cut at"),
    ("can", {"held": [2, 4]}, {**FAR, "external_share": 0.5}, "is pushed"),
    ("can", {"wall": 0.01, "t_s": WALL_S}, {**FAR, "external_share": 0.1}, "is pushed"),
    ("can", {"wall": 0.01, "t_s": WALL_S}, {**FAR, "tracking_share": 0.2}, "from where it"),
    ("can", {"load": 6.0, "t_s": DROP_S}, {**FAR, "external_share": 0.2}, "is pushed"),
]


def controller_with(**safety) -> ExcitationController:
    return ExcitationController(
        LIMITS,
        ExcitationSettings(seed=1),
        ControlSettings(safety=SafetySettings(**safety)),
        expected=ModelFeedforward.of(PANDA),
    )


@pytest.mark.parametrize(("name", "trouble", "safety", "said"), ON_DRIVERS)
def test_every_limit_stops_on_every_driver(name, trouble, safety, said) -> None:
    """By joint and cause, without a jump; next to nothing is pushed 50 ms later, nor for good."""
    world = build("nominal", 1, trouble={"t_s": BEGINS_S[name] + T_S, **trouble})
    commands, pushes = [], []
    with opened(name, world) as (arm, obstacles):
        if isinstance(arm, FciLockstep):  # else the robot's own reflex is sooner
            for most in ("upper_torque", "upper_force"):
                getattr(arm.served.settings, most)[:] = 1e3
        controller = controller_with(**safety)
        controller.weight = CarriedWeight(PANDA, trusted=True)

        def note(sample: JointSample, tau) -> None:
            pushes.append(np.abs(obstacles.torque).max())
            if tau is not None:
                commands.append(tau.copy())

        result = run_lockstep(arm, FrontEnd(PANDA), None, controller, 3.0, each=note)
        for _ in range(0 if name == "can" else 50):  # there the stop itself takes its time
            arm.read()
        left = float(np.abs(obstacles.torque).max())
        for _ in range(LET_GO):
            arm.read()
        for_good = np.abs(obstacles.torque)
        speed = np.mean([arm.read().dq for _ in range(100)][50:], axis=0)
    assert result.ended == "driver_error" and result.fault is not None
    assert result.fault.startswith("joint ") and said in result.fault and "\n" not in result.fault
    assert name == "can" or len(pushes) > 1000 * T_S  # there the motors' start takes some of it
    assert max(pushes) <= 1.2 * LIMITS.effort.max()
    assert (np.abs(np.diff(commands, axis=0)) <= 1e-3 * LIMITS.torque_rate + 1e-9).all()
    assert left <= max(0.2 * max(pushes), 1.0)
    assert (for_good <= left_at_most(LIMITS.effort)).all(), for_good
    assert name != "sim" or np.abs(speed).max() < 0.01  # it stands, and was not dropped


@pytest.mark.parametrize("trusted", [False, True])
def test_a_braked_arm_is_not_carried_with_a_push(trusted) -> None:
    """Whatever it held at rest is carried where the model is trusted; a push later on never is."""
    weight, q = CarriedWeight(PANDA, trusted), 0.5 * (LIMITS.lower + LIMITS.upper)
    own = ModelFeedforward.of(PANDA).unbent(q)
    strange = np.where(np.arange(N) == 0, 30.0, 0.0)  # about an axis along gravity: no load does
    weight.begin(q, own + strange)
    assert (weight.refusal is None) == trusted
    push = np.full(N, 0.5) * LIMITS.effort
    carried = weight.within(q, own + strange + push)
    assert (np.abs(carried - own - strange) <= left_at_most(LIMITS.effort)).all() == trusted
    if trusted:
        np.testing.assert_allclose(weight.within(q, own + strange), own + strange, atol=1e-9)


def test_what_was_learned_stops_a_held_arm_sooner() -> None:
    """At a limit of 0.2 of the effort, as asked for, in place of 0.7."""
    controller, none, pushes = controller_with(learned_share=0.2), np.zeros((0, N)), []
    controller.observer = observer = ContactObserver(PANDA)
    observer.adopt(PANDA.lam, PANDA.theta, none, none, np.full(N, 0.05))

    def note(sample: JointSample, tau) -> None:
        observer.step(sample)  # for the next tick
        pushes.append(np.abs(obstacles.torque).max())

    with opened("sim", build("nominal", 1, trouble={"held": [2], "t_s": T_S})) as (arm, obstacles):
        result = run_lockstep(arm, FrontEnd(PANDA), None, controller, 2.0, each=note)
        for _ in range(250):
            arm.read()
        left = np.abs(obstacles.torque).max()
    assert result.fault is not None and "joint 2 (panda_joint2) is pushed" in result.fault
    assert max(pushes) < 0.4 * LIMITS.effort[1]
    assert left <= 0.2 * max(pushes)


STEP = np.full(N, 1.0)


def watch_at_rest(**safety) -> ArmWatch:
    watch = ArmWatch(LIMITS, SafetySettings(**safety), np.ones(N), LIMITS.effort)
    watch.now[Now.MEASURED] = watch.now[Now.EXPECTED] = 0.0
    watch.step(STEP, 1e-3)
    return watch


@pytest.mark.parametrize(
    ("row", "size"),
    [
        (Now.ERROR, np.full(N, 0.5)),
        (Now.WANTED, 0.5 * LIMITS.effort),
        (Now.MEASURED, -0.7 * LIMITS.effort),
        (Now.SPEED, 0.7 * LIMITS.velocity),
    ],
    ids=["tracking", "saturated", "external", "power"],
)
@pytest.mark.parametrize("j", range(N))
def test_a_limit_that_is_exceeded_stops_within_50_ms(row: Now, size, j: int) -> None:
    watch = watch_at_rest(saturated_s=0.04)

    def run(share: float, ticks: int = 50) -> None:
        for _ in range(ticks):
            watch.now[Now.WANTED] = watch.now[Now.COMMAND] = 0.0
            if row == Now.SPEED:  # a command at the effort limit, which the model expects
                for k in (Now.WANTED, Now.COMMAND, Now.MEASURED, Now.EXPECTED):
                    watch.now[k, j] = LIMITS.effort[j]
            watch.now[row, j] = share * size[j]
            watch.step(STEP, 1e-3)

    run(0.98, 200)
    with pytest.raises(ControlError, match=f"^joint {j + 1} .*the arm is stopped$"):
        run(1.05)


def test_a_constant_difference_is_no_push_and_effort_rises_with_agreement() -> None:
    watch = watch_at_rest()
    off = CALM * 0.6 * LIMITS.effort  # a load that comes slowly
    watch.now[Now.SPEED] = 0.1
    rooms = []
    for k in range(8000):
        watch.now[Now.MEASURED] = min(k / 4000, 1.0) * off
        watch.now[Now.WANTED] = 0.0
        rooms.append(float(watch._bounds[0, 0]))
        watch.step(STEP, 1e-3)
    np.testing.assert_allclose(watch.now[Now.OFFSET], off, rtol=0.03)
    assert rooms[0] == 0.5 * LIMITS.effort[0] and np.all(np.diff(rooms) >= -1e-9)
    assert rooms[-1] == pytest.approx(2.0 * LIMITS.effort[0])  # all that the joint may


@pytest.mark.parametrize(
    ("name", "value"),
    [("tracking_share", 0.0), ("hold_s", 0.06), ("power_share", 1.1), ("tracking_rad", 4.0)],
)
def test_settings_that_cannot_be_are_refused(name: str, value: float) -> None:
    with pytest.raises(SettingsError, match=name):
        SafetySettings(**{name: value})


STALE = 5  # readings after a stop that may be older
PUSH, SOFT = 25.0, 200.0  # N m; N m/rad: an arm that gives in a little is pushed yet


def controller() -> ExcitationController:
    made = controller_with()
    made.weight = CarriedWeight(PANDA)
    return made


PUSHED = [("can", 1, 1), ("can", 2, 1), ("can", 2, -1), ("can", 3, -1), ("can", 4, 1)]
PUSHED += [(name, j, 1) for name in ("sim", "fci") for j in (1, 2, 3, 4)]


@pytest.mark.parametrize(("name", "joint", "sign"), PUSHED)
def test_an_arm_that_is_pushed_before_it_starts_is_not_moved(name, joint, sign) -> None:
    held = {"held": [joint], "push": sign * PUSH, "k": SOFT, "t_s": 0.0}
    commands = []
    with opened(name, build("nominal", 1, trouble=held)) as (arm, _):
        if name != "can":  # there motors are switched on and settle
            arm.connect()
            for _ in range(50):
                arm.read()
        each = lambda sample, tau: commands.append(tau)  # noqa: E731
        result = run_lockstep(arm, FrontEnd(PANDA), None, controller(), 0.5, each=each)
    assert result.fault is not None and result.fault.startswith("at rest ")
    assert f"panda_joint{joint} holds" in result.fault and "the model says" in result.fault
    assert commands == [None]


@pytest.mark.parametrize("learned", [False, True])
def test_a_load_that_nobody_told_is_carried_on_after_the_stop(learned) -> None:
    """By what it was found to be before the start, and no less once it was learned."""
    moved, world = controller(), build("nominal", 1, trouble={"load": 4.0, "t_s": 1e3})
    if learned:
        known, none = PANDA.theta.copy(), np.zeros((0, N))
        known[-1, :4] += 4.0 * np.r_[1.0, SIDE_STEP_M, 0.0, FLANGE_M + STAND_OFF_M]
        moved.observer = ContactObserver(PANDA)
        moved.observer.adopt(PANDA.lam, known, none, none, np.full(N, 0.05))
    with opened("can", world) as (arm, _):
        watched = lambda sample, tau: moved.observer.step(sample) if learned else None  # noqa: E731
        result = run_lockstep(arm, FrontEnd(PANDA), None, moved, 1.0, each=watched)
        after = np.array([arm.read().q for _ in range(1500)])
    assert result.fault is None, result.fault
    assert result.samples > 1000
    assert np.abs(after - after[STALE]).max() < 0.02  # rad, in the springs that hold it at once
    assert np.ptp(after[1000:], axis=0).max() < 0.008
