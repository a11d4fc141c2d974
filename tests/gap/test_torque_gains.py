"""Motor currents: recognised joint by joint, never where torques are N m; gains and truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapter.cli import main
from adapter.effects.robots import read_robot
from adapter.errors import SettingsError
from adapter.gap.torque_gains import as_told, learn_gains
from adapter.model.self_model import SelfModel
from adapter.screening.screen import RecordingRefused, check_torque, refuse
from adapter.signals.importer import table_log
from adapter.signals.matching import matching
from adapter.signals.source_signals import ImportSpec
from adapter.signals.told import Told
from drivers.files.mcap import Log, read_log, write_log
from tests.benchmarks.lambda_trials import robots_folder
from tests.helpers.driven_arm import JOINTS, LOAD_KG, currents, driven_arm, six_joints
from tests.helpers.robot_models import shared

BAGS = "data/unisa_bags"
NAMES = six_joints().tree.joint_names
# N m/A of a UR10's joints, as the maker of the bag states them (unisa-acg/inverse-dynamics-solver)
UR10_GAINS = np.array([13.5841, 14.2959, 11.3716, 11.2408, 11.7681, 11.7682])


def said_of(log: Log, model: SelfModel) -> str:
    with pytest.raises(RecordingRefused) as caught:
        refuse(log, model)
    assert caught.value.kind == "scale"
    with pytest.raises(RecordingRefused) as again:
        check_torque(log, model)
    assert str(again.value) == str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("seed", range(4))
def test_currents_are_recognised(seed: int) -> None:
    hidden = driven_arm(seed)
    said = said_of(currents(hidden, seed, 10.0), six_joints())
    for choice in ("--tau-gain fit", "--tau-gain G1,G2,...", "--gear", "motor current"):
        assert choice in said
    times = said.split("motor current: ")[1].split(" times")[0]
    named = said.split("effort of ")[1].split(" looks")[0].split(", ")
    told = dict(zip(named, map(float, times.split(", ")), strict=True))
    for name, gain in told.items():  # inertias are off by 15 % and more
        assert gain == pytest.approx(hidden.gain[NAMES.index(name)], rel=0.5), name
    assert len(told) >= 4


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("load_kg", [0.0, 3.0])
def test_newton_metres_pass(seed: int, load_kg: float) -> None:
    """With a gearbox's friction, all masses off by 15 %, 40 % by each link, and a load."""
    hidden = driven_arm(seed, spread=0.4)
    log = currents(hidden, seed, 10.0, load_kg)
    log = replace(log, tau=log.tau * hidden.gain)
    check_torque(log, six_joints())
    light = replace(six_joints(), theta=1.4 * six_joints().theta)
    check_torque(log, light)


def kuka() -> tuple[Log, SelfModel]:
    names = tuple(f"lwr_{k}_joint" for k in range(7))
    model = read_robot(shared("data/lwr4/kuka_lwr4.urdf"))
    spec = ImportSpec({"": shared("data/lwr4/measurements_1.npz")}, joint_names=names)
    return replace(table_log(spec), joint_names=model.tree.joint_names), model


def panda() -> tuple[Log, SelfModel]:
    return read_log(shared(f"{BAGS}/panda_exciting_trajectory.db3")), read_robot("panda")


def ur10() -> tuple[Log, SelfModel]:
    folder = robots_folder()
    if folder is None:
        pytest.skip("example-robot-data is not installed (extra [robots])")
    model = read_robot(folder / "ur_description/urdf/ur10_robot.urdf")
    return read_log(shared(f"{BAGS}/ur10_exciting_trajectory.db3")), model


@pytest.mark.parametrize("arm", [kuka, panda, ur10])
def test_real_logs_pass(arm) -> None:  # type: ignore[no-untyped-def]
    """The UR10's bag too: its friction and gravity are those of a UR10 in N m, not in A."""
    log, model = arm()
    check_torque(matching(log, model), model)
    with pytest.raises(RecordingRefused):
        check_torque(matching(replace(log, tau=log.tau / 10.0), model), model)


