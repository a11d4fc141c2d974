"""What is in a simulated arm's way pushes back as it should."""

import numpy as np
import pytest

from sim.dynamics import end_effector
from sim.joint_effects import Obstacles
from sim.options import check
from sim.scenarios import build
from sim.truth import FLANGE


def driven(trouble: dict, push: float, ticks: int = 400):
    """A plant whose joint 1 is pushed with so many N m beyond what carries the arm."""
    plant = build("nominal", noise="none", trouble=trouble).plant()
    plant.read()
    hold = plant.link_state()[2].copy()
    for _ in range(ticks):
        plant.command(hold + np.array([push, *np.zeros(6)]))
        plant.read()
    return plant


def test_a_held_joint_gives_way_by_as_much_as_it_is_pushed() -> None:
    plant = driven({"held": [1, 2, 3, 4, 5, 6, 7]}, 20.0)
    q, dq, _ = plant.link_state()
    assert q[0] - plant.truth.ready[0] == pytest.approx(20.0 / 5000.0, rel=0.05)
    assert np.abs(dq).max() < 1e-3
    assert plant.pushed()[0] == pytest.approx(-20.0, rel=0.02)
    plant.close()


def test_a_wall_stands_across_the_hand_s_way_and_only_pushes_back() -> None:
    arm = build("nominal", trouble={"wall": 0.02}).truth
    wall = Obstacles(arm.effects, arm.n)
    q, dq = arm.ready, np.array([0.5, 0.2, 0.0, 0.1, 0.0, 0.0, 0.0])
    _, J = end_effector(arm.frames, q, FLANGE)
    speed = np.linalg.norm(J[:3] @ dq)
    for ahead, depth in ((0.0, 0.0), (0.019, 0.0), (0.021, 0.001), (0.025, 0.005)):
        wall.act(0.0, q + dq * ahead / speed, dq, arm.frames)
        expected = 20000.0 * depth + 200.0 * speed * (depth > 0.0)
        assert wall.force == pytest.approx(expected, rel=0.1, abs=1e-9)
        assert wall.torque @ dq == pytest.approx(-wall.force * speed, rel=0.05)
    wall.act(0.0, q, dq, arm.frames)
    assert wall.force == 0.0 and not wall.torque.any()


@pytest.mark.parametrize(
    ("trouble", "said"),
    [
        (3, "have: a table of held"),
        ({"x": 1}, "held, wall"),
        ({"held": [0]}, "NUMBER"),
        ({"wall": "far"}, "from 0 up"),
    ],
)
def test_trouble_that_cannot_be_is_refused(trouble, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        check("nominal", {"trouble": trouble})


def test_a_floor_carries_the_hand_and_lets_it_slide_only_when_pushed_hard() -> None:
    arm = build("nominal").truth
    pose, J = end_effector(arm.frames, arm.ready, FLANGE)
    floor = Obstacles(build("nominal", trouble={"floor": pose[2, 3] + 1e-3}).truth.effects, arm.n)
    way = np.linalg.pinv(J)  # of joint motions that move the hand

    def pushed(x: float, z: float) -> np.ndarray:
        """Force on the hand when it stands so far off the start."""
        q = arm.ready + way @ [x, 0.0, z, 0.0, 0.0, 0.0]
        floor.act(0.0, q, np.zeros(7), arm.frames)
        return np.linalg.pinv(end_effector(arm.frames, q, FLANGE)[1].T) @ floor.torque

    assert pushed(0.0, 0.0)[:3] == pytest.approx([0.0, 0.0, 20.0], abs=0.1)
    assert pushed(2e-4, 0.0)[:3] == pytest.approx([-4.0, 0.0, 20.0], abs=0.1)
    assert pushed(2e-2, 0.0)[0] == pytest.approx(-0.5 * pushed(2e-2, 0.0)[2], rel=0.01)
    assert pushed(2e-2 - 1e-4, 0.0)[0] == pytest.approx(2.0 - 0.5 * pushed(2e-2, 0.0)[2], abs=0.3)
    assert not pushed(0.0, 2e-3).any()
    assert floor.force == 0.0
