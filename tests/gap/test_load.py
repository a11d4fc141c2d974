"""The load at the hand: numbers within their standard deviations, in every robot's format."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from adapter.cli import main
from adapter.errors import ModelError
from adapter.gap.hand import hand_frame
from adapter.gap.load import HandLoad, as_json, find_load, robot_lines, sentence
from adapter.model.inertia import six_from_tensor
from adapter.model.self_model import FixedFrame
from adapter.model.spatial import rot_x
from drivers.files.mcap import Log, write_log
from sim.effects import Effect, payload, per_joint
from sim.truth import Truth
from tests.helpers.arm_data import Motion, arm, panda_model, record

FLANGE = np.array([0.0, 0.0, 0.107])  # m, of the Panda in its last link
SEEDS = range(20)
REST = Motion(3.0, 1, rests=((-2.0, 9.0),))  # no motion at all


@cache
def hidden(seed: int, share: float) -> tuple[Truth, Effect]:
    """An arm whose inertias are off by a share, with friction; and a load for its hand."""
    rng = np.random.default_rng([seed, 77])
    m = rng.uniform(0.3, 4.0)
    second = m * np.cov(rng.normal(size=(3, 8))) * rng.uniform(0.03, 0.06) ** 2
    com = FLANGE + np.array([0.0, 0.0, 0.08]) + rng.uniform(-0.1, 0.1, 3)
    theta = arm().theta * rng.normal(1.0, share, (7, 1))
    theta[:, 1:4] *= rng.normal(1.0, share, (7, 3))
    rubbing = per_joint("coulomb_friction", "Fc", rng.uniform(0.1, 0.5, 7).tolist())
    rubbing += per_joint("viscous_friction", "Fv", rng.uniform(0.02, 0.1, 7).tolist())
    load = payload(m, com, np.trace(second) * np.eye(3) - second)
    return arm().with_changes(theta=theta, effects=rubbing), load


def logs(seed: int, share: float, motion: Motion) -> tuple[Log, Log, Effect]:
    """With the load, without it, and the load."""
    bare, load = hidden(seed, share)
    loaded = bare.with_changes(effects=[*bare.effects, load])
    other = replace(motion, seed=motion.seed + 100)
    return record(loaded, motion).log(), record(bare, other).log(), load


def off(found: HandLoad, load: Effect) -> np.ndarray:
    """(10,) errors of mass, centre and inertia in standard deviations."""
    com = np.array([load.number(key) for key in ("cx", "cy", "cz")]) - FLANGE
    return np.r_[
        (found.mass - load.number("m")) / found.mass_std,
        (found.com - com) / found.com_std,
        (six_from_tensor(found.inertia) - load.parameters["inertia"])
        / six_from_tensor(found.inertia_std),
    ]


BESIDE_EMPTY = pytest.param(True, id="log without load", marks=pytest.mark.slow)


@pytest.mark.parametrize("with_empty", [pytest.param(False, id="documented arm"), BESIDE_EMPTY])
def test_standard_deviations_are_honest(with_empty: bool) -> None:
    share, z = 0.1 if with_empty else 0.03, []
    for seed in SEEDS:
        log, empty, load = logs(seed, share, Motion(3.0, seed))
        found = find_load(log, panda_model(), empty if with_empty else None)
        assert found.is_there
        assert found.mass_std < (0.02 if with_empty else 0.2)
        z.append(off(found, load))
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    assert (rms > 0.2).all() and (rms < 1.5).all(), rms
    assert np.abs(z).max() < 4.0


def test_at_rest_the_mass_shows_and_the_inertia_does_not() -> None:
    log, empty, load = logs(5, 0.03, REST)
    alone = find_load(log, panda_model())
    assert alone.is_there and abs(off(alone, load)[0]) < 4.0 and not alone.inertia_shown
    assert any("hardly moves" in note for note in alone.notes)
    told = as_json(alone)
    assert told["inertia_kg_m2"] is None and "inertia about it: not shown" in told["sentence"]
    against = find_load(log, panda_model(), empty)
    # what static friction holds is not the same in two rests
    assert against.mass_std < 0.2 * alone.mass_std and abs(off(against, load)[0]) < 4.0


def test_an_empty_hand_carries_nothing() -> None:
    _, empty, _ = logs(3, 0.02, Motion(4.0, 3))
    found = find_load(empty, panda_model())
    assert not found.is_there and abs(found.mass) < 4.0 * found.mass_std
    assert sentence(found).startswith("no load is shown") and not robot_lines(found)
    assert as_json(found)["com_m"] is None


def test_inertia_shows_in_ten_seconds_in_the_frame_asked_for() -> None:
    """Against Pinocchio's way to change frames."""
    log, _, load = logs(12, 0.02, Motion(10.0, 12))
    grip = FixedFrame("grip", "grip_joint", "panda_link7", rot_x(0.7), np.array([0.1, 0.0, 0.2]))
    model = replace(panda_model(), frames=(*panda_model().frames, grip))
    flange, there = find_load(log, model), find_load(log, model, frame="grip")
    assert flange.inertia_shown and np.abs(off(flange, load)).max() < 4.0
    assert (flange.left_nm < 0.1 * flange.before_nm)[1:6].all()
    assert (flange.frame, there.frame) == ("panda_link8", "grip")
    place = pin.SE3(grip.rotation, grip.position - FLANGE)
    body = place.actInv(pin.Inertia(flange.mass, flange.com, flange.inertia))
    assert there.mass == pytest.approx(body.mass)
    np.testing.assert_allclose(there.com, body.lever, atol=1e-9)
    np.testing.assert_allclose(there.inertia, body.inertia, atol=1e-9)
    tool = FixedFrame("arm_tool0", "j", "panda_link7", np.eye(3), np.zeros(3))
    assert hand_frame(replace(model, frames=(*model.frames, tool))).name == "arm_tool0"
    with pytest.raises(ModelError, match=r"no frame 'thumb'.*have: panda_link7, panda_link8, grip"):
        hand_frame(model, "thumb")


