"""Sensors glued on links, with stamps, rates and frames of their own: the tree comes back."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from adapter.cli import main
from adapter.model.model_file import load_model
from drivers.files.mcap import read_log
from drivers.files.ros_types import IMU, JOINT_STATE
from drivers.interface import DriverError
from tests.helpers.discovery_data import Case, Motion, anyhow, record, robot
from tests.helpers.mcap_tools import foreign, payloads, samples
from tests.helpers.mcap_tools import record as write_samples
from tests.helpers.ros_messages import imu, joint_state, ns, write

FINE = Motion(seconds=3.0, rate_hz=2000.0)  # joints take every other sample, sensors those between
EVERY = 10  # 200 Hz
JITTER_NS = 200_000  # of all stamps


@cache
def _case(seed: int, floating: bool, base: bool) -> Case:
    model = robot("panda").with_base(floating)
    mounts = anyhow(seed, range(8), 8)
    return record(model, FINE, seed, base=base, noise=0.5, mounts=mounts)


def _write(
    path: Path, case: Case, frame: Callable[[str], str], *, dq: bool = False, tau: bool = False
) -> Path:
    """Joint states at 1 kHz and each link's Imu at 200 Hz, by another encoder than ours."""
    rng = np.random.default_rng(4)
    log = case.log
    stamp_ns = log.stamp_ns + JITTER_NS * rng.normal(size=len(log))
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
    case = _case(0, False, True)
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
    case = _case(1, False, False)
    path = _write(tmp_path / "a.mcap", case, lambda _: "imu_link", dq=True, tau=True)
    figures = _discovered(path, "--model", str(tmp_path / "model.json"))
    topics = {(j, f"/{k}/data", f"/{i}/data" if i != "base" else i) for j, k, i in case.edges}
    assert _edges(figures) == topics and figures["root"] == "base"
    assert max(figures["torque_rmse_nm"]) < 0.3  # N m, of torques up to 60


def test_floating_base_needs_a_word(tmp_path, capsys, refused) -> None:
    case = _case(2, True, True)
    path = _write(tmp_path / "a.mcap", case, str, dq=True)
    assert any("--base" in line for line in _discovered(path)["undecided"])
    assert "this way or the other" in capsys.readouterr().out
    figures = _discovered(path, "--base", case.root)
    assert _edges(figures) == case.edges and figures["undecided"] == []
    assert "choose from" in refused("discover", path, "--base", "nobody", warned=True)


def test_other_commands_see_nothing_of_it(tmp_path) -> None:
    path = _write(tmp_path / "a.mcap", _case(1, False, False), str, tau=True)
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
    path = _write(tmp_path / "a.mcap", _case(1, False, False), str)
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
