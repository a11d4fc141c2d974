"""Laws of no catalogue: what a file names them, their torque, and that they are found.

And an effect of one's own, in thirty lines: learned, named, rolled out and exported.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.interpolate import BSpline

import adapter
from adapter.cli.main import main
from adapter.cli.names import effects_named
from adapter.effects.active import active_effects, by_joint
from adapter.effects.base import Array, LinearEffect, Parameter, Values
from adapter.effects.by_joint import JointSignals
from adapter.effects.catalogue import CATALOGUE, registered
from adapter.effects.kept import keep, read_kept, with_kept
from adapter.effects.law import CURVES, LAWS, Curve, Law, splines
from adapter.effects.phrases import SPEEDS, Phrase, experiments
from adapter.effects.robots import robot_urdf
from adapter.errors import SettingsError
from adapter.gap.result import GapResult
from adapter.gap.words import as_json, headline
from adapter.gap.workflow import find_gap
from adapter.learning.known_effects import as_told, learnable, not_learned
from adapter.model.model_file import load_model
from adapter.model.robots import documented
from adapter.model.self_model import SelfModel
from adapter.model.urdf_text import DAMPING, Additions
from adapter.physics.rigid_arm import RigidArm
from adapter.simulate import SIMULATORS
from drivers.files.mcap import Log
from tests.helpers.arm_data import Motion, arm, panda_model, record, trajectory
from tests.helpers.robot_models import entry
from tests.simulate.test_effects import READY

N, J = 7, 1  # joints; the one that has a law, from 0
PANDA = documented("panda")
Q, DQ, DDQ = (x[::40] for x in trajectory(Motion(8.0, seed=3)))
TAU = RigidArm.of(PANDA).torque(Q, DQ, DDQ)
# By formulas of the test's own, of signals of the joint itself or of joint 3.
FORMULAS: dict[str, Callable[..., np.ndarray]] = {
    "law: dq |dq|": lambda q, v, a, tau, x: v * np.abs(v),
    "law: max(a - q, 0)²": lambda q, v, a, tau, x: np.where(q < x, (q - x) ** 2, 0.0),
    "law: sign(tau) max(|tau| - a, 0)": lambda q, v, a, tau, x: tau - np.clip(tau, -x, x),
    "law: dq3 |dq3|": lambda q, v, a, tau, x: v * np.abs(v),
}


def values_of(law: Law | Curve) -> dict[str, Any]:
    """Parameters that none of its own defaults are."""
    if isinstance(law, Curve):
        return {"x": list(np.linspace(-1.0, 2.0, 8) ** 2), "low": -0.5, "high": 0.4}
    return {"c": 0.7} | {p.key: max(0.4, 1.4 * p.lower) for p in law.parameters[1:]}


def entries_of(laws: Sequence[Law | Curve]) -> list[dict[str, Any]]:
    """Of a model, joint after joint; what goes with the load is a hundredth."""
    entries = []
    for k, law in enumerate(laws):
        values = values_of(law)
        key = law.parameters[0].key
        values |= {key: np.multiply(0.01, values[key]).tolist()} if law.by_load else {}
        entries.append(entry(law.name, [k % N + 1], **values))
    return entries


def torque_of(law: Law | Curve, values: dict[str, Any]) -> np.ndarray:
    """(m, n) that a model with the law on a joint says more than one without."""
    model = replace(PANDA, effects=(entry(law.name, [J + 1], **values),))
    return np.asarray(adapter.inverse_dynamics(model, Q, DQ, DDQ)) - TAU


@pytest.mark.parametrize("name", FORMULAS)
def test_a_law_is_what_its_name_says(name: str) -> None:
    k = 2 if "3" in name else J
    own = FORMULAS[name](Q[:, k], DQ[:, k], DDQ[:, k], TAU[:, k], 0.4)
    said = torque_of(LAWS[name], values_of(LAWS[name]))
    np.testing.assert_allclose(said[:, J], 0.7 * own, rtol=1e-9, atol=1e-9)
    assert not np.delete(said, J, axis=1).any()


@pytest.mark.parametrize(
    "law", [x for x in (LAWS | CURVES).values() if x.by in (0, 3)], ids=lambda x: x.name
)
def test_one_instant_shows_as_much_as_a_table(law: Law | Curve) -> None:
    values = values_of(law)
    sums = by_joint(active_effects([entry(law.name, [J + 1], **values)], N), N)
    for row in (3, 80, 150):
        at = JointSignals(Q[row], DQ[row], DDQ[row], TAU[row])
        whole = torque_of(law, values)[row]
        np.testing.assert_allclose(sums.torque(at), whole, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("simulator", list(SIMULATORS))
@pytest.mark.parametrize(
    "name", [*FORMULAS, "law: ddq |ddq|", "law: sign(dq3)", "law: tau²", "law: dq q", "drag"]
)
def test_a_law_acts_in_the_simulators(name: str, simulator: str) -> None:
    """What a step does to the motion is, at its middle, what the model says that torques do."""
    law, q0, strength = {**LAWS, **CATALOGUE}[name], READY, np.array([4.0] * 4 + [0.6, 0.6, 0.3])
    values = values_of(law) | ({"c": 0.1} if "tau" in name else {})
    model = replace(PANDA, effects=(entry(name, [J + 1], **values),))
    drive = strength * np.sin(np.outer(1e-3 * np.arange(200), 5.0 + np.arange(N)) + 1.0)
    drive += np.asarray(adapter.inverse_dynamics(PANDA, q0, *np.zeros((2, N))))
    own = SIMULATORS[simulator](model)
    own.place(q0, 0.1 * strength)
    states = [own.state()]
    for tau in drive:
        own.step(tau)
        states.append(own.state())
    own.close()
    q, dq = np.array(states).swapaxes(0, 1)
    middle = 0.5 * (q[1:] + q[:-1]), 0.5 * (dq[1:] + dq[:-1]), np.diff(dq, axis=0) / 1e-3
    with_law, without = (np.asarray(adapter.inverse_dynamics(x, *middle)) for x in (model, PANDA))
    assert np.abs(with_law - drive)[5:].max() < 0.01 < 0.05 < np.ptp((with_law - without)[:, J])


def test_units_are_those_of_torque_over_signals() -> None:
    units = {law.name: law.parameters[0].unit for law in LAWS.values()}
    assert units["law: dq |dq|"] == "N m s2/rad2" and units["law: tau²"] == "1/N m"
    assert units["law: sign(dq3)"] == "N m" and units["law: ddq |ddq|"] == "N m s4/rad2"
    assert units["law: tau3"] == "" and not set(units) & set(CATALOGUE)


class Hidden(NamedTuple):
    """A law on a joint of a simulated arm: name, rms in N m, what it is of angles and speeds."""

    name: str
    size_nm: float
    column: Callable[[np.ndarray, np.ndarray], np.ndarray]

    def recorded(self) -> tuple[Log, float]:
        """A recording, and the law's coefficient."""
        data = record(arm(), Motion(15.0, seed=4))
        torque = self.column(*data.true[:2])
        c = self.size_nm / float(torque.std())
        return replace(data, tau=data.tau + c * np.outer(torque, np.eye(N)[J])).log(), c


