"""Recordings that the search for the gap must refuse, and those that it must not."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pybullet_data
import pytest

from adapter.model.robots import documented
from adapter.model.self_model import SelfModel
from adapter.physics.rigid_arm import RigidArm
from adapter.screening.screen import RecordingRefused, Screened, moving_joints, refuse
from drivers.files.mcap import Log, read_log
from sim.effects import payload
from tests.benchmarks.live_trials import trial_of
from tests.helpers.arm_data import ArmData, Motion, arm, panda_model, pin_model, record, rnea
from tests.helpers.gap_tools import pinocchio_recording
from tests.helpers.robot_models import real_log
from tests.hidden import Trial, draw
from tests.hidden.record import write

NAMES = panda_model().tree.joint_names
ORDER = [0, 1, 2, 3, 4, 6, 5]


def taken(log: Log, model: SelfModel | None = None) -> Screened:
    model = model or panda_model()
    return refuse(log, model)


def refused(log: Log, kind: str, model: SelfModel | None = None) -> str:
    """The one sentence."""
    with pytest.raises(RecordingRefused) as caught:
        taken(log, model)
    said = str(caught.value)
    assert caught.value.kind == kind, said
    assert said.endswith(".") and "\n" not in said
    return said


@cache
def dummy() -> SelfModel:
    folder = Path(pybullet_data.getDataPath()) / "franka_panda"
    return documented(folder / "panda.urdf", joints=NAMES)


def wrong(share: float, seed: int) -> SelfModel:
    """The Panda with every link's mass, centre and inertia off by up to a share."""
    rng = np.random.default_rng([seed, 5])
    theta = panda_model().theta * rng.uniform(1 - share, 1 + share, (7, 1))
    theta[:, 1:4] *= rng.uniform(1 - share / 2, 1 + share / 2, (7, 3))
    return replace(panda_model(), theta=theta)


def recording(seed: int, seconds: float = 20.0) -> ArmData:
    return record(arm(), Motion(seconds, seed))


def gravity(log: Log) -> np.ndarray:
    still = np.zeros_like(log.q)
    return RigidArm.of(panda_model()).torque(log.q, still, still)


SPOILED = {
    "sign": lambda log: -log.tau,
    "sign of joint 3": lambda log: log.tau * [1, 1, -1, 1, 1, 1, 1],
    "sign of joints 2 and 6": lambda log: log.tau * [1, -1, 1, 1, 1, -1, 1],
    "scale N mm": lambda log: 1e3 * log.tau,
    "scale kN m": lambda log: 1e-3 * log.tau,
    "scale of motors": lambda log: log.tau / 100,
    "scale -N cm": lambda log: -100 * log.tau,
    "scale by gears of each joint": lambda log: log.tau / [100, 100, 100, 100, 80, 80, 60],
    "gravity": lambda log: log.tau - gravity(log),
    "mounting": lambda log: log.tau - 2 * gravity(log),
    "order": lambda log: log.tau[:, ORDER],
    "order reversed": lambda log: log.tau[:, ::-1],
}


@pytest.mark.parametrize("source", ["real", 1])
@pytest.mark.parametrize("how", SPOILED)
def test_spoiled_torques(how: str, source: str | int) -> None:
    log = real_log() if source == "real" else recording(int(source)).log()
    # The mounting turns gravity alone: what is left of the torque stays as it is.
    said = refused(replace(log, tau=SPOILED[how](log)), how.split()[0])
    assert "N m" in said
    if how == "sign of joint 3":
        assert "panda_joint3" in said and "panda_joint4" not in said
    if how == "scale N mm":
        assert "1000 times" in said and "N mm" in said


@pytest.mark.parametrize("model", ["documented", "dummy"])
def test_a_real_log_passes(model: str) -> None:
    screened = taken(real_log(), dummy() if model == "dummy" else None)
    assert screened.moving == tuple(range(7))
    assert len(screened.log) == screened.timing.kept < len(real_log())
    assert (np.diff(screened.log.stamp_ns) > 0).all()
    assert any("behind q" in note for note in screened.notes)


