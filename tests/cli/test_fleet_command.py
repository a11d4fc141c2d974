"""`adapter fleet` as a user calls it: what it writes, prints, and refuses."""

from __future__ import annotations

import csv
import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from adapter.cli import main
from adapter.cli.exit_codes import ExitCode
from adapter.model.model_file import load_model
from drivers.files.mcap import read_log, write_log
from drivers.files.mcap.writer import McapWriter

RECORDING = Path(__file__).parents[2] / "recordings" / "panda_nominal_6s.mcap"


def fleet(*arguments: object) -> int:
    return main(["fleet", *map(str, arguments), "--robot", "panda", "--workers", "0"])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two arms' folders, one of them with a file that is no recording."""
    for arm in ("left", "right"):
        (tmp_path / "logs" / arm).mkdir(parents=True)
    shutil.copy(RECORDING, tmp_path / "logs" / "left" / "one.mcap")
    (tmp_path / "logs" / "right" / "torn.mcap").write_bytes(b"nothing")
    return tmp_path


def test_what_is_left_behind(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="the extra [tables] is not installed")
    out, figures = folder / "out", folder / "fleet.json"
    assert fleet(folder / "logs", "--by", "folder", "--out", out, "--json", figures) == 0
    told = json.loads(figures.read_text())
    assert [(arm["name"], len(arm["logs"])) for arm in told["arms"]] == [("left", 1)]
    assert [Path(x["path"]).name for x in told["broken"]] == ["torn.mcap"]
    assert load_model(out / "left.json").theta.shape == (7, 10)
    assert (out / "left.urdf").read_text().startswith("<?xml")
    rows = parquet.read_table(out / "fleet.parquet").to_pylist()
    assert [row["state"] for row in rows] == ["used", "broken"]
    assert rows[0]["arm"] == "left" and rows[0]["viscous_friction_3"] is not None
    page = (out / "fleet.html").read_text()
    assert "torn.mcap" in page and "left" in page
    printed = capsys.readouterr()
    assert "one.mcap" in printed.out and "left out" in printed.err
    gone = folder / "logs" / "left" / "one.mcap"
    assert fleet("--out", out, "--forget", gone) == ExitCode.NOTHING_LEARNED


def test_recordings_of_one_name_are_told_apart_by_their_folders(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for day in ("monday", "friday"):
        (tmp_path / day).mkdir()
    log, dated = read_log(RECORDING), {"begun": "2026-05-01T12:00:00+00:00"}
    shutil.copy(RECORDING, tmp_path / "monday" / "recording.mcap")
    write_log(log, tmp_path / "friday" / "recording.mcap", dated)
    with McapWriter(tmp_path / "friday" / "motion.mcap", log.joint_names) as plan:
        plan.write_trajectory(log.stamp_ns[:9], np.stack([log.q[:9], log.dq[:9], log.dq[:9]], 1))
    assert fleet(tmp_path, "--out", tmp_path / "out", "--no-report") == 0
    printed = capsys.readouterr()
    assert "\nmonday  " in printed.out and "\nfriday     2026-05-01 12:00" in printed.out
    assert "2 recordings read, 1 only planned" in printed.out and "left out" not in printed.err


def test_without_pyarrow_a_csv_table(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    out = folder / "out"
    assert fleet(folder / "logs" / "left", "--out", out, "--no-report", "--quiet") == 0
    with (out / "fleet.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert row["state"] == "used"
    assert "panda-adapter[tables]" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "give LOGs, or --out"),
        ((RECORDING, "--forget", RECORDING), "--forget needs --out"),
        ((RECORDING, "--manifest", "none.csv"), "none.csv"),
    ],
)
def test_what_cannot_be_is_said(arguments: tuple[object, ...], said: str, refused) -> None:
    assert said in refused("fleet", *arguments, "--robot", "panda", "--workers", "0")
