"""Data sets of falling trees: the same for a seed, kept, repaired; what sensors make of them."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sim.falls.data_set import (
    CACHE_VARIABLE,
    ENCODER_NOISE,
    SIGNALS,
    FallData,
    Flight,
    cache_folder,
    data_set,
)
from tests.helpers.random_trees import random_tree

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
    changes = [
        {},
        {"robot": heavier},
        {"flight": Flight(0.05)},
        {"flight": Flight(0.04, seed=7)},
    ]
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
    links = clean.links(TREE)
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
        "link_w": (links.w, gyro),
        "link_a": (links.a, accel),
    }
    for key, (truth, size) in expected.items():
        error = (seen[key] - truth) / size
        assert abs(error.std() - 1) < 0.05 and abs(error.mean()) < 0.05, key
    counts = seen["q"] / step
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)
    again = data_set(TREE, noise=True, **options)[0]
    assert all(np.array_equal(seen[key], again[key]) for key in seen)


def test_requests_that_cannot_be_met_say_why(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="have: atlas"):
        data_set("talos", folder=tmp_path)
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