HOSE = Hidden("law: max(q - a, 0)", 0.4, lambda q, v: np.maximum(q[:, J] - np.median(q[:, J]), 0.0))
LAWS_HIDDEN = [
    Hidden("law: dq³", 0.5, lambda q, v: v[:, J] ** 3),
    HOSE,
    Hidden("law: dq4 |dq4|", 0.3, lambda q, v: v[:, 3] * np.abs(v[:, 3])),
]


@cache
def answer(law: Hidden) -> GapResult:
    return find_gap([law.recorded()[0]], panda_model())


@pytest.mark.parametrize("law", LAWS_HIDDEN, ids=lambda law: law.name)
def test_a_hidden_law_is_found_and_joins_the_model(law: Hidden) -> None:
    result, c = answer(law), law.recorded()[1]
    (found,) = result.findings
    assert (found.effect, found.joints) == (law.name, (J + 1,)), headline(result)
    assert abs(found.parameters["c"] - c) < 3.0 * found.std["c"] < 0.5 * c
    assert result.unexplained == ()
    assert result.after.torque_rmse_nm[J] < 1.25 * result.noise_floor_nm[J]
    assert f"a torque of c {law.name.removeprefix('law: ')}: c = " in headline(result)
    (note,) = [x for x in result.notes if x.startswith("joint 2: a torque")]
    energy = {"law: dq³": "takes energy", HOSE.name: "stores energy"}
    assert energy.get(law.name, "feeds energy in: ") in note


