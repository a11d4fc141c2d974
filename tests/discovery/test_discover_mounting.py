"""Sensors mounted anyhow and accelerations alone: the tree, the mountings and λ come back.

And sensors glued on links, with stamps, rates and frames of their own.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from adapter.cli import main
from adapter.discovery import Discovery, discover, learn, self_model
from adapter.discovery.hypotheses import FREE
from adapter.errors import ModelError, SettingsError
from adapter.model.model_file import load_model
from adapter.model.spatial import matrix_from_zxz
from drivers.files.mcap import Log, read_log
from drivers.files.ros_types import IMU, JOINT_STATE
from drivers.interface import DriverError
from tests.helpers.discovery_data import (
    RATE_HZ,
    SHORT,
    TRUSTED,
    Case,
    Motion,
    anyhow,
    confidences,
    record,
    robot,
)
from tests.helpers.mcap_tools import foreign, payloads, samples
from tests.helpers.mcap_tools import record as write_samples
from tests.helpers.ros_messages import imu, joint_state, ns, write


@cache
def _case(
    name: str,
    seed: int,
    motion: Motion = SHORT,
    share: float = 1.0,
    turned: bool = True,
    shifted: bool = True,
    noise: float = 1.0,
    base: bool | None = None,
) -> Case:
    bodies = 1 + robot(name).tree.n
    which = np.random.default_rng([seed, 31]).permutation(bodies)[: round(share * bodies)]
    mounts = anyhow(seed, which.tolist(), bodies, turned=turned, shifted=shifted)
    return record(name, motion, seed, noise=noise, base=base, mounts=mounts)


def _pairs(case: Case) -> set[tuple[str, frozenset[str]]]:
    return {(joint, frozenset((link, parent))) for joint, link, parent in case.edges}


def _connected(found: Discovery) -> set[tuple[str | None, frozenset[str | None]]]:
    return {(joint, frozenset((link, parent))) for joint, link, parent in confidences(found)}


def _worst_wrong(case: Case, found: Discovery) -> float:
    """Most confidence in a connection that is not there, or in an edge as it is not."""
    pairs, worst = _pairs(case), 0.0
    for e in (e for e in found.edges if e.joint is not None):
        if (e.joint, frozenset((e.link, e.parent))) not in pairs:
            worst = max(worst, e.connected)
        elif (e.joint, e.link, e.parent) not in case.edges:
            worst = max(worst, e.confidence)
    return worst


def _heard(log: Log, parts: str) -> Log:
    gone = [key for key in ("twists", "accels") if key[0] not in parts]
    return replace(log, **dict.fromkeys(gone))


@pytest.mark.parametrize(
    ("seed", "parts", "turned", "shifted"),
    [(0, "ta", True, True), (1, "t", True, False), (2, "a", False, True)],
)
def test_fixed_base_decides_everything(seed: int, parts: str, turned: bool, shifted: bool) -> None:
    case = _case("panda", seed, turned=turned, shifted=shifted)
    found = discover(_heard(case.log, parts))
    assert set(confidences(found)) == case.edges and found.root == case.root == "base"
    assert min(confidences(found).values()) > 0.99 and all(e.directed for e in found.edges)
    assert found.undecided == () and set(found.mountings) == set(case.log.link_names)
    assert "axes were found" in found.notes[-1]


@cache
def _named_atlas() -> tuple[Case, Discovery]:
    """Every sensor mounted anyhow, and the word which of them is the base's."""
    case = _case("atlas", 0)
    return case, discover(case.log, base=case.root)


def test_floating_base_decides_what_is_connected_and_a_word_the_rest() -> None:
    case, named = _named_atlas()
    found = discover(case.log)
    assert _connected(found) == _pairs(case) and not any(e.directed for e in found.edges)
    assert min(e.connected for e in found.edges) > 0.99
    assert list(confidences(found).values()) == pytest.approx([0.5] * 30, abs=0.01)  # either way
    assert found.root_confidence == pytest.approx(1 / 31, rel=0.05)
    assert len(found.undecided) == 1 and "--base" in found.undecided[0]
    assert set(confidences(named)) == case.edges and named.root == case.root
    assert min(confidences(named).values()) > 0.99 and all(e.directed for e in named.edges)
    assert named.undecided == () and named.root_confidence > 0.99


def test_links_that_keep_the_convention_tell_the_direction() -> None:
    case = _case("atlas", 0, share=0.2)
    found = discover(case.log)
    assert _connected(found) == _pairs(case) and _worst_wrong(case, found) < 0.51
    assert sum(e.directed for e in found.edges) >= 20
    turned = {name for name, b in case.body.items() if case.mounts[b][0][2, 2] < 1.0}
    named = discover(case.log, base=case.root)
    assert set(confidences(named)) == case.edges and min(confidences(named).values()) > 0.98
    assert set(named.mountings) == turned - {case.root}


