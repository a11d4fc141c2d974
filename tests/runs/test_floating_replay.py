"""Robots whose base floats, from recordings: joint states and the base's motion beside them."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from adapter.cli import main
from adapter.errors import ModelError
from adapter.learning.learner import OnlineLearner
from adapter.learning.settings import LearnerSettings
from adapter.learning.tree_data import TreeData
from adapter.model.model_file import load_model
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array, exp_rotation, rpy_from_matrix
from adapter.model.urdf import model_from_urdf
from adapter.runs.config import PipelineSettings
from adapter.runs.pipeline import make_front_end
from adapter.runs.replay import ReplayOptions, fitted_to, replay, seconds
from adapter.signals.frame_topics import frames_on_base, with_base_motion
from adapter.signals.matching import matching
from drivers.files.mcap import Log, read_log
from drivers.files.ros_types import ACCEL_STAMPED, IMU, JOINT_STATE, ODOMETRY, TWIST_STAMPED
from drivers.interface import DriverError, JointSample
from tests.helpers.robot_models import urdf_text
from tests.helpers.ros_messages import header, imu, joint_state, ns, write
from tests.helpers.tree_motion import in_motion, random_tree_text

# Of usual parts, one sample each: rad, rad/s, share of a joint's torque; rad/s, m/s², m/s.
Q_STD, DQ_STD, TAU_SHARE, W_STD, A_STD, V_STD = 2e-5, 2e-3, 0.02, 3e-3, 3e-2, 5e-3


class Mount(NamedTuple):
    """An Imu's frame on the base: its name, rotation (3, 3) and place (3,) there."""

    name: str
    rotation: Array
    place: Array


class Rates(NamedTuple):
    """Of joint states and of the base's motion, Hz."""

    joints: float = 1000.0
    base: float = 500.0


def record(
    path: Path,
    data: TreeData,
    seed: int | None,
    base: str = "base",
    mount: Mount | None = None,
    rates: Rates = Rates(),  # noqa: B008  # never changed
) -> Path:
    """Joint states, and the base's motion with stamps of its own.

    It is told by an Imu on the base and an Odometry, or, where no Imu is mounted, by TwistStamped
    and AccelStamped.

    Args:
        data: at the rate of the joint states.
        seed: of the noise; none where None.
        base: name of the base's frame.
    """
    rng = np.random.default_rng(seed)

    def noisy(x: Array, std: float | Array) -> Array:
        return np.asarray(x if seed is None else x + std * rng.normal(size=x.shape))

    t, tau = np.arange(len(data)) / rates.joints, data.tau[:, -data.tree.n :]
    joints = noisy(data.q, Q_STD), noisy(data.dq, DQ_STD), noisy(tau, TAU_SHARE * tau.std(axis=0))
    messages = [
        ("/joint_states", JOINT_STATE, at, joint_state(data.tree.joint_names, at, *row))
        for at, *row in zip(t, *joints, strict=True)
    ]
    own = np.arange(0.0003, t[-1], 1.0 / rates.base)
    motion = np.concatenate([data.base.v, data.base.w, data.base.a, data.base.dw], axis=1)
    motion = np.stack([np.interp(own, t, x) for x in motion.T], axis=1)
    v, w, a, dw = np.split(motion, 4, axis=1)
    seen, spun = noisy(v, V_STD), noisy(w, W_STD)
    if mount is None:
        felt = noisy(a, A_STD)
        for at, *row in zip(own, seen, spun, felt, dw, strict=True):
            head = header(ns(at), base)
            parts = ("twist", TWIST_STAMPED, row[:2]), ("accel", ACCEL_STAMPED, row[2:])
            for name, kind, pair in parts:
                messages.append((f"/{name}", kind, at, {"header": head, name: _six(*pair)}))
    else:
        arm = mount.place
        felt = noisy(a + np.cross(dw, arm) + np.cross(w, np.cross(w, arm)), A_STD)
        for at, *row in zip(own, seen, spun, felt, strict=True):
            turned = (x @ mount.rotation for x in row[1:])
            messages.append(("/imu", IMU, at, imu(ns(at), mount.name, *turned)))
            child = {"header": header(ns(at), "odom"), "child_frame_id": base}
            twist = {"twist": {"twist": _six(*row[:2])}}
            messages.append(("/odom", ODOMETRY, at, {**child, **twist}))
    return write(path, messages)


def _six(linear: Array, angular: Array) -> dict:
    parts = zip(("linear", "angular"), (linear, angular), strict=True)
    return {key: dict(zip("xyz", x.tolist(), strict=True)) for key, x in parts}


RATES = Rates(500.0, 200.0)
LEARNED_S, WHOLE_S = 5.0, 6.5
MOUNT = Mount("imu_link", exp_rotation(np.array([0.4, -0.8, 1.1])), np.array([0.07, -0.05, 0.12]))