def test_a_law_that_one_of_two_recordings_has_is_told_of_that_one() -> None:
    (with_hose, c), without = HOSE.recorded(), record(arm(), Motion(15.0, seed=5)).log()
    logs = [replace(log, path=Path(name)) for log, name in ((without, "a"), (with_hose, "b"))]
    (found,) = find_gap(logs, panda_model()).findings
    assert (found.effect, found.joints, found.recording) == (HOSE.name, (J + 1,), "b")
    assert abs(found.parameters["c"] - c) < 3.0 * found.std["c"] < 0.5 * c


def test_splines_are_scipys() -> None:
    """And beyond their range they stay as at its end."""
    x = np.linspace(-2.0, 3.0, 101)
    knots = -2.0 + np.arange(-3, 9)
    own = BSpline.design_matrix(np.minimum(x, 3.0 - 1e-9), knots, 3).toarray().T
    np.testing.assert_allclose(splines(x, -2.0, 3.0), own, atol=1e-8)
    ends = (np.array(splines(moved, -2.0, 3.0))[:, -1] for moved in (x + 9.0, x))
    assert np.array_equal(*ends)


def test_what_no_expression_is_joins_the_model_as_a_curve() -> None:
    hidden = Hidden("law: curve(dq)", 0.5, lambda q, v: v[:, J] / (1.0 + 20.0 * v[:, J] ** 2))
    result, c = answer(hidden), hidden.recorded()[1]
    (found,) = [f for f in result.findings if f.effect.startswith("law: ")]
    assert (found.effect, found.joints) == (hidden.name, (J + 1,)), headline(result)
    assert not any(x.joint == J + 1 for x in result.unexplained)
    assert result.after.torque_rmse_nm[J] < 0.4 * result.before.torque_rmse_nm[J]
    assert "by no formula" in headline(result)
    curve = found.curve
    assert curve is not None and curve["over"] == "dq2" and len(curve["at"]) > 20
    away = curve["torque_nm"] - c * curve["at"] / (1.0 + 20.0 * curve["at"] ** 2)
    assert np.mean(np.abs(away) < 2.0 * curve["std_nm"]) > 0.9


IN_MODEL: list[tuple[str, int, dict[str, float]]] = [
    ("law: max(q - a, 0)²", 2, {"c": 4.0, "a": 0.04}),
    ("law: dq3 |dq3|", 1, {"c": 1.5}),
    ("law: dq sin(n q + phase)", 4, {"c": 2.0, "n": 3.0, "phase": 0.4}),
    ("law: dq³", 7, {"c": 0.8}),
    ("drag", 6, {"c": 1.2}),
    ("law: tau²", 5, {"c": 0.02}),
]


