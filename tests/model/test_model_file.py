"""A model file reads back as it was written, and says what is wrong when it can't be read."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adapter.errors import ModelError
from adapter.model.model_file import dumps, load_model, loads, save_model
from adapter.model.robots import documented
from adapter.model.self_model import FixedFrame, Limits, SelfModel, Tool
from adapter.model.tree import Tree

finite = st.floats(allow_nan=False, allow_infinity=False)
any_number = st.floats()


def arrays(element: st.SearchStrategy[float], *shape: int) -> st.SearchStrategy[np.ndarray]:
    size = int(np.prod(shape))
    return st.lists(element, min_size=size, max_size=size).map(lambda x: np.reshape(x, shape))


@st.composite
def effects(draw: st.DrawFn, n: int) -> tuple[dict[str, Any], ...]:
    """The learner's form, and a finding's with what goes along."""
    each = draw(st.lists(finite, min_size=n, max_size=n))
    learned = {
        "effect": "viscous_friction",
        "joints": list(range(1, n + 1)),
        "parameters": {"Fv": each},
        "std": {"Fv": [None] * n},
        "units": {"Fv": "N m s/rad"},
    }
    found = {
        "effect": "payload",
        "joints": [],
        "interval_s": [draw(st.floats(0.0, 10.0)), None],
        "parameters": {"m": draw(finite), "cx": 0.0, "cy": 0.1, "cz": draw(finite)},
        "std": {"m": draw(st.floats(0.0, 1.0))},
        "units": {"m": "kg", "cx": "m", "cy": "m", "cz": "m"},
        "evidence": 0.99,
        "ambiguous_with": ["link_inertia"],
        "split_by": "weigh it",
    }
    return tuple(draw(st.lists(st.sampled_from([learned, found]), max_size=3)))


@st.composite
def models(draw: st.DrawFn) -> SelfModel:
    n = draw(st.integers(1, 4))
    parent = tuple(draw(st.integers(-1, k - 1)) for k in range(n))
    names = draw(st.lists(st.text(min_size=1), min_size=n, max_size=n, unique=True))
    tree = Tree(parent, draw(st.booleans()), tuple(names), tuple(f"l{x}" for x in names), "base")
    tool = Tool(draw(st.floats(0.01, 9)), draw(arrays(finite, 3)), draw(arrays(finite, 3, 3)))
    frame = FixedFrame("flange", "j", "base", draw(arrays(finite, 3, 3)), draw(arrays(finite, 3)))
    sizes = [np.abs(draw(arrays(any_number, n))) for _ in range(4)]
    return SelfModel(
        name=draw(st.text()),
        tree=tree,
        lam=draw(arrays(finite, n, 6)),
        theta=draw(arrays(finite, tree.bodies, 10)),
        limits=Limits(-sizes[0], sizes[1], sizes[2] + 1e-3, sizes[3] + 1e-3),
        axis=draw(arrays(finite, n, 3)),
        frames=(frame,),
        gravity=draw(arrays(finite, 3)),
        tool=draw(st.sampled_from([None, tool, dataclasses.replace(tool, link=f"l{names[0]}")])),
        lam_std=draw(arrays(any_number, n, 6)),
        theta_std=draw(arrays(any_number, tree.bodies, 10)),
        lam_identifiable=draw(st.sampled_from([None, np.eye(n, 6, dtype=bool)])),
        effects=draw(effects(n)),
        lambda_source=draw(st.sampled_from(["measured", "reproduces the documentation"])),
        provenance={"log": "a.mcap", "samples": 3},
    )


@settings(deadline=None, max_examples=60)
@given(models())
def test_round_trip_is_exact(model: SelfModel) -> None:
    same(model, loads(dumps(model)))


def same(first: Any, second: Any) -> None:
    """Equal to the last bit, NaN equal to NaN."""
    if dataclasses.is_dataclass(first):
        assert type(first) is type(second)
        for field in dataclasses.fields(first):
            same(getattr(first, field.name), getattr(second, field.name))
    elif isinstance(first, np.ndarray):
        np.testing.assert_array_equal(first, second)
    elif isinstance(first, tuple):
        assert len(first) == len(second)
        for a, b in zip(first, second, strict=True):
            same(a, b)
    else:
        assert first == second


def test_numpy_values_and_unknowns_in_effects_are_written_plainly() -> None:
    effect = {
        "effect": "coulomb_friction",
        "joints": np.array([1, 2]),
        "parameters": {"Fc": np.array([0.3, 0.2])},
        "std": {"Fc": np.array([0.1, np.nan])},
        "n": np.int64(2),
    }
    (entry,) = loads(dumps(dataclasses.replace(documented("panda"), effects=(effect,)))).effects
    assert entry["parameters"] == {"Fc": [0.3, 0.2]} and entry["joints"] == [1, 2]
    assert entry["std"] == {"Fc": [0.1, None]} and entry["n"] == 2


def test_the_file_reads_as_tables() -> None:
    lines = dumps(documented("panda")).splitlines()
    assert "  [0.0, 0.0, 0.0, 0.0, 0.0, 0.333]," in lines
    assert max(map(len, lines)) < 260


FAULTS = {
    "format": (lambda d: d.update(format="other"), "format is 'other', expected 'panda-adapter"),
    "version": (lambda d: d.update(version=2), "version 2 of the format; have: 1"),
    "no lambda": (lambda d: d.pop("lambda"), "'lambda' is missing"),
    "null lambda": (lambda d: d.update({"lambda": None}), "'lambda' and 'theta' must hold numbers"),
    "shape": (lambda d: d.update(theta=[[1.0] * 10]), r"'theta' must have shape \(7, 10\)"),
    "ragged": (lambda d: d["theta"][0].pop(), "'theta' must"),
    "not finite": (lambda d: d["theta"][0].__setitem__(0, None), "theta holds a value that is not"),
    "word": (lambda d: d["lambda"][0].__setitem__(0, "x"), "'lambda' must hold numbers"),
    "parent": (lambda d: d["tree"]["parent"].__setitem__(1, 5), "joint 1 hangs on link 5"),
    "names": (lambda d: d["tree"].update(joint_names=["a"]), "7 joints need 7 joint names"),
    "source": (lambda d: d.update(lambda_source="guess"), "no lambda_source 'guess'; have: 'docum"),
    "tree": (lambda d: d.update(tree=[]), "'tree' must be a dict, got list"),
    "frames": (lambda d: d["frames"][0].update(parent="moon"), "rides on 'moon'; have: panda_l"),
    "tool": (lambda d: d.update(tool={"mass": 1}), "'com' in 'tool'"),
    "effects": (lambda d: d.update(effects={}), "'effects' must be a list, got dict"),
    "flags": (lambda d: d.update(lambda_identifiable=[1]), "'lambda_identifiable' must hold true"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_wrong_file_is_refused(fault: str, tmp_path: Path) -> None:
    spoil, message = FAULTS[fault]
    data = json.loads(dumps(documented("panda")))
    spoil(data)
    path = tmp_path / "model.json"
    path.write_text(json.dumps(data))
    with pytest.raises(ModelError, match=message) as caught:
        load_model(path)
    assert "model.json" in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": NaN}', "\x00"])
def test_what_is_no_model_file_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    path.write_text(text)
    with pytest.raises(ModelError, match=r"model\.json"):
        load_model(path)


def test_saving_replaces_the_whole_file(tmp_path: Path) -> None:
    path = tmp_path / "new folder" / "model.json"
    save_model(documented("panda"), path)
    first = path.read_bytes()
    save_model(documented("panda"), path)
    assert path.read_bytes() == first and list(path.parent.iterdir()) == [path]
