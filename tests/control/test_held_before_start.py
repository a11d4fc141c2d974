"""An arm that something holds and pushes before it starts, or that carries a load nobody told."""

from __future__ import annotations

import numpy as np
import pytest

from adapter.control.controller import ExcitationController
from adapter.control.feedforward import ModelFeedforward
from adapter.control.limits import MotionLimits
from adapter.control.observer import ContactObserver
from adapter.control.resting import CarriedWeight
from adapter.control.settings import ExcitationSettings
from adapter.model.robots import documented
from adapter.realtime.session import run_lockstep
from adapter.signals.front_end import FrontEnd
from sim.scenarios import SIDE_STEP_M, STAND_OFF_M, build
from sim.truth import FLANGE_M
from tests.helpers.lockstep_drivers import opened

PANDA = documented("panda")
LIMITS = MotionLimits.of(PANDA)
N = PANDA.tree.n
SAG, CREEP = 0.02, 0.008  # rad: in the springs that hold it at once, and in the last half second
STALE = 5  # readings after a stop that may be older
PUSH, SOFT = 25.0, 200.0  # N m; N m/rad: an arm that gives in a little is pushed yet


def controller() -> ExcitationController:
    made = ExcitationController(
        LIMITS, ExcitationSettings(seed=1), expected=ModelFeedforward.of(PANDA)
    )
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
    assert np.abs(after - after[STALE]).max() < SAG
    assert np.ptp(after[1000:], axis=0).max() < CREEP