def test_coefficients_of_laws_in_a_model_are_learned_on() -> None:
    """Where the model's are 30 % off, as those of an effect of one's own; or it is said."""
    entries = [entry(x, [j], **v) for x, j, v in IN_MODEL]
    data = record(arm(), Motion(20.0, seed=4))
    bare, true = panda_model(), replace(panda_model(), effects=tuple(entries))
    more, rigid = (np.asarray(adapter.inverse_dynamics(x, *data.true[:3])) for x in (true, bare))
    log = replace(data, tau=data.tau + more - rigid).log()
    off = [entry(x, [j], **(v | {"c": 0.7 * v["c"]})) for x, j, v in IN_MODEL]
    learned = adapter.learn(log, replace(bare, effects=(*off[:-1], entries[-1])), every=4)
    found = {(e["effect"], e["joints"][0]): e for e in learned.model.effects}
    assert found.pop(("law: tau²", 5)) == entries[-1]
    for name, joint, values in IN_MODEL[:-1]:
        own = found.pop((name, joint))
        c, doubt = own["parameters"]["c"], own["std"]["c"]
        assert abs(c - values["c"]) < max(3.0 * doubt, 0.05 * values["c"]) < 0.3 * values["c"]
        assert own["parameters"] == {**values, "c": c}
    assert not any(name.startswith("law") for name, _ in found)
    names = learnable(learned.model, ())
    assert set(names) == set(learned.effects) and "law: max(q - a, 0)² at a = 0.04" in names
    *_, said = not_learned(learned.model, names)
    assert said.startswith("joint 5: torque of c tau², stays as it is")


def test_a_kept_law_is_learned_at_the_setting_that_the_model_has(tmp_path: Path) -> None:
    name, joint, _ = IN_MODEL[0]
    model = replace(PANDA, effects=(entry(name, [joint], c=4.0, a=0.05),))
    file = tmp_path / "own.toml"
    file.write_text('[hose]\nlaw = "max(q - a, 0)²"\nc = 4.0\na = 0.04\n')
    named = effects_named(f"torque_offset,{file}")
    assert as_told(model, named) == ("torque_offset", f"{name} at a = 0.05")
    assert as_told(PANDA, named) == ("torque_offset", f"{name} at a = 0.04")


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    """A file with the hose of joint 2, kept by the command line."""
    (tmp_path / "gap.json").write_text(json.dumps(as_json(answer(HOSE)), default=np.ndarray.tolist))
    file = tmp_path / "own.toml"
    words = ["keep", str(tmp_path), "--as", "hose_joint_2", "--effects", str(file)]
    assert main(["effects", *words]) == 0
    return file


def test_a_kept_law_is_looked_for_by_its_name(kept: Path, tmp_path: Path) -> None:
    """The new model can be read by whoever has not the file."""
    out = tmp_path / "model.json"
    with with_kept(kept):
        assert "hose_joint_2" in CATALOGUE
        result = find_gap([HOSE.recorded()[0]], panda_model(), model_out=out)
    (found,) = result.findings
    assert found.effect == "hose_joint_2" and found.joints == (J + 1,)
    assert HOSE.name not in found.overlaps and found.evidence > 0.99
    (entry,) = [e for e in load_model(out).effects if e["joints"] == [J + 1]]
    assert entry["effect"] == HOSE.name and "hose_joint_2" not in CATALOGUE


def test_the_command_lists_kept_laws_too(kept: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["effects", "--effects", str(kept)]) == 0
    said = capsys.readouterr().out
    assert "hose_joint_2" in said and "bristle_friction" in said and "tanh(tau/a)" in said