@pytest.mark.parametrize("name", ["panda", "atlas"])
def test_mountings_and_lambda_are_true(name: str) -> None:
    """Whatever the gauge: axes, and where each joint's axis lies between two sensors."""
    panda = _case("panda", 0)
    case, found = (panda, discover(panda.log)) if name == "panda" else _named_atlas()
    learned = learn(found)
    for link, mounting in found.mountings.items():
        turn, place = case.mounts[case.body[link]]
        assert np.linalg.norm(np.cross(mounting.axis, turn[2])) < 3e-3
        assert mounting.axis @ turn[2] > 0.0
        off = mounting.origin + turn.T @ place
        assert np.linalg.norm(np.cross(off, mounting.axis)) < 6e-3
    turns = matrix_from_zxz(learned.schema.lam[:, :3])
    true = matrix_from_zxz(case.model.lam[:, :3])
    body = [case.body[link] - 1 for link in learned.data.tree.link_names]
    for j, i in enumerate(learned.data.tree.parent):
        if i >= 0 and learned.schema.ranks[j] == 6:  # the angle between two neighbouring axes
            assert turns[j, 2, 2] == pytest.approx(true[body[j], 2, 2], abs=3e-3)
    if name == "panda":
        model, left = self_model(found, learned, "found")
        assert left is not None and left.max() < 0.2  # N m of up to 60, noise 0.1 a sample
        assert set(model.provenance["discovered"]["mounting"]) == set(found.mountings)
    figures = found.as_dict()["mounting"]
    assert all(np.shape(place["rotation"]) == (3, 3) for place in figures.values())


@pytest.mark.parametrize(
    ("seed", "seconds", "noise", "still", "alike"),
    [
        (8, 2.0, 1.0, (1, 2, 5, 6), ()),
        pytest.param(9, 4.0, 1.0, (), ((3, 5),), marks=pytest.mark.slow),
        pytest.param(10, 2.0, 50.0, (), (), marks=pytest.mark.slow),
    ],
)
def test_no_wrong_edge_is_trusted(
    seed: int, seconds: float, noise: float, still: tuple[int, ...], alike: tuple
) -> None:
    motion = Motion(seconds=seconds, rate_hz=RATE_HZ, still=still, alike=alike)
    case = _case("panda", seed, motion, noise=noise)
    found = discover(case.log)
    assert _worst_wrong(case, found) < TRUSTED
    doubtful = [e for e in found.edges if e.confidence < TRUSTED]
    assert all(any(e.link in line for line in found.undecided) for e in doubtful)
    if still or alike:
        assert doubtful


def test_a_base_at_rest_whose_gyroscope_is_biased_is_the_root() -> None:
    """As all the other gyroscopes are, by 0.3 °/s."""
    case = _case("panda", 0, Motion(seconds=8.0, rate_hz=RATE_HZ), base=True)
    twists = case.log.twists
    drawn = np.random.default_rng(0).normal(size=twists.shape[1:])[:, 3:]
    bias = np.radians(0.3) * drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
    found = discover(replace(case.log, twists=twists + np.pad(bias, ((0, 0), (3, 0)))))
    assert found.root == case.root
    assert {(e.joint, e.link, e.parent) for e in found.edges} == case.edges


def test_base_at_rest_is_the_root_also_where_frames_are_any() -> None:
    case = _case("panda", 13, base=True)
    found = discover(case.log)
    assert set(confidences(found)) == case.edges and found.root == case.root != "base"
    with pytest.raises(ModelError, match=r"no link nobody.*choose from imu_0"):
        discover(case.log, base="nobody")


@pytest.mark.parametrize("name", ["panda", pytest.param("atlas", marks=pytest.mark.slow)])
def test_accelerations_alone_in_motion(name: str) -> None:
    whole = _case(name, 14, share=0.0)
    found = discover(_heard(whole.log, "a"))
    assert set(confidences(found)) == whole.edges and found.root == whole.root
    assert min(confidences(found).values()) > 0.99 and not found.hypotheses.mounted
    assert "at the start is found" in found.log.notes[0]
    true = discover(whole.log).log.motion["w"]
    assert np.abs(found.log.motion["w"] - true).max() < 0.05  # rad/s, most of it drift
    assert float(np.sqrt(np.mean(true[0] ** 2))) > 0.3


