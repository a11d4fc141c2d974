"""Logs as they come: a pause, a clock that steps, readings that no arm makes, another's torques."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import adapter
from adapter.cli import main
from adapter.errors import ModelWarning
from adapter.gap.load import HandLoad, find_load
from adapter.physics.rigid_arm import RigidArm
from adapter.screening.screen import RecordingRefused, check_torque, stuck
from drivers.files.mcap import Log, write_log
from sim.effects import payload, per_joint
from tests.helpers.arm_data import Motion, arm, panda_model, record

LOAD_KG, AT = 1.0, (0.0, 0.0, 0.15)
SPIKES = 40


@cache
def base(gravity: tuple[float, ...] = (0.0, 0.0, -9.81)) -> Log:
    """8 s of an arm with friction and 1 kg in its hand."""
    held = payload(LOAD_KG, np.array(AT), 1e-3 * np.eye(3))
    rubbing = per_joint("coulomb_friction", "Fc", [0.3] * 7)
    truth = arm().with_changes(effects=[*rubbing, held], gravity=np.array(gravity))
    return record(truth, Motion(8.0, 5)).log()


def without(begin_s: float, end_s: float) -> Log:
    at_s = 1e-9 * (base().stamp_ns - base().stamp_ns[0])
    return base().take((at_s < begin_s) | (at_s >= end_s))


def stepped(by_s: float) -> Log:
    log = base()
    late = np.arange(len(log)) > len(log) // 2
    return replace(log, stamp_ns=log.stamp_ns + late * round(1e9 * by_s))


def frozen() -> Log:
    log, rows = base(), np.arange(len(base()))
    held = np.where((rows > 4000) & (rows < 5250), 4000, rows)
    return replace(log, q=log.q[held], dq=log.dq[held], tau=log.tau[held])


def some_rows() -> np.ndarray:
    rng = np.random.default_rng(3)
    return np.isin(np.arange(len(base())), rng.choice(len(base()), SPIKES, replace=False))


def spiked(times: float) -> Log:
    return replace(base(), tau=np.where(some_rows()[:, None], times * base().tau, base().tau))


def silent_bursts() -> Log:
    burst = (np.arange(len(base())) % 1000 // 100 == 2)[:, None]
    return replace(base(), tau=np.where(burst, 0.0, base().tau))


def one_wild() -> Log:
    tau = base().tau.copy()
    tau[3000, 1] = 2.7e154
    return replace(base(), tau=tau)


def unheard(joint: int, begin: int, end: int) -> Log:
    """A torque that stays as it was."""
    tau = base().tau.copy()
    tau[begin:end, joint] = tau[begin, joint]
    return replace(base(), tau=tau)


def late(by_ms: int) -> Log:
    return replace(base().take(slice(by_ms, None)), tau=base().tau[: len(base()) - by_ms])


UNHEARD = {
    "panda_joint2 never changes": lambda: unheard(1, 0, len(base())),
    "panda_joint5 never changes": lambda: unheard(4, 0, len(base())),
    "panda_joint4 stays the same for 2 s": lambda: unheard(3, 3000, 5000),
    "come 80 ms after the motion": lambda: late(80),
}
ODD = {
    "pause of 1 s": lambda: without(3.0, 4.0),
    "pause of 3 s": lambda: without(2.5, 5.5),
    "clock steps on by an hour": lambda: stepped(3600.0),
    "clock put back by a second": lambda: stepped(-1.0),
    "all signals stand still": frozen,
    "spikes of 50 times": lambda: spiked(50.0),
    "single torques of zero": lambda: spiked(0.0),
    "bursts of zeros": silent_bursts,
    "one torque of 2.7e154": one_wild,
    **UNHEARD,
}


@pytest.mark.parametrize("name", ODD)
def test_the_load_is_that_of_the_log_without_the_flaw(name: str) -> None:
    found = find_load(ODD[name](), panda_model())
    assert abs(found.mass - LOAD_KG) < 3.0 * found.mass_std < 0.3
    assert found.left_nm.max() < 0.5


def test_what_was_left_out_is_told() -> None:
    found = adapter.find_gap(spiked(50.0), panda_model())
    assert any(f"{SPIKES} samples hold" in note for note in found.notes)
    assert [x.effect for x in found.findings if x.effect == "payload"] == ["payload"]


@cache
def friction_of(name: str) -> tuple[dict[int, tuple[float, float]], set[str], str]:
    """By joint, with its deviation; everything that is named; notes."""
    found = adapter.find_gap(UNHEARD[name]() if name else base(), panda_model())
    rubs = [x for x in found.findings if x.effect == "coulomb_friction"]
    sizes = {x.joints[0]: (x.parameters["Fc"], x.std["Fc"]) for x in rubs}
    return sizes, {x.effect for x in found.findings}, " ".join(found.notes)


@pytest.mark.parametrize("said", UNHEARD)
def test_a_torque_that_is_not_measured_costs_its_own_joint_and_time_alone(said: str) -> None:
    sizes, named, notes = friction_of(said)
    usual, as_ever, _ = friction_of("")
    dead = int(said[11]) if "never" in said else None
    assert named == as_ever
    assert set(sizes) == set(usual) - {dead}
    assert all(abs(sizes[j][0] - usual[j][0]) < 3.0 * sizes[j][1] for j in sizes)
    assert said in notes


def test_ten_milliseconds_late_are_a_delay_and_no_low_pass() -> None:
    found = adapter.find_gap(late(10), panda_model())
    timing = [x for x in found.findings if x.effect in ("signal_delay", "torque_filter")]
    assert [(x.effect, x.joints) for x in timing] == [("signal_delay", ())]
    assert abs(timing[0].parameters["d"] - 0.01) < 3.0 * timing[0].std["d"] < 2e-3


@pytest.mark.parametrize("name", [*UNHEARD, "bursts of zeros"])
def test_who_learns_is_given_torques_of_the_arm_alone(name: str) -> None:
    log, _, _ = check_torque(ODD[name](), panda_model())
    _, ours, theirs = np.intersect1d(log.stamp_ns, base().stamp_ns, return_indices=True)
    off = np.sqrt(np.mean((log.tau[ours] - base().tau[theirs]) ** 2, axis=0))
    assert len(log) > 0.95 * len(base()) and off.max() < 1.0


def test_a_base_that_stands_askew_is_told_and_learned_on() -> None:
    along = (0.34, -0.2, -9.8021)  # two degrees, with 1 kg in the hand
    log, stands, said = check_torque(base(along), panda_model())
    np.testing.assert_allclose(stands.gravity, along, atol=0.03)
    assert len(log) == len(base(along)) and "stands askew" in said[0] and "--gravity 0.3" in said[0]
    assert abs(find_load(base(along), panda_model()).mass - LOAD_KG) < 0.05
    _, level, said = check_torque(base(), panda_model())
    assert np.array_equal(level.gravity, panda_model().gravity) and not said


def test_an_arm_that_rests_may_well_hold_the_same_torque() -> None:
    t, tau = 1e-3 * np.arange(2000), np.broadcast_to(base().tau[0], (2000, 7))
    assert not stuck(t, 0.01 * np.ones_like(tau), tau).any()
    assert stuck(t, np.ones_like(tau), tau).all()
    assert not stuck(t[:1], np.ones_like(tau[:1]), tau[:1]).any()


def test_a_sensor_that_ends_is_told_by_its_noise_and_no_pause_is_a_stay() -> None:
    t, rng = 1e-3 * np.arange(3000), np.random.default_rng(1)
    slow, noise = np.full((3000, 1), 0.04), rng.standard_normal((3000, 1))
    slow[0] = 0.1
    clipped = np.minimum(5.0 * np.sin(t)[:, None] + 0.1 * noise, 3.0)
    assert (stuck(t, slow, clipped) == (clipped == 3.0)).all()
    rests = np.minimum(5.0 * np.sin(t)[:, None], 3.0)
    rests[:1000] = 1.0  # without noise it may well rest at the end of its range
    assert not stuck(t, slow, rests).any()
    noise[1500] = noise[1501]
    assert not stuck(t + 60.0 * (t > 1.5005), 10.0 * slow, noise).any()


def test_pauses_that_leave_no_second_together_are_told() -> None:
    short = base().take(slice(0, 2200))
    late = (np.arange(2200) > 1100) * 60_000_000_000
    log = replace(short, stamp_ns=short.stamp_ns + late)
    with pytest.raises(ValueError, match=r"at most 1\.10 s without a pause"):
        adapter.find_gap(log, panda_model())
    found = find_load(log, panda_model())  # needs no more than the instants beside the pause
    assert abs(found.mass - LOAD_KG) < 3.0 * found.mass_std < 1.0


def test_a_log_of_pauses_leaves_nothing_to_weigh_by() -> None:
    log = base().take(np.arange(len(base())) % 500 < 300)
    with pytest.raises(RecordingRefused, match="its pauses leave 0 s to weigh by"):
        find_load(log, panda_model())


WRONG = {
    "sign": lambda tau: tau * np.where(np.arange(7) == 1, -1.0, 1.0),
    "scale": lambda tau: 100.0 * tau,
    "torque": np.zeros_like,
    "order": lambda tau: tau[:, [0, 3, 2, 1, 4, 5, 6]],
    "torque, rounded": lambda tau: 8.0 * np.round(tau / 8.0),
}


def turned(joint: int) -> Log:
    way = 1.0 - 2.0 * np.eye(7)[joint]
    return replace(base(), q=base().q * way, dq=base().dq * way, tau=base().tau * way)


def swapped(a: int, b: int) -> Log:
    order = [b if k == a else a if k == b else k for k in range(7)]
    log = base()
    return replace(log, q=log.q[:, order], dq=log.dq[:, order], tau=log.tau[:, order])


def against_the_world(joint: int, carrier: int) -> Log:
    """A joint told together with another that turns what carries it."""
    told = np.eye(7)
    told[joint, carrier] = 1.0
    return replace(base(), q=base().q @ told.T, dq=base().dq @ told.T)


AS_A_WHOLE = {
    "panda_joint1 and panda_joint3 are swapped": lambda: swapped(0, 2),
    "panda_joint4 is told together with panda_joint2": lambda: against_the_world(3, 1),
    "not those of this motion": lambda: replace(base(), tau=base().tau[::-1]),
    "torques are not those": lambda: replace(
        base(), tau=5.0 * np.random.default_rng(0).standard_normal(base().tau.shape)
    ),
}


@pytest.mark.parametrize("said", AS_A_WHOLE)
def test_a_joint_that_is_told_otherwise_is_named(said: str) -> None:
    with pytest.raises(RecordingRefused, match=said):
        find_load(AS_A_WHOLE[said](), panda_model())


def test_a_joint_told_within_one_turn_goes_on() -> None:
    off = np.eye(7)[6] * (np.pi - float(np.median(base().q[:, 6])))
    told = (base().q + off + np.pi) % (2.0 * np.pi) - np.pi - off
    assert np.abs(np.diff(told, axis=0)).max() > 6.0
    found = find_load(replace(base(), q=told), panda_model())
    assert abs(found.mass - LOAD_KG) < 3.0 * found.mass_std < 0.3
    assert any("panda_joint7 is told within one turn" in note for note in found.notes)


def test_a_namespace_and_joints_of_a_gripper_are_no_other_robot() -> None:
    log, n = base(), len(base())
    named = ("left/finger1", *(f"left/{name}" for name in log.joint_names))
    wide = [np.column_stack([np.zeros(n), x]) for x in (log.q, log.dq, log.tau)]
    log = replace(log, joint_names=named, q=wide[0], dq=wide[1], tau=wide[2])
    found = find_load(log, panda_model())
    assert abs(found.mass - LOAD_KG) < 3.0 * found.mass_std < 0.3


def written(log: Log, path: Path) -> Path:
    write_log(log, path, {})
    return path


def without_gravity() -> Log:
    model, log = panda_model(), base()
    still = np.zeros_like(log.q)
    return replace(log, tau=log.tau - RigidArm.of(model).torque(log.q, still, still))


def zero_moved(log: Log, by_rad: float) -> Log:
    return replace(log, q=log.q + by_rad * np.eye(7)[3])


def larger(factor: np.ndarray) -> Log:
    return replace(base(), tau=factor * base().tau)


MENDED = {
    "--turn panda_joint3": lambda: turned(2),
    "--zero panda_joint4=1.5708": lambda: zero_moved(base(), np.pi / 2.0),
    "--turn panda_joint4 --zero panda_joint4=-0.785398": lambda: zero_moved(turned(3), np.pi / 4.0),
    "--tau gravity-compensated": without_gravity,
    "--gravity 9.81 0 0": lambda: base((9.81, 0.0, 0.0)),
    "--gravity 0 0 9.81": lambda: base((0.0, 0.0, 9.81)),
    "--tau-gain=1,-1,1,1,1,1,1": lambda: larger(1.0 - 2.0 * np.eye(7)[1]),
    "--tau-gain=0.001": lambda: larger(np.full(7, 1000.0)),
    "--tau-gain=0.87,0.87,0.87,0.87,0.12,0.12,0.12": lambda: larger(
        100.0 / panda_model().limits.effort
    ),
    "--tau-gain=1,1,1,0.": lambda: larger(1.0 + 1.5 * np.eye(7)[3]),
}


@cache
def clean() -> HandLoad:
    return find_load(base(), panda_model())


@pytest.mark.parametrize("option", MENDED)
def test_the_sentence_says_the_option_that_mends_the_log(option, tmp_path, capsys) -> None:
    path, out = written(MENDED[option](), tmp_path / "odd.mcap"), tmp_path / "load.json"
    load = ["load", str(path), "--robot", "panda", "--json", str(out)]
    assert main(load) == 2
    said = re.sub(r"\(.*?\)", "", " ".join(capsys.readouterr().err.split()))
    found = re.findall(
        r"--(?:turn|zero|tau) [\w.=-]+|--tau-gain=[\d.,-]+|--gravity(?: [\d.-]+){3}", said
    )
    given = " ".join(x.rstrip(".,;") for x in found)
    assert given.startswith(option)
    assert main([*load, *given.split()]) == 0
    mended = json.loads(out.read_text())
    assert abs(mended["mass_kg"] - clean().mass) < clean().mass_std
    assert mended["mass_std_kg"] < 1.5 * clean().mass_std or "gravity-" in option


def test_a_mended_log_has_the_names_of_the_clean_one() -> None:
    told = adapter.Told((("panda_joint4", -1.0, 0.0), ("panda_joint4", 1.0, -np.pi / 4.0)))
    log = told.log(zero_moved(turned(3), np.pi / 4.0), panda_model())
    np.testing.assert_allclose(log.q, base().q, atol=1e-12)
    plain, mended = (adapter.find_gap(x, panda_model()) for x in (base(), log))
    assert [x.title for x in mended.findings] == [x.title for x in plain.findings]


def test_a_fleet_takes_what_it_left_out(tmp_path) -> None:
    path, out = written(turned(2), tmp_path / "odd.mcap"), str(tmp_path / "out")
    fleet = ["fleet", str(path), "--robot", "panda", "--workers", "0", "--out", out]
    assert main([*fleet, "--no-report"]) == 8
    assert main([*fleet, "--no-report", "--turn", "panda_joint3"]) == 0


def test_a_trusted_log_is_taken_with_a_warning(tmp_path, capsys) -> None:
    path = written(turned(2), tmp_path / "odd.mcap")
    for door in (["load"], ["replay", "--every", "50", "--out", str(tmp_path / "out")]):
        assert main([*door, str(path), "--robot", "panda", "--trust-log"]) in (0, 9)
        assert "panda_joint3 counts the other way" in " ".join(capsys.readouterr().err.split())
    trusted = adapter.Told(trusted=True).log(turned(2), panda_model())
    with pytest.warns(ModelWarning, match="It is trusted"):
        adapter.learn(trusted, panda_model(), every=50)


@pytest.mark.parametrize("kind", WRONG)
def test_every_door_refuses_the_same_with_the_same_sentence(kind: str, tmp_path, capsys) -> None:
    log = replace(base(), tau=WRONG[kind](base().tau))
    with pytest.raises(RecordingRefused) as of_gap:
        adapter.find_gap(log, panda_model())
    with pytest.raises(RecordingRefused) as of_learn:
        adapter.learn(log, panda_model(), every=50)
    with pytest.raises(RecordingRefused) as of_load:
        find_load(log, panda_model())
    kinds = {x.value.kind for x in (of_gap, of_learn, of_load)}
    assert kinds == {kind.split(",")[0]}
    path = written(log, tmp_path / "wrong.mcap")
    assert main(["replay", str(path), "--robot", "panda", "--out", str(tmp_path / "out")]) == 2
    sentence = str(of_learn.value).split(": ", 1)[1]
    words = "".join(capsys.readouterr().err.split())
    assert sentence[:40].replace(" ", "") in words
    assert not (tmp_path / "out" / "model.json").exists()
