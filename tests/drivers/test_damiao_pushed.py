"""A CAN arm that something holds: stopped, braked without a push, held without one."""

from __future__ import annotations

import itertools
import math
import os
from contextlib import ExitStack

import numpy as np
import pytest

from adapter.control.controller import ExcitationController
from adapter.control.feedforward import ModelFeedforward
from adapter.control.limits import MotionLimits
from adapter.control.settings import ExcitationSettings
from adapter.model.robots import documented
from adapter.realtime.session import Session, run_lockstep
from adapter.signals.front_end import FrontEnd
from drivers.damiao import holding
from drivers.damiao.arm import DamiaoArm
from drivers.damiao.codec import Scales
from drivers.damiao.guardian import Guardian, GuardianMemory, GuardianMode
from drivers.damiao.holding import Braker, Push, PushWatch
from drivers.damiao.settings import BusSettings
from sim.damiao.server import Boards
from sim.scenarios import Scenario, build
from tests.helpers.lockstep_drivers import Lockstep, in_place_of_time, on_line

PANDA = documented("panda")
LIMITS = [Scales(12.5, 25.0, 100.0)] * 2


@pytest.fixture
def on_a_line():
    """Makes an arm on a line in lockstep, with its boards; sleeping lets the line's time pass."""
    with ExitStack() as stack:

        def made(scenario: Scenario) -> tuple[DamiaoArm, Lockstep, Boards]:
            driver, boards = on_line(scenario)
            stack.callback(boards.close)
            stack.enter_context(in_place_of_time(holding, driver))
            stack.callback(driver.close)
            return driver.driver, driver, boards

        yield made


def excited(driver: Lockstep, seed: int, seconds: float, each) -> Session:
    """What becomes of so much excitation."""
    controller = ExcitationController(
        MotionLimits.of(PANDA), ExcitationSettings(seed=seed), expected=ModelFeedforward.of(PANDA)
    )
    return run_lockstep(driver, FrontEnd(PANDA), None, controller, seconds, each=each)


def test_a_held_can_arm_is_stopped_and_the_push_goes(on_a_line) -> None:
    _, driver, boards = on_a_line(build("nominal", trouble={"held": [2], "t_s": 2.5}))
    obstacles, pushes = boards.world._engine.obstacles, []
    result = excited(
        driver, 1, 4.0, lambda sample, tau: pushes.append(np.abs(obstacles.torque).max())
    )
    assert result.fault is not None and result.fault.startswith("joint 2 (panda_joint2) is ")
    assert max(pushes) > 20.0
    left = np.abs(obstacles.torque).max()
    assert left < 0.3 * max(pushes), (left, max(pushes))
    assert np.abs(boards.world.state()[2]).max() < 0.2


def test_held_angles_come_after_an_arm_that_is_kept_away_but_slowly() -> None:
    braker = Braker(LIMITS, [0.0, 0.0], [0.5, 0.0])
    kp = holding.gains(LIMITS[0])[0]
    away = [0.2, 0.0]  # a wall keeps joint 1 there
    before = braker.hold[0]
    for _ in range(400):
        braker.commands(0.005, away, [0.0, 0.0])
        assert 0.0 <= before - braker.hold[0] <= 0.2 * 0.005 + 1e-12
        before = braker.hold[0]
    assert kp * (braker.hold[0] - 0.2) == pytest.approx(0.15 * 100.0)
    assert braker.hold[1] == 0.0
    nothing_known = Braker(LIMITS, [0.0, 0.0], [0.5, 0.0])
    nothing_known.commands(0.005, [math.nan, 0.0], [0.0, 0.0])
    assert nothing_known.hold == [0.5, 0.0]