def test_every_robot_gets_its_numbers_in_its_order() -> None:
    inertia = np.array([[0.011, 0.001, 0.002], [0.001, 0.012, 0.003], [0.002, 0.003, 0.013]])
    com, little = np.array([0.01, -0.02, 0.03]), 1e-4 * np.ones((3, 3))
    load = HandLoad(1.25, com, inertia, 0.01, 1e-3 * np.ones(3), little, "flange")
    lines = robot_lines(load)
    nine = "0.011, 0.001, 0.002, 0.001, 0.012, 0.003, 0.002, 0.003, 0.013"
    assert lines["libfranka"] == f"robot.setLoad(1.25, {{{{0.01, -0.02, 0.03}}}}, {{{{{nine}}}}});"
    assert json.loads(lines["Franka Desk"]) == {
        "mass": 1.25,
        "centerOfMass": [0.01, -0.02, 0.03],
        "transformation": np.eye(4).ravel().tolist(),
        "inertia": inertia.ravel().tolist(),
    }
    assert lines["UR"] == "set_payload(1.25, [0.01, -0.02, 0.03])"
    six = "[0.011, 0.012, 0.013, 0.001, 0.002, 0.003]"
    assert lines["UR, PolyScope 5.10 on"].endswith(f"[0.01, -0.02, 0.03], {six})")
    unknown = replace(load, inertia_std=inertia)
    assert json.loads(robot_lines(unknown)["Franka Desk"])["inertia"] == 9 * [0.0]


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, empty, load = logs(2, 0.02, Motion(3.0, 2))
    write_log(log, tmp_path / "log.mcap", {})
    write_log(empty, tmp_path / "empty.mcap", {})
    command = ["load", str(tmp_path / "log.mcap"), "--empty", str(tmp_path / "empty.mcap")]
    assert main([*command, "--json", "-"]) == 0
    said = capsys.readouterr()
    figures = json.loads(said.out)
    assert figures["mass_kg"] == pytest.approx(load.number("m"), abs=0.05)
    assert "the hand carries" in said.err and "robot.setLoad(" in said.err
    for wrong, told in (
        (["--frame", "thumb"], "panda_link8"),
        (["--inertia-prior", "2"], "(0, 1]"),
        (["--empty", str(tmp_path / "gone.mcap")], "gone.mcap"),
    ):
        assert main([*command[:2], *wrong]) == 2
        assert told in capsys.readouterr().err