def test_a_kept_law_is_learned_beside_others(tmp_path: Path) -> None:
    file = tmp_path / "own.toml"
    file.write_text('[oil]\nlaw = "dq |dq|"\nc = 0.7\n')
    assert effects_named(f"viscous_friction,{file}") == ("viscous_friction", "law: dq |dq|")
    file.write_text('[hose]\nlaw = "max(q - a, 0)"\nc = 2.0\na = 0.1\n')
    assert effects_named(str(file)) == ("law: max(q - a, 0) at a = 0.1",)
    file.write_text('[gear]\nlaw = "tau²"\nc = 2.0\n')
    with pytest.raises(SettingsError, match=r"\[gear\] is c tau²: .* not learned"):
        effects_named(str(file))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("x = [", "not TOML"),
        ("", "holds no law"),
        ("[hose]\n", "needs law"),
        ('[hose]\nlaw = "dq |dq"\n', "did you mean dq |dq|"),
        ('[hose]\nlaw = "max(q - a, 0)"\nc = 2.0\n', "needs the number a (rad)"),
        ('[hose]\nlaw = "dq³"\n', "needs the number c (N m s3/rad3)"),
        ('[payload]\nlaw = "dq |dq|"\n', "there is an effect 'payload' already"),
    ],
)
def test_a_file_that_is_not_right_is_refused(text: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / "own.toml"
    file.write_text(text)
    with pytest.raises(SettingsError, match=re.escape(said)):
        read_kept(file)


def test_what_cannot_be_kept_is_said(kept: Path, tmp_path: Path) -> None:
    for name, joint, said in (
        ("hose_joint_2", None, "is there already"),
        ("other", 5, "no such law; have: joint 2: max(q - a, 0)"),
        ("Hose", None, "small letters"),
    ):
        with pytest.raises(SettingsError, match=re.escape(said)):
            keep(tmp_path, name, joint, kept)
    curve = {"effect": "law: curve(dq)", "joints": [2]}
    (tmp_path / "gap.json").write_text(json.dumps({"findings": [curve]}))
    with pytest.raises(SettingsError, match="no such law; have: none"):
        keep(tmp_path, "other", None, kept)
    (tmp_path / "gap.json").write_text("{}")
    with pytest.raises(SettingsError, match="no result of"):
        keep(tmp_path, "other", None, kept)


C = 1.2  # that joint J has, N m s²/rad²


class Drag(LinearEffect):
    """Torque that grows with the square of the speed: a joint that stirs oil."""

    name = "drag"
    title = "drag"
    parameters = (Parameter("c", "N m s2/rad2"),)
    prior_std = 1.0
    positive = ("c",)
    phrase = Phrase("{who} {lacks} {x} of drag", "c")
    shows = ((SPEEDS, "grows with the square of the speed"),)

    def column(self, at: JointSignals) -> Array:
        """dq |dq|."""
        return np.asarray(at.dq * np.abs(at.dq))

    def export(self, more: Additions, joint: int, values: Values) -> str | None:
        """Its slope at 0.5 rad/s, as damping."""
        return more.at_joint(DAMPING, joint, values["c"], "its slope at 0.5 rad/s is damping")


@pytest.fixture(autouse=True)
def drag() -> Iterator[Drag]:
    own = Drag()
    with registered(own):
        yield own
    assert own.name not in CATALOGUE


def with_drag() -> SelfModel:
    return replace(panda_model(), effects=(entry("drag", [J + 1], c=C),))


def test_it_is_named() -> None:
    data = record(arm(), Motion(15.0, seed=4))
    dq = data.true[1]
    tau = data.tau + C * dq * np.abs(dq) * np.eye(N)[J]
    result = find_gap([replace(data, tau=tau).log()], panda_model())
    (found,) = [f for f in result.findings if f.effect == "drag"]
    assert found.joints == (J + 1,)
    assert abs(found.parameters["c"] - C) < min(5.0 * found.std["c"], 0.1)
    assert found.std["c"] < 0.06
    assert "joint 2 lacks" in headline(result) and "of drag" in headline(result)
    assert len(result.findings) == 1


def test_it_is_told_from_all_others(drag: Drag) -> None:
    for other in set(CATALOGUE.values()) - {drag}:
        (said,) = experiments(drag, [other])
        assert "drag" in said and other.title in said


def test_it_is_exported() -> None:
    text = robot_urdf(with_drag(), alone=True).text
    assert f'<dynamics damping="{C}" />' in text and text.count("<dynamics") == 1
    assert "its slope at 0.5 rad/s is damping\n      panda_joint2: " in text
    assert robot_urdf(with_drag()).left_out == ("drag",)