@pytest.mark.parametrize(
    ("dq", "carried", "tau", "joint"),
    [
        (0.0, 30.0, -50.0, 0),  # pushed against what carries it
        (0.0, 60.0, 85.0, 0),  # all that the motor can for too long
        (0.5, 30.0, -50.0, None),  # it moves: that is an acceleration
        (0.0, 60.0, 70.0, None),
    ],
)
def test_the_guardian_finds_an_arm_that_is_pushed_although_it_stands(
    dq, carried, tau, joint
) -> None:
    watch = PushWatch(LIMITS)
    found = [watch.step(0.002, [dq, 0.0], [carried, 0.0], [tau, 0.0]) for _ in range(200)]
    push = next((push for push in found if push is not None), None)
    assert (None if push is None else push.joint) == joint
    assert found[0] is None


def test_a_free_arm_never_looks_pushed(on_a_line) -> None:
    """Turning points of 2 s of motion: standing joints, none pushed for a fifth of the time."""
    arm, driver, _ = on_a_line(build("nominal"))
    watch, longest_s, still = None, 0.0, 0

    def look(sample, tau):
        nonlocal watch, longest_s, still
        watch = watch or PushWatch(arm.limits)
        carried = arm._told or arm._carried
        assert watch.step(0.001, sample.dq.tolist(), carried, sample.tau.tolist()) is None
        longest_s = max(longest_s, *watch._pushed_s)
        still += int((np.abs(sample.dq) < holding.STANDING).sum())

    result = excited(driver, 3, 2.0, look)
    assert result.fault is None and still > 300
    assert longest_s < 0.2 * holding.PUSH_S


def test_a_loop_that_a_busy_machine_stops_in_a_push_is_not_held_to_have_pushed_meanwhile() -> None:
    """One report of a push, then 40 ms without any; three reports of 5 ms are a push."""
    settings = BusSettings.of("can://239.74.163.2:46991?interface=udp_multicast&rate=200", None)
    limits = [Scales(12.5, 25.0, 100.0)] * settings.joints
    names = [f"joint{j + 1}" for j in range(settings.joints)]
    n = settings.joints
    block, memory = GuardianMemory.create()
    os.close(block)
    guardian = Guardian(settings, limits, memory, os.getpid(), names)
    guardian._say = lambda sentence: None
    try:
        memory.put([0.0] * n, [0.0] * n, [0.0] * n, [0.0] * n)
        beats = itertools.count(10**9, 5_000_000)
        for _ in range(10):
            memory.beat_ns = next(beats)
            guardian._look(GuardianMode.DRIVE)
        memory.put([0.0] * n, [0.0] * n, [0.0] * n, [90.0] * n)
        memory.beat_ns = next(beats)
        for _ in range(20):
            guardian._look(GuardianMode.DRIVE)
        assert memory.forbidden is None
        memory.beat_ns = next(beats) + 40_000_000
        guardian._look(GuardianMode.DRIVE)
        assert memory.forbidden is None
        for _ in range(2):
            memory.beat_ns = next(beats) + 40_000_000
            guardian._look(GuardianMode.DRIVE)
        assert memory.forbidden is not None and memory.forbidden.joint == 0
        for _ in range(20):  # it heeds that: no command, however long it takes
            guardian._look(GuardianMode.DRIVE)
        assert guardian._gone_on == 0
    finally:
        guardian.close()


def test_a_forbidden_joint_is_read_by_the_loop() -> None:
    block, loop = GuardianMemory.create()
    guardian = GuardianMemory.of(block)
    os.close(block)
    assert loop.forbidden is None
    loop.put([1.0, 2.0], [3.0, 4.0], [5.0, 6.0], [7.0, 8.0])
    rows = guardian.q, guardian.dq, guardian.carried, guardian.tau
    assert [row[:2] for row in rows] == [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0], [7.0, 8.0]]
    guardian.forbid(Push(1, -80.25, 75.0))
    assert loop.forbidden == Push(1, -80.25, 75.0)
    assert loop.forbidden.said("elbow") == (
        "joint 2 (elbow) is pushed with -80.2 N m (limit 75.0 N m) although it stands still"
    )
