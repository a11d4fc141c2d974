"""The notebooks run from first cell to last, find what they say, and hold no outputs in git."""

import re
import time
from pathlib import Path

import pytest

from tests.helpers.pages import ROOT

nbformat = pytest.importorskip("nbformat", reason="nbformat is in the extra [docs]")
pytest.importorskip("nbclient", reason="nbclient is in the extra [docs]")

from docs.site.notebooks import execute  # noqa: E402  # only where nbclient is

NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


def said(notebook) -> str:
    """All text that its cells show, tables included."""
    outputs = [o for cell in notebook.cells for o in cell.get("outputs", ())]
    parts = [(o.get("data", {}), o.get("text", "")) for o in outputs]
    return "\n".join(d.get("text/html", "") + d.get("text/plain", "") + text for d, text in parts)


def pictures(notebook) -> int:
    """How many its cells show."""
    outputs = [o for cell in notebook.cells for o in cell.get("outputs", ())]
    return sum("image/png" in o.get("data", {}) for o in outputs)


def run(name: str, record_property):
    """An executed notebook; what it took is reported."""
    begin = time.perf_counter()
    notebook = execute(ROOT / "docs" / "notebooks" / f"{name}.ipynb")
    record_property("seconds", time.perf_counter() - begin)
    return notebook


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_no_outputs_in_git(path: Path) -> None:
    cells = nbformat.read(path, as_version=4).cells
    assert [c.source for c in cells if c.cell_type == "code"]
    for cell in cells:
        assert not cell.get("outputs") and cell.get("execution_count") is None


def test_learn_from_a_log(record_property) -> None:
    notebook = run("learn-from-a-log", record_property)
    text = said(notebook)
    assert pictures(notebook) == 2
    assert "36 of 42 turns and shifts" in text and "λ converged, θ learned" in text
    assert "<td>panda_joint7</td>" in text and "mass, kg" in text and " ± " in text


def test_find_a_gap(record_property) -> None:
    notebook = run("find-a-gap", record_property)
    text = said(notebook)
    size, std = map(float, re.findall(r"Fc = (\S+) ± (\S+) N m", text)[0])
    assert abs(size - 0.4) < 0.02 and 0.0005 < std < 0.05
    before, after = map(float, re.findall(r"off by (\S+) mrad.*, (\S+) mended", text)[0])
    assert after < 0.3 * before
    assert pictures(notebook) == 2


def test_your_own_driver(record_property) -> None:
    notebook = run("your-own-driver", record_property)
    text = said(notebook)
    lost, damaged = (int(re.findall(rf"{word}\D+(\d+)", text)[0]) for word in ("lost", "checksum"))
    assert 80 < lost < 200 and 30 < damaged < 100  # a damaged one is lost as well
    assert "λ converged" in text and pictures(notebook) == 1