def test_some_links_with_gyros_and_others_with_accelerometers() -> None:
    case = _case("panda", 15, base=True)
    log = case.log
    twists, accels = log.twists.copy(), log.accels.copy()
    twists[:, ::2], accels[:, 1::2] = np.nan, np.nan
    found = discover(replace(log, twists=twists, accels=accels), base=case.root)
    assert set(confidences(found)) == case.edges and min(confidences(found).values()) > 0.99
    assert any("from turning alone" in note for note in found.notes)
    accels[:, 4] = np.nan
    with pytest.raises(SettingsError, match=f"neither: {log.link_names[4]}$"):
        discover(replace(log, twists=twists, accels=accels))


def test_angles_that_wrap_and_sensors_with_stamps_of_their_own() -> None:
    fast = Motion(seconds=4.0, rate_hz=RATE_HZ, speed=6.0)
    case = _case("panda", 16, fast)
    log = case.log
    assert np.ptp(log.q, axis=0).max() > np.pi
    wrapped = replace(log, q=(log.q + np.pi) % (2 * np.pi) - np.pi)
    assert set(confidences(discover(wrapped))) == case.edges
    case = _case("panda", 0)
    log = case.log  # joints at every other stamp, links at those between
    even = (np.arange(len(log)) % 2 == 0)[:, None]
    joints = {k: np.where(even, getattr(log, k), np.nan) for k in ("q", "dq", "tau")}
    links = {k: np.where(even[..., None], np.nan, getattr(log, k)) for k in ("twists", "accels")}
    assert set(confidences(discover(replace(log, **joints, **links)))) == case.edges


def test_late_sensors_make_edges_doubtful_not_wrong() -> None:
    case = _case("panda", 1, replace(SHORT, seconds=6.0))
    log = case.log
    late = 2  # samples, 8 ms
    moved = {k: getattr(log, k)[late:] for k in ("stamp_ns", "q", "dq", "tau")}
    found = discover(replace(log, **moved, twists=log.twists[:-late], accels=log.accels[:-late]))
    assert _worst_wrong(case, found) < TRUSTED and max(found.hypotheses.excess.values()) > 4.0


def test_a_sliding_joint_is_never_trusted_to_turn() -> None:
    """What a joint that slides would say: links move as one, the joint's speed shows nowhere."""
    case = _case("panda", 0)
    log = case.log
    rng = np.random.default_rng(3)
    joint = sorted(case.edges)[3][0]
    s = log.joint_names.index(joint)
    strange = np.cumsum(rng.normal(size=len(log))) / RATE_HZ
    q, dq = log.q.copy(), log.dq.copy()
    q[:, s], dq[:, s] = np.cumsum(strange) / RATE_HZ, strange
    found = discover(replace(log, q=q, dq=dq))
    assert all(e.confidence < TRUSTED for e in found.edges if e.joint == joint)
    assert _worst_wrong(case, found) < TRUSTED
    free = [o for o in found.structure.chosen if o.parent == FREE]
    assert free and found.undecided


FINE = Motion(seconds=3.0, rate_hz=2000.0)  # joints take every other sample, sensors those between
EVERY = 10  # 200 Hz


@cache
def _glued(seed: int, name: str, base: bool) -> Case:
    mounts = anyhow(seed, range(8), 8)
    return record(name, FINE, seed, base=base, noise=0.5, mounts=mounts)


def _write(
    path: Path, case: Case, frame: Callable[[str], str], *, dq: bool = False, tau: bool = False
) -> Path:
    """Joint states at 1 kHz and each link's Imu at 200 Hz, by another encoder than ours."""
    rng = np.random.default_rng(4)
    log = case.log
    stamp_ns = log.stamp_ns + 200_000 * rng.normal(size=len(log))  # jitter of all stamps
    messages = []
    for i, at in enumerate((1e-9 * stamp_ns).tolist()):
        if i % 2 == 0:
            signals = log.q[i], log.dq[i][: 7 * dq], log.tau[i][: 7 * tau]
            state = joint_state(log.joint_names, at, *signals)
            messages.append(("/joint_states", JOINT_STATE, at, state))
        for k, name in enumerate(log.link_names):
            if i % EVERY == 2 * k % EVERY + 1:
                told = imu(ns(at), frame(name), log.twists[i, k, 3:], log.accels[i, k, :3])
                messages.append((f"/{name}/data", IMU, at, told))
    return write(path, messages)


def _discovered(path: Path, *options: str) -> dict:
    out = path.with_suffix(".json")
    assert main(["discover", str(path), "--json", str(out), *options]) == 0
    found: dict = json.loads(out.read_text())
    return found


def _edges(figures: dict) -> set[tuple[str, str, str]]:
    return {(e["joint"], e["link"], e["parent"]) for e in figures["edges"]}


