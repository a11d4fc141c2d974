"""A recording as a data set of LeRobot, version 3, of one episode without pictures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapter import optional
from drivers.files.mcap import Log, read_log, read_position_log
from drivers.interface import Array, DriverError

_PART = "chunk-000/file-000.parquet"
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_TASK = {"task": ["motion"], "task_index": [0]}
_INDEXED = {  # so that pandas takes the tasks for the index, as LeRobot does
    "index_columns": ["task"],
    "column_indexes": [],
    "columns": [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": of, "metadata": None}
        for name, kind, of in (("task", "unicode", "object"), ("task_index", "int64", "int64"))
    ],
}


def write_lerobot(path: Path, folder: Path) -> list[str]:
    """Write the data set; returns what is not in it as it was recorded, a sentence each.

    Numbers are float32, as in LeRobot's own; stamps are seconds since the first sample. `action`
    is the command that held at each sample, of an arm that tells torques `observation.effort`.

    Raises:
        DriverError: the recording is unreadable, or the folder holds something. MeansError: no
            PyArrow.
    """
    if folder.exists() and any(folder.iterdir()):
        raise DriverError(f"{folder}: holds something; give a new folder")
    pa, parquet = optional.load("pyarrow"), optional.load("pyarrow.parquet")
    log = read_position_log(path) or read_log(path)
    told, said = _signals(log)
    rows, n = len(log), len(log.joint_names)
    names = [f"{name}.pos" for name in log.joint_names]
    since_s = 1e-9 * (log.stamp_ns - log.first_ns)
    fps = max(round((rows - 1) / since_s[-1]), 1) if rows > 1 and since_s[-1] > 0 else 1
    counted = {"frame_index": np.arange(rows), "index": np.arange(rows)}
    counted |= {key: np.zeros(rows, dtype=np.int64) for key in ("episode_index", "task_index")}
    single: dict[str, NDArray[Any]] = {"timestamp": since_s.astype(np.float32), **counted}
    wide = {"dtype": "float32", "shape": [n], "names": names}
    features: dict[str, Any] = {key: dict(wide) for key in told}
    for key, x in single.items():
        features[key] = {"dtype": str(x.dtype), "shape": [1], "names": None}
    flat = {key: pa.array(x.astype(np.float32).ravel()) for key, x in told.items()}
    lists = {key: pa.FixedSizeListArray.from_arrays(x, n) for key, x in flat.items()}
    stats: dict[str, dict[str, list[Any]]] = {}
    for key, x in {**told, **single}.items():
        table = x.reshape(rows, -1)
        stats[key] = {k: getattr(table, k)(axis=0).tolist() for k in ("min", "max", "mean", "std")}
        stats[key] |= {k: np.quantile(table, q, axis=0).tolist() for k, q in _QUANTILES.items()}
        stats[key]["count"] = [rows]
    episode = {"episode_index": 0, "tasks": _TASK["task"], "length": rows}
    episode |= {"dataset_from_index": 0, "dataset_to_index": rows}
    episode |= {f"{a}/{b}_index": 0 for a in ("data", "meta/episodes") for b in ("chunk", "file")}
    episode |= {f"stats/{key}/{k}": x for key, each in stats.items() for k, x in each.items()}
    tasks = pa.table(_TASK).replace_schema_metadata({"pandas": json.dumps(_INDEXED)})
    for table, name in (
        (pa.table({**lists, **single}), f"data/{_PART}"),
        (pa.Table.from_pylist([episode]), f"meta/episodes/{_PART}"),
        (tasks, "meta/tasks.parquet"),
    ):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        parquet.write_table(table, folder / name)
    any_part = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    sizes = {"chunks_size": 1000, "data_files_size_in_mb": 100, "video_files_size_in_mb": 200}
    totals = {"total_episodes": 1, "total_frames": rows, "total_tasks": 1}
    info = {"codebase_version": "v3.0", "robot_type": None, "fps": fps, **totals, **sizes}
    info |= {"splits": {"train": "0:1"}, "features": features}
    info |= {"data_path": any_part, "video_path": None}
    for name, content in (("stats", stats), ("info", info)):  # a folder without the last is none
        (folder / "meta" / f"{name}.json").write_text(json.dumps(content, indent=4))
    return said


def _signals(log: Log) -> tuple[dict[str, Array], list[str]]:
    """Features of n joints by name, (m, n) each, and what of the recording is not in them."""
    kinds = {"state": log.q, "velocity": log.dq, "effort": log.tau}
    found = {f"observation.{k}": x for k, x in kinds.items() if np.isfinite(x).all()}
    commands, said = log.commands, list[str]()
    if commands is None or commands.q is None or not len(commands.q):
        return found, [f"{log.path}: has no commanded positions, and so the data set no action"]
    at = commands.holding(log.stamp_ns)
    if len(at) != len(commands.q) or np.any(log.stamp_ns != commands.stamp_ns):
        said.append(f"{log.path}: an action is the command that held at the sample; other are lost")
    return {**found, "action": commands.q[np.maximum(at, 0)]}, said