def test_a_real_arm_in_amperes() -> None:
    log, model = ur10()
    log = matching(log, model)
    log = replace(log, tau=log.tau / UR10_GAINS)
    said = said_of(log, model)
    assert "shoulder_pan_joint, shoulder_lift_joint, elbow_joint looks" in said
    found = learn_gains([log], model)
    assert found.shown[:3].all()
    assert np.abs(found.gain / UR10_GAINS - 1.0)[found.shown].max() < 0.1


@pytest.mark.slow
def test_one_known_mass_makes_gains_known() -> None:
    hidden = driven_arm(1)  # all masses 13.6 % heavier than documented
    bare, loaded = currents(hidden, 1), currents(hidden, 101, load_kg=LOAD_KG)
    found = learn_gains([bare, loaded], six_joints(), (False, True), LOAD_KG)
    assert found.shown.all()
    assert np.abs(found.gain / hidden.gain - 1.0).max() < 0.02
    assert np.abs((found.gain - hidden.gain) / found.std).max() < 3.0
    assert f"the known load, {LOAD_KG:g} kg" in found.words()[0]
    assert (found.held_out_nm < 0.1 * found.size_nm).all()
    heavier = learn_gains([bare, loaded], six_joints(), (False, True), 1.1 * LOAD_KG)
    assert np.median(heavier.gain / found.gain) == pytest.approx(1.1, abs=0.03)


def test_without_a_known_mass_the_scale_is_open() -> None:
    hidden = driven_arm(1)  # all masses 13.6 % heavier than documented
    found = learn_gains([currents(hidden, 1)], six_joints())
    ratio = (found.gain / hidden.gain)[found.shown]
    assert np.median(ratio) == pytest.approx(1.0 / hidden.scale, abs=0.03)
    assert "one known mass" in found.words()[0] and "--known-load" in found.words()[0]
    assert found.as_dict()["scale_open"] is True


def test_given_gains_and_gears_convert() -> None:
    log = currents(driven_arm(0), 0, 5.0)
    gains = tuple(np.arange(1.0, JOINTS + 1.0))
    (read,), _ = as_told([log], six_joints(), Told(gain=gains, gear=(100.0,)))
    np.testing.assert_allclose(read.tau, 100.0 * log.tau * gains)
    np.testing.assert_array_equal(read.q, log.q)
    turned = log.select(list(reversed(NAMES)), [])  # the recording's order is another
    (again,), _ = as_told([turned], six_joints(), Told(gain=gains))
    np.testing.assert_allclose(again.tau, log.tau * gains)
    (same,), _ = as_told([log], six_joints(), Told())
    assert same is log
    with pytest.raises(SettingsError, match="panda_joint6"):
        as_told([log], six_joints(), Told(gain=(1.0, 2.0)))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--tau-gain", "soon"], "fit"),
        (["--tau-gain", "1,0"], "other than zero"),
        (["--gear", "x"], "--gear 'x'"),
        (["--tau-gain", "1,2", "--tau-gain=1,2,3"], "or one for each"),
        (["--known-load", "2"], "--tau-gain fit"),
        (["--tau-gain", "fit", "--known-load", "-2"], "above zero"),
        (["--tau-gain", "1", "--loaded", "LOG"], "--known-load KG"),
    ],
)
@pytest.mark.parametrize("command", ["gap", "replay"])
def test_options_that_mean_nothing(command: str, options: list[str], said: str, tmp_path, capfd):  # type: ignore[no-untyped-def]
    log = tmp_path / "log.mcap"
    log.touch()
    robot = ["--robot", "panda"] if command == "gap" else []
    words = [str(log) if word == "LOG" else word for word in options]
    assert main([command, str(log), *robot, *words]) == 2
    assert said in " ".join(capfd.readouterr().err.split())


def test_commands_refuse_currents(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    log = currents(driven_arm(0), 0, 6.0)
    path = tmp_path / "amperes.mcap"
    write_log(log, path, {})
    assert main(["info", str(path), "--robot", "panda"]) == 0
    assert "looks like motor current" in " ".join(capfd.readouterr().out.split())
    for arguments in (["gap", str(path), "--robot", "panda"], ["replay", str(path)]):
        out = ["--out", str(tmp_path / arguments[0]), "--no-report"]
        assert main([*arguments, *out]) == 2
        assert "looks like motor current" in " ".join(capfd.readouterr().err.split())