@cache
def text() -> str:
    """A tree of three joints with an Imu's frame on its base."""
    rpy, xyz = (
        " ".join(map(repr, map(float, x))) for x in (rpy_from_matrix(MOUNT.rotation), MOUNT.place)
    )
    frame = (
        '<link name="imu_link"/><joint name="imu" type="fixed"><parent link="base"/>'
        f'<child link="imu_link"/><origin xyz="{xyz}" rpy="{rpy}"/></joint></robot>'
    )
    return random_tree_text(3, 3).replace("</robot>", frame)


def robot() -> SelfModel:
    return model_from_urdf(text(), floating=True)


@cache
def falling() -> TreeData:
    return in_motion(text(), True, WHOLE_S, 30, RATES.joints)[1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tree, and its fall told by an Imu and by twist and acceleration."""
    path = tmp_path_factory.mktemp("floating")
    (path / "tree.urdf").write_text(text())
    record(path / "imu.mcap", falling(), 1, mount=MOUNT, rates=RATES)
    record(path / "twist.mcap", falling(), 2, rates=RATES)
    return path


def read(path: Path, link: str = "base") -> Log:
    return with_base_motion(matching(read_log(path, beside="frames"), robot()), robot(), link)


@pytest.mark.parametrize("mount", [MOUNT, None])
def test_motion_of_a_base_is_that_of_its_origin(tmp_path: Path, mount: Mount | None) -> None:
    """An Imu mounted anyhow, or a twist and an acceleration, between the joint samples."""
    data = falling().take(slice(0, 500))
    log = read(record(tmp_path / "a.mcap", data, None, mount=mount, rates=Rates(500.0, 490.0)))
    told = log.base[2:-2]
    for part, truth in zip(
        np.split(told, 3, axis=1), (data.base.v, data.base.w, data.base.a), strict=True
    ):
        truth = truth[2:-2]
        assert np.abs(part - truth).max() < 2e-3 * np.abs(truth).max()


def test_across_a_silence_nothing_is_made_up(folder: Path) -> None:
    log = read_log(folder / "imu.mcap", beside="frames")
    silent = [
        replace(m, **{k: getattr(m, k)[keep] for k in ("stamp_ns", "w", "a", "v")})
        for m in log.frames
        for keep in [(m.stamp_ns < log.stamp_ns[1000]) | (m.stamp_ns > log.stamp_ns[1100])]
    ]
    log = with_base_motion(matching(replace(log, frames=tuple(silent)), robot()), robot(), "base")
    unheard = ~np.isfinite(log.base).all(axis=1)
    assert unheard[1005:1095].all() and not unheard[5:995].any()
    front_end = make_front_end(robot(), PipelineSettings())
    states = front_end.step_table(log.stamp_ns, log.q, log.dq, log.tau, base=log.base)
    assert front_end.refused["base_unheard"] == unheard.sum() and np.isfinite(states).all()
    assert len(front_end.gaps) == 1 and any("motion" in m for m in front_end.messages)


def test_tables_equal_single_steps_bit_for_bit(folder: Path) -> None:
    log = read(folder / "imu.mcap").take(np.arange(3250) < 900)
    one, table = (make_front_end(robot(), PipelineSettings()) for _ in range(2))
    rows = [
        state.copy()
        for i, stamp in enumerate(log.stamp_ns)
        for state in one.step(
            JointSample(int(stamp), log.q[i], log.dq[i], log.tau[i], base=log.base[i])
        )
    ]
    states = table.step_table(log.stamp_ns, log.q, log.dq, log.tau, base=log.base)
    assert len(rows) > 500 and np.array(rows).tobytes() == states.tobytes()


def check_learned(log: Log, model: SelfModel, wrench: bool, until_s: float) -> None:
    """Torque on the rest of a recording: nearly as good as by least squares, and good."""
    settings = PipelineSettings(learner=LearnerSettings(base_wrench=wrench))
    settings = replace(settings, filter=fitted_to(log, settings.filter)[0])
    learner = replay(log, model, settings, ReplayOptions(until_s=until_s)).pipeline.learner
    rest = log.take(seconds(log) >= until_s)
    states = make_front_end(model, settings).step_table(
        rest.stamp_ns, rest.q, rest.dq, rest.tau, base=rest.base
    )
    tau = states[:, learner.layout.joint_tau]
    ours = learner.predict(states)[:, 6:] - tau
    learner.theta.th[:] = learner.theta.least_squares()
    batch = learner.predict(states)[:, 6:] - tau
    assert (ours**2).mean() < 1.1**2 * (batch**2).mean()
    assert (ours**2).mean() < 0.1**2 * (tau**2).mean()


@pytest.mark.parametrize("name,wrench", [("imu", True), ("twist", False)])
def test_a_falling_tree_is_learned_as_well_as_by_least_squares(
    folder: Path, name: str, wrench: bool
) -> None:
    log = read(folder / f"{name}.mcap", "imu_link" if wrench else "base")
    check_learned(log, robot(), wrench, LEARNED_S)


def test_the_prior_is_as_wide_as_bodies_are_heavy(folder: Path, tmp_path: Path) -> None:
    """Twenty times the weight: no link of an arm."""
    key = r'(mass value|effort|i[xyz]{2})="([^"]*)"'
    heavy = re.sub(key, lambda m: f'{m[1]}="{20.0 * float(m[2])!r}"', text())
    model, data = in_motion(heavy, True, WHOLE_S, 30, RATES.joints)
    path = record(tmp_path / "heavy.mcap", data, 2, rates=RATES)
    log = with_base_motion(matching(read_log(path, beside="frames"), model), model, "base")
    spreads = []
    for fall, arm in ((read(folder / "twist.mcap"), robot()), (log, model)):
        settings = PipelineSettings(learner=LearnerSettings())
        settings = replace(settings, filter=fitted_to(fall, settings.filter)[0])
        theta = replay(fall, arm, settings, ReplayOptions(every=5)).pipeline.learner.theta
        spreads.append(theta.body_spread[:-1].max())
        assert np.allclose(theta.prior, theta._neutral_prior()[0])
    assert spreads[1] > 2.0 * spreads[0]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::adapter.errors.ModelWarning")
def test_talos_is_learned_as_well_as_by_least_squares(tmp_path: Path) -> None:
    link = "base_link"
    model, data = in_motion(urdf_text("talos"), True, 12.0, 5, RATES.joints)
    recorded = read_log(
        record(tmp_path / "a.mcap", data, 1, base=link, rates=RATES), beside="frames"
    )
    log = with_base_motion(matching(recorded, model), model, link)
    check_learned(log, model, True, 10.0)


def test_an_unknown_wrench_teaches_nothing() -> None:
    states = falling().states()[:600].copy()
    pushed = states.copy()
    settings = LearnerSettings(base_wrench=False, wait_for_schema=False)
    learner, other = (OnlineLearner(robot().tree, settings=settings) for _ in range(2))
    pushed[:, learner.layout.tau.start : learner.layout.joint_tau.start] = 50.0
    for a, b in zip(states, pushed, strict=True):
        learner.step(a)
        other.step(b)
    assert learner.theta.updates > 50 and np.array_equal(learner.theta.th, other.theta.th)


def test_the_command_learns_and_keeps_the_base_as_documented(folder: Path, tmp_path: Path) -> None:
    """With an unknown wrench nothing shows the base's body; the report and the URDF are there."""
    log, out = str(folder / "imu.mcap"), tmp_path / "out"
    options = ["--robot", str(folder / "tree.urdf"), "--base", "base", "--every", "10"]
    options += ["--validate-from", str(LEARNED_S), "--out", str(out), "--json", str(tmp_path / "j")]
    assert main(["replay", log, *options, "--quiet"]) in (0, 9)  # every tenth teaches slowly
    figures = json.loads((tmp_path / "j").read_text())
    documented, learned = robot(), load_model(out / "model.json")
    assert figures["lambda"]["settled"] and max(figures["lambda"]["position_error_m"]) < 1e-6
    size = np.sqrt((falling().tau[:, 6:] ** 2).mean())
    assert np.mean(figures["theta"]["validation_torque_rmse_nm"]) < 0.1 * size
    assert np.allclose(learned.theta[0], documented.theta[0], atol=1e-6)
    assert not learned.theta_identifiable[0].any() and learned.theta_identifiable[1:].any()
    assert (out / "model.urdf").exists() and (out / "report.html").exists()


def test_what_does_not_fit_is_refused_with_the_choices(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="'l0' moves on it; have: base, imu_link"):
        frames_on_base(robot(), "l0")
    with pytest.raises(ModelError, match="'pelvis' is not there; have: base, imu_link"):
        frames_on_base(robot(), "pelvis")
    whole = read_log(folder / "imu.mcap", beside="frames")
    with pytest.raises(DriverError, match=r"no acceleration .*sensor_msgs/msg/Imu.*have: /odom"):
        odometry = tuple(m for m in whole.frames if m.topic == "/odom")
        with_base_motion(replace(whole, frames=odometry), robot(), "base")
    elsewhere = tuple(replace(m, frame="torso") for m in whole.frames)
    with pytest.raises(DriverError, match="no angular velocity and no acceleration"):
        with_base_motion(replace(whole, frames=elsewhere), robot(), "base")
    late = tuple(replace(m, stamp_ns=m.stamp_ns + 10**12) for m in whole.frames)
    with pytest.raises(DriverError, match="share a clock"):
        with_base_motion(replace(whole, frames=late), robot(), "base")
    with pytest.raises(DriverError, match="nothing of its motion was read"):
        replay(matching(whole, robot()), robot(), PipelineSettings())


def test_info_tells_of_base_motion(folder: Path, tmp_path: Path) -> None:
    assert main(["info", str(folder / "imu.mcap"), "--json", str(tmp_path / "j")]) == 0
    told = json.loads((tmp_path / "j").read_text())["frames"]
    assert told == ["/imu (imu_link)", "/odom (base)"]
