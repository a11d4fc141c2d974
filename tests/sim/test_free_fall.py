"""Trees in free fall against Pinocchio, ATLAS's facts against their file, and data sets of falls.

The same for a seed, kept, repaired; and what sensors make of them.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapter.model.spatial import matrix_from_zxz
from sim.falls.data_set import (
    CACHE_VARIABLE,
    ENCODER_NOISE,
    SIGNALS,
    FallData,
    Flight,
    cache_folder,
    data_set,
)
from sim.falls.fall import TOP_SPEED, FallRecord, TreeTruth, atlas, babble
from sim.truth import body_of
from tests.helpers.arm_data import free_answers, pin_tree
from tests.helpers.random_trees import random_tree
from tests.helpers.robot_models import read_quietly, shared

EXACT = 1e-8


def tree_of(name: str) -> TreeTruth:
    return atlas() if name == "atlas" else random_tree(int(name), seed=int(name))


def answers(truth: TreeTruth, record: FallRecord, rows: np.ndarray) -> tuple[np.ndarray, ...]:
    """Base wrench, joint torques, motion (rows, n, 4, 3) of links and largest force, by rows."""
    model = pin_tree(truth.parent, truth.R, truth.p, truth.theta, np.zeros(3), free=True)
    signals = record.q, record.dq, record.ddq
    base = record.base_v, record.base_w, record.base_a, record.base_dw
    tau, motion, force = free_answers(model, [x[rows] for x in signals], [x[rows] for x in base])
    return tau[:, :6], tau[:, 6:], motion, force


@pytest.mark.parametrize("name", ["atlas", "5", "33"])
def test_every_sample_satisfies_the_equations_of_motion(name: str) -> None:
    truth = tree_of(name)
    record = babble(truth, 1.5, np.random.default_rng(1))
    rows = np.r_[0:10, 10:1500:50]
    wrench, tau, motion, force = answers(truth, record, rows)
    assert np.abs(tau - record.tau[rows]).max() < EXACT * np.median(np.abs(tau))
    assert np.abs(wrench).max() < EXACT * np.median(force)
    ours = np.moveaxis(record.links(truth), 0, 2)[rows]
    assert np.abs(ours - motion).max() < 1e-11 * np.abs(motion).max()
    assert np.ptp(record.base_w, axis=0).min() > 0.1  # the base answers the limbs


def test_a_full_fall_of_atlas_stays_exact_and_uses_the_joints() -> None:
    truth = atlas()
    record = babble(truth, 10.0, np.random.default_rng(2))
    rows = np.arange(0, 10_000, 250)
    wrench, tau, _, force = answers(truth, record, rows)
    assert np.abs(tau - record.tau[rows]).max() < EXACT * np.median(np.abs(tau))
    assert np.abs(wrench).max() < EXACT * np.median(force)
    limits = truth.limits
    assert np.all((record.q > limits.lower) & (record.q < limits.upper))
    assert np.all(np.abs(record.tau) < limits.effort)
    used = np.ptp(record.q, axis=0) / (limits.upper - limits.lower)
    assert np.median(used) > 0.7 and used.min() > 0.3
    assert 2.0 < np.abs(record.dq).max() < 1.1 * TOP_SPEED
    # In free fall no force acts on the whole: the centre of mass keeps falling from rest.
    assert abs(np.linalg.norm(record.base_v[-1]) - 9.81 * 10) < 10


def test_atlas_is_the_robot_of_its_source() -> None:
    truth = atlas()
    model = read_quietly(shared("models/atlas_v5.urdf").read_text(), floating=True)
    assert (truth.n, truth.base_name) == (30, model.tree.base_name)
    assert truth.theta[:, 0].sum() == pytest.approx(174.05, abs=1e-3)
    names = model.tree.joint_names
    order = np.array([names.index(name) for name in truth.joint_names])
    assert tuple(np.asarray(model.tree.link_names)[order]) == truth.link_names
    for j, i in enumerate(truth.parent):
        theirs = model.tree.parent[order[j]]
        assert truth.link_names[i] == model.tree.link_names[theirs] if i >= 0 else theirs == -1
    np.testing.assert_allclose(truth.R, matrix_from_zxz(model.lam[order, :3]), atol=1e-12)
    np.testing.assert_allclose(matrix_from_zxz(truth.lam[:, :3]), truth.R, atol=1e-15)
    np.testing.assert_allclose(truth.p, model.lam[order, 3:], atol=1e-12)
    np.testing.assert_allclose(truth.theta, model.theta[np.r_[0, order + 1]], atol=1e-12)
    for key in ("lower", "upper", "velocity", "effort"):
        theirs = getattr(model.limits, key)[order]
        np.testing.assert_array_equal(getattr(truth.limits, key), theirs)


@pytest.mark.parametrize("name", ["atlas", "5", "60"])
def test_every_body_is_one_that_can_exist(name: str) -> None:
    for theta in tree_of(name).theta:
        m, _, inertia = body_of(theta)
        small, middle, large = np.linalg.eigvalsh(inertia)
        assert m > 0 and small > 0 and large < small + middle


def test_trees_that_are_none_are_refused() -> None:
    good = random_tree(5, seed=0)
    with pytest.raises(ValueError, match="have: -1"):
        replace(good, parent=(0, *good.parent[1:]))
    with pytest.raises(ValueError, match="5 joints"):
        replace(good, theta=good.theta[1:])


TREE = random_tree(6, seed=3)
FLIGHT = Flight(0.2)
SHORT = {"trajectories": 3, "flight": FLIGHT}


def same(a: FallData, b: FallData) -> bool:
    """Whether what both hold is the same to the last bit."""
    pairs = zip(a, b, strict=False)
    return all(np.array_equal(x[key], y[key]) for x, y in pairs for key in x)


def test_data_depends_on_the_seed_and_on_nothing_else(tmp_path: Path) -> None:
    one = data_set(TREE, folder=tmp_path / "a", processes=1, **SHORT)
    two = data_set(TREE, folder=tmp_path / "b", processes=2, **SHORT)
    assert same(one, two)
    names = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert names == sorted(path.name for path in (tmp_path / "b").iterdir())
    assert len(names) == 3 and all(name.endswith(".npz") for name in names)
    longer = data_set(TREE, folder=tmp_path / "a", trajectories=4, flight=FLIGHT, processes=1)
    assert same(one, longer) and len(longer) == 4
    assert not np.array_equal(one[0]["q"], one[1]["q"])
    other_seed = data_set(
        TREE, folder=tmp_path / "a", trajectories=3, flight=replace(FLIGHT, seed=1)
    )
    assert not np.array_equal(one[0]["q"], other_seed[0]["q"])


def test_whatever_decides_the_content_decides_the_name(tmp_path: Path) -> None:
    heavier = replace(TREE, theta=TREE.theta * 1.001)
    changes = [{}, {"robot": heavier}, {"flight": Flight(0.05)}, {"flight": Flight(0.04, seed=7)}]
    common = {"robot": TREE, "flight": Flight(0.04), "trajectories": 1, "folder": tmp_path}
    names = {data_set(**common | change).jobs[0].path for change in changes}
    assert len(names) == len(changes) == len(list(tmp_path.iterdir()))


def test_files_are_kept_and_broken_ones_made_again(tmp_path: Path) -> None:
    whole = data_set(TREE, folder=tmp_path, processes=1, **SHORT)
    before = list(whole)
    paths = [job.path for job in whole.jobs]
    times = [path.stat().st_mtime_ns for path in paths]
    paths[0].write_bytes(paths[0].read_bytes()[:-500])  # cut: no directory at its end
    paths[1].write_bytes(b"")
    again = data_set(TREE, folder=tmp_path, processes=1, **SHORT)
    assert paths[2].stat().st_mtime_ns == times[2]
    bits = bytearray(paths[2].read_bytes())
    bits[len(bits) // 2] ^= 1  # only reading it through shows this
    paths[2].write_bytes(bits)
    for old, new in zip(before, again, strict=True):
        assert all(np.array_equal(old[key], new[key]) for key in SIGNALS)
    assert all(path.stat().st_mtime_ns != t for path, t in zip(paths, times, strict=True))
    assert not list(tmp_path.glob("*.part"))


def test_files_of_killed_runs_are_swept_and_those_at_work_are_not(tmp_path: Path) -> None:
    old, new = tmp_path / "a.part", tmp_path / "b.part"
    for path in (old, new):
        path.write_bytes(b"half")
    os.utime(old, (0, 0))
    data_set(TREE, 1, FLIGHT, folder=tmp_path, processes=1)
    assert new.exists() and not old.exists()


def test_a_file_of_other_shape_is_made_again(tmp_path: Path) -> None:
    data = data_set(TREE, 1, FLIGHT, folder=tmp_path, processes=1)
    whole = data.exact(0)
    short = {key: getattr(whole, key)[:10] for key in SIGNALS}
    np.savez(data.jobs[0].path, **short)
    np.testing.assert_array_equal(data.exact(0).q, whole.q)


def test_sensors_add_what_is_documented(tmp_path: Path) -> None:
    options = {"flight": Flight(4.0), "trajectories": 1, "folder": tmp_path}
    clean = data_set(TREE, **options).exact(0)
    seen = data_set(TREE, noise=True, **options)[0]
    assert set(seen) == {"q", "dq", "tau", "base_w", "base_a", "link_w", "link_a"}
    assert all(np.all(np.isfinite(x)) for x in seen.values())
    _, link_w, link_a, _ = clean.links(TREE)
    root_band = np.sqrt(500.0)
    gyro, accel = np.radians(0.007) * root_band, 120e-6 * 9.80665 * root_band
    step = 2 * np.pi / 2**19
    position = np.hypot(step / np.sqrt(12), ENCODER_NOISE)
    expected = {
        "q": (clean.q, position),
        "dq": (clean.dq, np.sqrt(2) * position * 1000.0),
        "tau": (clean.tau, 2e-3 * TREE.limits.effort),
        "base_w": (clean.base_w, gyro),
        "base_a": (clean.base_a, accel),
        "link_w": (link_w, gyro),
        "link_a": (link_a, accel),
    }
    for key, (truth, size) in expected.items():
        error = (seen[key] - truth) / size
        assert abs(error.std() - 1) < 0.05 and abs(error.mean()) < 0.05, key
    counts = seen["q"] / step
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)
    again = data_set(TREE, noise=True, **options)[0]
    assert all(np.array_equal(seen[key], again[key]) for key in seen)


def test_requests_that_cannot_be_met_say_why(tmp_path: Path) -> None:
    for wrong in ({"trajectories": 0}, {"processes": 0}):
        with pytest.raises(ValueError, match="must be"):
            data_set(TREE, folder=tmp_path, **wrong)
    for wrong in ({"seconds": 0.0}, {"seed": -1}, {"seconds": np.inf}):
        with pytest.raises(ValueError, match="must be"):
            Flight(**wrong)
    weak = replace(TREE, limits=replace(TREE.limits, effort=1e-9 * TREE.limits.effort))
    for processes in (1, 2):
        with pytest.raises(RuntimeError, match="did not keep joint"):
            data_set(weak, trajectories=2, flight=Flight(2.0), folder=tmp_path, processes=processes)
    assert not list(tmp_path.iterdir())


def test_the_cache_is_where_the_user_wants_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/xdg")
    monkeypatch.delenv(CACHE_VARIABLE, raising=False)
    assert cache_folder() == Path("/xdg/panda-adapter/free_fall")
    monkeypatch.setenv(CACHE_VARIABLE, "/mine")
    assert cache_folder() == Path("/mine")