def test_command_finds_the_tree_of_glued_sensors(tmp_path, capsys) -> None:
    case = _glued(0, "panda", True)
    path = _write(tmp_path / "a.mcap", case, str)
    model = tmp_path / "model.json"
    figures = _discovered(path, "--model", str(model))
    assert _edges(figures) == case.edges and figures["root"] == case.root
    assert min(e["confidence"] for e in figures["edges"]) > 0.99
    assert figures["undecided"] == [] and figures["measured"] == ["w", "a"]
    assert set(figures["mounting"]) == {link for _, link, _ in case.edges}
    assert figures["torque_rmse_nm"] is None
    found = load_model(model)
    assert found.provenance["discovered"]["theta"] == "not learned"
    told = " ".join("".join(capsys.readouterr()).split())
    for sentence in ("200 Hz, carried to the joint", "no efforts", "no velocities", "(no torques)"):
        assert sentence in told
    assert "sensor of" in told and "axis in its frame" in told
    for link, place in figures["mounting"].items():
        turn, origin = case.mounts[case.body[link]]
        axis = np.array(place["rotation"])[2]  # the joint's z in the sensor's frame
        assert np.linalg.norm(np.cross(axis, turn[2])) < 3e-3 and axis @ turn[2] > 0.0
        across = turn.T @ origin - np.array(place["rotation"]).T @ place["position"]
        assert np.linalg.norm(np.cross(across, axis)) < 6e-3


def test_sensors_of_one_frame_id_and_torques(tmp_path) -> None:
    case = _glued(1, "panda", False)
    path = _write(tmp_path / "a.mcap", case, lambda _: "imu_link", dq=True, tau=True)
    figures = _discovered(path, "--model", str(tmp_path / "model.json"))
    topics = {(j, f"/{k}/data", f"/{i}/data" if i != "base" else i) for j, k, i in case.edges}
    assert _edges(figures) == topics and figures["root"] == "base"
    assert max(figures["torque_rmse_nm"]) < 0.3  # N m, of torques up to 60


def test_floating_base_needs_a_word(tmp_path, capsys, refused) -> None:
    case = _glued(2, "free panda", True)
    path = _write(tmp_path / "a.mcap", case, str, dq=True)
    assert any("--base" in line for line in _discovered(path)["undecided"])
    assert "this way or the other" in capsys.readouterr().out
    figures = _discovered(path, "--base", case.root)
    assert _edges(figures) == case.edges and figures["undecided"] == []
    assert "choose from" in refused("discover", path, "--base", "nobody", warned=True)


def test_other_commands_see_nothing_of_it(tmp_path) -> None:
    path = _write(tmp_path / "a.mcap", _glued(1, "panda", False), str, tau=True)
    log = read_log(path)
    assert log.link_names == () and log.twists is None and np.isfinite(log.tau).all()
    bare = foreign(tmp_path / "b.mcap", payloads(samples(5), fields=("position", "velocity")))
    with pytest.raises(DriverError, match="has no effort"):
        read_log(bare)
    whole = read_log(bare, beside="sensors")
    assert np.isnan(whole.tau).all() and "no efforts" in whole.warnings[0]
    ours = write_samples(tmp_path / "c.mcap", samples(40, links=True))
    one, two = read_log(ours), read_log(ours, beside="sensors")
    for name in ("stamp_ns", "q", "dq", "tau", "twists", "accels"):
        assert np.array_equal(getattr(one, name), getattr(two, name)), name
    assert one.warnings == two.warnings == []


def test_a_part_is_that_part_of_the_whole(tmp_path, refused) -> None:
    path = _write(tmp_path / "a.mcap", _glued(1, "panda", False), str)
    whole = read_log(path, beside="sensors")
    part = read_log(path, beside="sensors", within_s=(1.0, 2.0))
    at = np.searchsorted(whole.stamp_ns, part.stamp_ns)
    assert 900 < len(part) <= 1001 and np.array_equal(whole.stamp_ns[at], part.stamp_ns)
    np.testing.assert_array_equal(part.q, whole.q[at])
    assert part.link_names == whole.link_names
    assert "read from 1 to 2 s of 3 s" in "".join(part.warnings)
    assert "ends at 3.0 s, before 5 s" in refused("discover", path, "--from", "5")
    assert "above zero" in refused("discover", path, "--seconds", "0")


def test_nothing_left_is_told(tmp_path, refused) -> None:
    still = foreign(tmp_path / "a.mcap", payloads(samples(5), fields=("velocity",)))
    assert "has no position" in refused("discover", still)
    alone = foreign(tmp_path / "b.mcap", payloads(samples(5), fields=("position",)))
    said = refused("discover", alone, warned=True)
    assert "has: /joint_states (5 sensor_msgs/msg/JointState)" in said