@pytest.mark.parametrize("seed", range(4))
def test_large_effects_and_wrong_models_pass(seed: int) -> None:
    """2 N m of friction, 10 % of gain, 3 kg from the middle on, inertias 40 % wrong."""
    data = recording(seed)
    rng = np.random.default_rng([seed, 9])
    q, dq, ddq, _ = data.true
    load = payload(3.0, 0.07 * rng.normal(size=3), 0.005 * np.eye(3))
    extra = rnea(pin_model(arm(), load), q, dq, ddq) - rnea(pin_model(arm()), q, dq, ddq)
    extra[: len(q) // 2 * (seed % 2)] = 0.0
    friction = rng.uniform(0, 2, 7) * np.tanh(dq / 0.01)
    tau = (data.tau + extra + friction) * (1 + rng.uniform(-0.1, 0.1, 7))
    log = replace(data.log(), tau=tau)
    taken(log, wrong(0.4, seed))
    taken(log, dummy())


def test_degrees() -> None:
    log = recording(0).log()
    degrees = 180 / np.pi
    both = replace(log, q=degrees * log.q, dq=degrees * log.dq)
    assert "convert" in refused(both, "degrees")
    assert "convert" in refused(replace(log, q=degrees * log.q), "degrees")
    assert "57.3 times" in refused(replace(log, dq=degrees * log.dq), "degrees")


def test_velocities_that_are_not_the_rate_of_the_positions() -> None:
    log = recording(0).log()
    dq = log.dq * [1, 1, 1, -1, 1, 1, 1]
    assert "panda_joint4 -1" in refused(replace(log, dq=dq), "velocity")
    refused(replace(log, dq=np.zeros_like(dq)), "velocity")


def test_an_arm_that_stands_or_hardly_moves() -> None:
    data = recording(0)
    rng = np.random.default_rng(0)
    noise = rng.normal(size=data.q.shape)
    log = replace(data.log(), q=data.q[:1] + 3e-4 * noise, dq=5e-3 * noise[::-1])
    said = refused(log, "motion")
    assert all(name in said for name in NAMES) and "0.3 rad" in said and "0.3 rad/s" in said
    hardly = replace(data.log(), q=data.q[:1] + 0.02 * (data.q - data.q[:1]), dq=0.02 * data.dq)
    refused(hardly, "motion")


def test_joints_that_stand_are_named() -> None:
    screened = taken(record(arm(), Motion(20.0, 3, alone=(3, 0.0))).log())
    assert screened.moving == (3,)
    note = next(n for n in screened.notes if "stand still" in n)
    assert "panda_joint3" in note and "panda_joint4" not in note


def test_moving_joints() -> None:
    t = 1e-3 * np.arange(5000)[:, None]
    size = np.array([0.5, 0.04, 0.0, 0.2])
    w = np.array([2.0, 6.0, 1.0, 0.1])  # the last is wide, but slow
    assert moving_joints(size * np.sin(w * t), size * w * np.cos(w * t)) == (0,)
    assert moving_joints(np.zeros((0, 0)).reshape(10, 0), np.zeros((10, 0))) == ()


def test_another_robot() -> None:
    log = recording(0).log()
    names = [f"ur_{word}" for word in ("pan", "lift", "elbow", "wrist", "roll", "tip")]
    fewer = replace(log, joint_names=tuple(names), q=log.q[:, :6], dq=log.dq[:, :6])
    fewer = replace(fewer, tau=log.tau[:, :6])
    same = replace(log, joint_names=(*names, "gripper"))
    for other in (fewer, same):
        said = refused(other, "robot")
        assert all(name in said for name in (*other.joint_names, *NAMES))


def test_another_robot_with_numbered_joints() -> None:
    """Numbers alone don't make it a Panda: this arm's fourth joint goes where a Panda's can't."""
    log = recording(0).log()
    names = tuple(f"iiwa_joint{k}" for k in range(1, 8))
    assert taken(replace(log, joint_names=names)).log.joint_names == names
    said = refused(replace(log, joint_names=names, q=log.q - log.q.mean(axis=0)), "robot")
    assert all(name in said for name in (*names, *NAMES))


def test_nothing_to_read() -> None:
    log = recording(0).log()
    refused(recording(0, 1.0).log(), "data")
    refused(replace(log, q=np.full_like(log.q, np.nan)), "data")
    refused(replace(log, tau=np.zeros_like(log.tau)), "torque")


def test_a_few_poses_are_no_other_order(tmp_path: Path) -> None:
    """Offsets, gains and a load fit any order of torques there: 11 N m off in place of 0.7."""
    trial = draw(10098)
    log, model, _ = write(trial, tmp_path, pinocchio_recording(trial), "pinocchio")
    taken(read_log(log), documented(model))


@pytest.mark.parametrize("trial", [replace(draw(31019), seconds=15.0), trial_of(77013)])
def test_what_the_hand_takes_half_way_is_no_other_arm(trial: Trial, tmp_path: Path) -> None:
    """5 kg from some time on, which no load that is there from the start explains."""
    log, model, _ = write(trial, tmp_path, pinocchio_recording(trial), "pinocchio")
    taken(read_log(log), documented(model))


def test_friction_that_winds_up_slowly_is_no_lateness(tmp_path: Path) -> None:
    """Bristles in every joint and a slow motion: 76 ms explained the torques, too."""
    trial = replace(draw(52028, effect="payload"), seconds=10.0)
    log, model, _ = write(trial, tmp_path, pinocchio_recording(trial), "pinocchio")
    assert not any("come" in note for note in taken(read_log(log), documented(model)).notes)
