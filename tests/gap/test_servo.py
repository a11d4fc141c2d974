"""Arms without torque: servos named and fitted, unseen motion foretold, nothing named in vain."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapter.cli import main
from adapter.effects.robots import read_robot
from adapter.errors import ModelError
from adapter.gap.servo import explain
from adapter.gap.servo_kernels import SLIP, SLIPS, STICKS, WITHIN, Ground, Load, follow_alone
from adapter.gap.servo_model import ServoModel, read_servos
from adapter.gap.servo_signals import Track, columns, loads, over_ground
from adapter.gap.servo_words import headline
from adapter.model.spatial import Array
from adapter.model.urdf import model_from_urdf
from adapter.physics.rigid_arm import RigidArm
from adapter.screening.screen import RecordingRefused
from drivers.files.mcap import Commands, Log, read_position_log, write_log
from tests.helpers.position_arm import Drawn, PositionArm, as_log, errors, named, position_arm
from tests.helpers.robot_models import machine_urdf

PANDA = read_robot("panda")


@pytest.mark.parametrize(
    ("seed", "drawn"),
    [
        pytest.param(11, Drawn(), marks=pytest.mark.slow),
        pytest.param(12, Drawn(feeds_speed=False, period_s=4e-3), marks=pytest.mark.slow),
        (13, Drawn(noise_rad=1e-4)),
    ],
)
def test_each_is_named_and_an_unseen_motion_foretold(seed: int, drawn: Drawn) -> None:
    arm = position_arm(seed, drawn)
    seen, unseen = arm.moved("sines", seed), arm.moved("points", seed + 50)
    gap = explain([as_log(seen)], PANDA, None, [as_log(unseen)])
    # inertias of the last link that are 2 % and 2 mm off hide a small motor of the wrist
    assert arm.expected - {("motor_inertia", 7)} <= named(gap) <= arm.expected
    for effect, error in errors(gap, arm).items():
        assert np.abs(error).max() < 0.12, (effect, error)
    assert gap.after.max() < 1e-3 < gap.before.max()
    assert np.median(gap.after) < 1.2 * drawn.noise_rad
    together = next(f for f in gap.findings if f.effect == "servo_velocity_gain").open
    assert bool(together) != drawn.feeds_speed


@pytest.mark.parametrize(
    ("effect", "key", "joints", "size"),
    [
        ("servo_dead_band", "dead", (4,), 5e-3),  # rad
        ("servo_torque_limit", "limit", (5,), 1.8),  # N m
        ("static_friction", "stiction", (3,), 6.0),  # N m
        # rad; gravity holds it on one side
        pytest.param("backlash", "backlash", (4,), 8e-3, marks=pytest.mark.slow),
    ],
)
def test_what_limits_a_servo_is_named(effect, key, joints, size) -> None:
    """And nothing else, with its size; and then it foretells another motion to the noise."""
    arm = position_arm(2, Drawn(period_s=4e-3))
    values = np.array(getattr(arm.servos, key))
    values[np.array(joints) - 1] = size
    arm = replace(arm, servos=replace(arm.servos, **{key: values}))
    seen, unseen = as_log(arm.moved("sines", 2)), as_log(arm.moved("points", 52))
    gap = explain([seen], PANDA, None, [unseen])
    told = {name for name in named(gap) if name[0] == effect}
    assert told == {(effect, j) for j in joints}
    assert named(gap) <= arm.expected
    assert np.abs(errors(gap, arm)[effect]).max() < 0.1
    assert (gap.after < 1e-3).all() and (gap.after < 0.2 * gap.before).all()


@pytest.mark.parametrize("feeds_speed", [True, False])
def test_an_arm_as_documented_has_nothing_named(feeds_speed: bool) -> None:
    """Also where its bodies are other than documented, which its tracking shows."""
    arm = position_arm(21, Drawn(8.0, feeds_speed=feeds_speed, masses_off=0.02))
    recording = as_log(arm.moved("sines", 21))
    gap = explain([recording], PANDA, arm.documentation)
    assert not gap.findings
    assert gap.before.max() < 1e-3


def test_only_what_is_otherwise_than_documented_is_named() -> None:
    arm = position_arm(22, Drawn(8.0))
    right = arm.documentation
    coulomb = right.coulomb.copy()
    coulomb[2] *= 0.5
    told = replace(right, coulomb=coulomb, delay_s=right.delay_s + 2e-3)
    gap = explain([as_log(arm.moved("sines", 22))], PANDA, told)
    every = {("servo_delay", j) for j in range(1, 8)}
    assert named(gap) == {("coulomb_friction", 3), *every}
    for effect, error in errors(gap, arm).items():
        assert np.abs(error).max() < 0.12, (effect, error)
    assert gap.after.max() < 0.1 * gap.before.max()


@pytest.mark.parametrize("rubs", [0.0, pytest.param(0.2, marks=pytest.mark.slow)])
def test_a_table_under_the_hand_is_told_from_the_servos(rubs: float) -> None:
    """It holds and pushes several joints at once, and foretells where it does in another motion."""
    free = position_arm(41, Drawn(16.0, 10e-3, 1e-4, feeds_speed=False))
    height = 0.55
    arm = replace(free, servos=replace(free.servos, table=(0.0, 0.0, 0.12, height, 2000.0, rubs)))
    seen = [as_log(arm.moved("points", seed)) for seed in (41, 42)]
    gap = explain(seen, PANDA, None, [as_log(arm.moved("points", 43))])
    assert gap.ground.root > 0.0
    assert abs(gap.ground.height - height) < 0.06
    assert gap.servos.ground.root > 0.0
    assert min(gap.touched) > 1.0
    assert "the hand came down on something" in headline(gap)
    assert abs(gap.ground.rubs - rubs) < 0.1
    # that the simulated table drags a hand without giving way along itself costs a little
    assert np.median(gap.after) < (0.4 if rubs else 0.2) * np.median(gap.before)
    if not rubs:
        alone = explain(seen[1:], PANDA, None, [seen[0]])
        assert alone.ground.root > 0.0 == alone.servos.ground.root


def test_an_arm_that_is_where_its_commands_are_has_nothing_named() -> None:
    recording = position_arm(23, Drawn(6.0)).moved("sines", 23)
    noise = 5e-5 * np.random.default_rng(23).standard_normal(recording.q.shape)
    gap = explain([as_log(replace(recording, q=recording.q_command + noise))], PANDA)
    assert not gap.findings
    assert gap.servos.is_ideal


def servo(*numbers: float) -> Array:
    """(12,) of which the first are told."""
    return np.pad(np.array(numbers), (0, WITHIN + 1 - len(numbers)))


def steers(commands: Array) -> Array:
    """(2, m) commands whose speed is not fed forward."""
    return np.array([commands, np.zeros_like(commands)])


def test_one_joint_steps_as_a_linear_servo_does() -> None:
    """Without friction it is an oscillator of the second order, whose step is known."""
    step, x = 1e-4, servo(2e-3, 0.0, 0.02, 1e-4)
    m = 10000
    load = Load(np.full(m, 0.15), *np.zeros((5, m)))
    inertia = x[0] * 0.15 + x[3]
    omega, q = inertia**-0.5, np.empty(m)
    zeta = 0.5 * x[2] * omega
    follow_alone(x, steers(np.ones(m)), load, np.zeros(2), step, q)
    t, fast = step * np.arange(1, m + 1), omega * np.sqrt(1.0 - zeta**2)
    swing = np.cos(fast * t) + zeta * omega / fast * np.sin(fast * t)
    assert np.abs(q - (1.0 - np.exp(-zeta * omega * t) * swing)).max() < 1e-4


def test_a_table_is_read_between_its_rows() -> None:
    """As numpy has it: beyond the ends, and where two rows are of one instant."""
    rng = np.random.default_rng(26)
    for t in (np.cumsum(rng.uniform(0.1, 1.0, 20)), np.array([0.0, 0.0, 1.0, 2.0, 2.0])):
        table, at = rng.standard_normal((len(t), 2)), np.sort(rng.uniform(-1.0, 12.0, 300))
        at = np.union1d(at, t)
        right = np.column_stack([np.interp(at, t, column) for column in table.T])
        assert np.abs(columns(at, t, table) - right).max() < 1e-12


def test_friction_holds_a_joint_and_falls_as_it_slides() -> None:
    """A step smaller than what friction holds moves nothing, a larger one stops short of it; pulled
    along at a speed, it lags by Coulomb friction and what of the static one is left."""
    m, step, q = 4000, 1e-3, np.empty(4000)
    x, load = servo(0.0, 0.0, 0.3, 1e-4, 0.01), Load(*np.zeros((6, m)))
    x[STICKS], x[SLIPS] = 0.006, SLIP
    follow_alone(x, steers(np.full(m, 0.05)), load, np.zeros(2), step, q)
    assert abs(q[-1] - 0.034) < 1e-6
    follow_alone(x, steers(np.full(m, 0.0159)), load, np.zeros(2), step, q)
    assert not q.any()
    for speed in (0.05, 0.1, 0.3):
        goal = 0.016 + speed * step * (np.arange(m) + 0.5)
        follow_alone(x, steers(goal), load, np.array([0.0, speed]), step, q)
        left = 0.006 * max(0.0, 1.0 - speed / SLIP)
        lag = goal[-1] - q[-1] + 0.5 * speed * step
        assert abs(lag - (0.3 * speed + 0.01 + left)) < 1e-6, speed


def test_a_stop_within_a_step_makes_no_jump() -> None:
    """A joint that rings and sticks ends hardly elsewhere under 0.1 microrad more of friction."""
    step, m = 1e-3, 3000
    t = step * np.arange(1, m + 1)
    load = Load(np.full(m, 0.15), *np.zeros((5, m)))
    goal = steers(0.1 * np.sign(np.sin(2.0 * np.pi * t)))
    moved = []
    for rubs in 4e-3 + 1e-7 * np.arange(300):
        q = np.empty(m)
        follow_alone(servo(2e-3, 0.0, 5e-3, 1e-4, rubs), goal, load, np.zeros(2), step, q)
        moved.append(q)
    assert (np.diff(moved[0])[m // 2 :] == 0.0).any()
    assert np.abs(np.diff(moved, axis=0)).max() < 2e-6


@pytest.mark.parametrize("together", [True, False])
def test_a_hand_that_is_dragged_lags_by_what_rubs(together: bool) -> None:
    """On a gantry, pressed down: kp times the lag is damping and mu times what presses, and at rest
    no more than that."""
    arm = RigidArm.of(model_from_urdf(machine_urdf("gantry")))
    names, n = ("x", "y", "z", "r"), 4
    ground = Ground(3, np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.0, 50.0, 0.4)
    low = over_ground(arm, ground._replace(rubs=0.0), np.zeros((1, n)))[1][0] / ground.root
    kp, kd = np.array([4e3, 4e3, 4e3, 40.0]), np.array([400.0, 400.0, 400.0, 2.0])
    still = np.zeros(n)
    servos = ServoModel(names, kp, kd, still, still, still, np.zeros(n, bool), 0.0, ground)
    t = 1e-3 * np.arange(4000)
    q = np.zeros((len(t), n))
    q[:, 0] = 0.05 * np.clip(t, 0.0, 2.0)
    q[:, 2] = -low - 0.02
    orders = Commands((1e9 * t).astype(np.int64), np.full_like(q, np.nan), q)
    track = Track.of(Log(Path("drag"), names, orders.stamp_ns, q, q, q, commands=orders))
    moved = servos.follow(track, arm)
    if not together:  # by the load that the others' motion makes
        load = loads(arm, track.simulated(moved), ground)[0]
        x = servos.table()[0]
        follow_alone(x, track.goal(still, 0.0)[..., 0], load, track.start[:, 0], 1e-3, moved[:, 0])
    press = -ground.root * over_ground(arm, ground, moved)[1]
    drive = kp[0] * (track.commanded(0.0)[:, 0] - moved[:, 0])
    assert press[1500] > 10.0
    assert drive[1500] == pytest.approx(0.4 * press[1500] + kd[0] * 0.05, rel=0.02)
    assert 0.0 < drive[-1] < 0.41 * press[-1] and np.ptp(moved[-200:, 0]) < 1e-5


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[PositionArm, Path, Path]:
    folder = tmp_path_factory.mktemp("servo")
    arm = position_arm(31, Drawn(8.0))
    paths = folder / "seen.mcap", folder / "unseen.mcap"
    for path, kind in zip(paths, ("sines", "points"), strict=True):
        arm.moved(kind, 31).write(path)
    return arm, *paths


def test_the_command_finds_and_its_servos_foretell(recorded, tmp_path, capsys) -> None:
    arm, seen, unseen = recorded
    words = ["gap", str(seen), "--robot", "panda", "--quiet"]
    asked = [*words, "--hold-out", str(unseen), "--out", str(tmp_path / "one")]
    assert main(asked) == 0
    said = capsys.readouterr().out
    for part in ("position gain", "velocity gain", "ms late", "Coulomb", "viscous", "inertia"):
        assert part in said
    figures = json.loads((tmp_path / "one" / "gap.json").read_text())
    assert max(figures["after"]["tracking_rmse_rad"]) < 1e-4
    assert {f["effect"] for f in figures["findings"]} == {e for e, _ in arm.expected}
    assert (tmp_path / "one" / "report.html").read_text().count("<svg") == 8
    assert figures["after"]["hand_rmse_m"] < 1e-4 < figures["before"]["hand_rmse_m"]
    servos = str(tmp_path / "one" / "servo.toml")
    assert figures["servos_out"] == servos
    again = ["gap", str(unseen), "--robot", "panda", "--quiet", "--servo", servos]
    assert main([*again, "--out", str(tmp_path / "two")]) == 0
    assert "does what its servos' documentation says" in capsys.readouterr().out
    assert not json.loads((tmp_path / "two" / "gap.json").read_text())["findings"]


def test_what_does_not_belong_to_such_a_recording_is_refused(recorded, tmp_path, capsys) -> None:
    _, seen, _ = recorded
    words = ["gap", str(seen), "--robot", "panda", "--out", str(tmp_path / "out")]
    assert main([*words, "--tau-gain", "2"]) == 2
    assert "--tau-gain: for recordings with torques" in capsys.readouterr().err
    torque = tmp_path / "torque.mcap"
    signals = np.tile(0.1 + 0.01 * np.arange(20)[:, None], 7)
    log = Log(torque, PANDA.tree.joint_names, 10**6 * np.arange(20), *[signals] * 3)
    write_log(log, torque, {})
    assert read_position_log(torque) is None
    assert main([*words, "--hold-out", str(torque)]) == 2
    assert "give recordings of one kind" in capsys.readouterr().err
    asked = ["gap", str(torque), "--robot", "panda", "--servo", str(tmp_path / "none.toml")]
    assert main(asked) == 2
    assert "holds no position commands" in capsys.readouterr().err


def test_a_recording_too_short_or_at_rest_is_refused() -> None:
    recording = position_arm(24, Drawn(6.0)).moved("sines", 24)
    with pytest.raises(RecordingRefused, match="better 20 s"):
        explain([as_log(recording).piece(0, 500)], PANDA)
    rests = replace(recording, q=np.tile(recording.q[:1], (len(recording.q), 1)))
    with pytest.raises(RecordingRefused, match="too little motion"):
        explain([as_log(rests)], PANDA)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("x", "is not TOML"),
        ("delay_s = 0.1", r"needs a \[\[joint\]\]"),
        ("delay = 0.1\n[[joint]]\nname = 'a'\nposition_gain = 1", "does not know delay; have"),
        ("[[joint]]\nname = 'b'\nposition_gain = 1", "lacks the joints a; it has b"),
        ("[[joint]]\nname = 'a'\nposition_gain = -1", "position_gain must be a number"),
        ("[[joint]]\nname = 'a'", "position_gain must be a number"),
        ("[[joint]]\nname = 'a'\nposition_gain = 0", "must be more than 0"),
        ("[ground]\nup = 1\n[[joint]]\nname = 'a'\nposition_gain = 1", "needs the joint .one of a"),
    ],
)
def test_a_servo_file_is_checked(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "servo.toml"
    path.write_text(text)
    with pytest.raises(ModelError, match=said):
        read_servos(path, ("a",))


def test_a_servo_file_comes_back(tmp_path: Path) -> None:
    servos = position_arm(25).documentation
    ground = Ground(6, np.array([0.0, 0.01, 0.1]), np.array([0.0, 0.0, 1.0]), -0.02, 20.0)
    limits = {"stiction": 0.2, "torque_limit": 9.5, "dead_band": 2e-3, "backlash": 4e-3}
    limits["slip"] = 0.1
    servos = replace(servos, ground=ground, **{key: np.array(x) for key, x in limits.items()})
    servos.save(tmp_path / "servo.toml")
    back = read_servos(tmp_path / "servo.toml", servos.joint_names)
    keys = ("position_gain", "velocity_gain", "coulomb", "viscous", "armature", "feeds_speed")
    for key in (*keys, *limits):
        assert np.allclose(getattr(back, key), getattr(servos, key), rtol=1e-5), key
    assert back.delay_s == servos.delay_s
    assert back.ground.link == ground.link
    assert np.allclose(np.hstack(back.ground[1:]), np.hstack(ground[1:]))
    assert not np.delete(ServoModel.ideal(("a",)).table(), SLIPS).any()
