"""The first hour with servos, word for word, on a small simulated data set of LeRobot."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from adapter.effects.robots import read_robot, robot_urdf
from adapter.signals.lerobot import write_lerobot
from tests.helpers.pages import PATIENCE_S, blocks, commands, give
from tests.helpers.position_arm import Drawn, position_arm

PAGE = "docs/first-hour-with-servos.md"
pytestmark = pytest.mark.timeout(2 * PATIENCE_S)


def test_from_a_data_set_to_a_simulated_arm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm = position_arm(51, Drawn(8.0, 5e-3))
    for episode, kind in enumerate(("sines", "points")):
        log, folder = tmp_path / f"{kind}.mcap", tmp_path / f"set_{episode}"
        arm.moved(kind, 51 + episode).write(log)
        write_lerobot(log, folder)
    (tmp_path / "set_0").rename(tmp_path / "so101_set")
    more = pq.read_table(tmp_path / "set_1" / "data" / "chunk-000" / "file-000.parquet")
    place = more.column_names.index("episode_index")
    more = more.set_column(place, "episode_index", pa.array(np.ones(len(more), dtype=np.int64)))
    pq.write_table(more, tmp_path / "so101_set" / "data" / "chunk-000" / "file-001.parquet")
    (tmp_path / "so101.urdf").write_text(robot_urdf(read_robot("panda"), alone=True).text)
    lines = [line for block in blocks("sh", PAGE) for line in commands(block)]
    assert len(lines) == 6
    for line in lines:
        give(line, tmp_path)
    figures = json.loads((tmp_path / "runs" / "so101" / "gap.json").read_text())
    assert 10.0 * figures["after"]["hand_rmse_m"] < figures["before"]["hand_rmse_m"]
    later = json.loads((tmp_path / "runs" / "so101_later" / "gap.json").read_text())
    assert later["findings"] == []
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(blocks("python", PAGE)[0], names)
    data, goal = names["data"], np.clip(names["goals"][-1], *names["model"].jnt_range.T)
    assert data.time == pytest.approx(1.0)
    assert 1e-4 < np.abs(data.qpos - goal).max() < 0.1
    exec(next(x for x in blocks("python", "docs/python.md") if "read_servos(" in x), names)
    assert 1e-4 < np.abs(names["q"] - names["goals"]).max() < 0.1
