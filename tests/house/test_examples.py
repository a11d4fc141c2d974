"""The worked examples in docs/examples run, are short, and say what they promise."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MOST_LINES = 39


def said(name: str, folder: Path, patch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> str:
    """What an example prints, run in a folder of its own beside the recordings."""
    (folder / "recordings").symlink_to(ROOT / "recordings")
    patch.chdir(folder)
    path = ROOT / "docs" / "examples" / f"{name}.py"
    assert len(path.read_text().splitlines()) <= MOST_LINES
    runpy.run_path(str(path), run_name="__main__")
    return str(capsys.readouterr().out)


def test_learn_from_arrays(tmp_path, monkeypatch, capsys) -> None:
    text = said("learn_from_arrays", tmp_path, monkeypatch, capsys)
    assert "λ converged, θ learned" in text and "36 of 42" in text
    errors = re.search(r"by joint, N m: \[(.*)\]", text)
    assert errors is not None and max(map(float, errors[1].split())) < 0.15
    assert (tmp_path / "panda_learned.urdf").read_text().startswith("<?xml")


def test_find_a_gap(tmp_path, monkeypatch, capsys) -> None:
    text = said("find_a_gap", tmp_path, monkeypatch, capsys)
    found = re.findall(r"(\w+) in joints \((.*)\): Fc = ([\d.]+) ± ([\d.]+) N m", text)
    assert [(name, joints) for name, joints, *_ in found] == [("coulomb_friction", "2,")]
    size, std = map(float, found[0][2:])
    assert abs(size - 0.4) < 0.02 and 0.0005 < std < 0.05
    assert (tmp_path / "panda_with_friction.json").exists()


def test_write_a_driver(tmp_path, monkeypatch, capsys) -> None:
    text = said("write_a_driver", tmp_path, monkeypatch, capsys)
    assert text.strip() == "[False, False]"  # the filter settles first


def test_simulate_what_was_learned(tmp_path, monkeypatch, capsys) -> None:
    text = said("simulate_what_was_learned", tmp_path, monkeypatch, capsys)
    (has, bare), (_, reads) = (
        map(float, pair) for pair in re.findall(r"torque (\S+) N m, read (\S+) N m", text)
    )
    assert bare == has != 0.0 and abs(reads - 1.05 * has) < 0.02
    free, stuck = map(float, re.findall(r"(\S+) rad", text))
    assert free > 0.05 > 0.01 > stuck >= 0.0


def test_find_a_law(tmp_path, monkeypatch, capsys) -> None:
    text = said("find_a_law", tmp_path, monkeypatch, capsys)
    assert "law: max(q - a, 0)² found" in text
    (c, std), (a, _) = (
        tuple(map(float, re.findall(rf"^{key} = (\S+) .*± (\S+)", text, re.M)[0])) for key in "ca"
    )
    assert abs(c - 9.0) < 3.0 * std < 2.0 and abs(a + 0.9) < 0.05
    without, with_law = map(float, re.findall(r"(\S+) mrad", text))
    assert with_law < 0.1 * without
