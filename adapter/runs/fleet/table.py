"""A fleet as one table: a row for each recording."""

from __future__ import annotations

import csv
import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from adapter.errors import MeansError
from adapter.model.model_file import whole_file
from adapter.runs.fleet.arm import FleetArm, OfLog
from adapter.runs.fleet.fleet import Fleet


def rows(found: Fleet) -> list[dict[str, Any]]:
    """A row for each recording; columns of joints are numbered from 1."""
    out = [_row(arm, k) for arm in found.arms for k in range(len(arm.logs))]
    out += [{"log": x.path, "state": "broken", "why": x.why} for x in found.broken]
    out += [{"log": path, "state": "forgotten"} for path in found.forgotten]
    columns = dict.fromkeys(key for row in out for key in row)
    return [{key: row.get(key) for key in columns} for row in out]


def _row(arm: FleetArm, number: int) -> dict[str, Any]:
    log = arm.logs[number]
    taken, load = log.moments, log.load
    out = [f"{x.effect}_{x.joint}" for x in arm.standing_out if x.number == number]
    return {
        "log": taken.path,
        "state": "used" if log.used else "disagrees",
        "why": None,
        "arm": arm.name,
        "content": taken.content,
        "begin_s": taken.begin_s,
        "span_s": taken.span_s,
        "samples": taken.samples,
        "load_kg": None if load is None else load.mass,
        "load_std_kg": None if load is None else load.std,
        "disagrees": " ".join(map(str, log.disagrees)),
        "stands_out": " ".join(out),
        "worth_nats": log.worth,
        **dict(_by_joint(arm, log)),
    }


def _by_joint(arm: FleetArm, log: OfLog) -> Iterator[tuple[str, float]]:
    for j in range(len(log.rmse)):
        yield f"rmse_nm_{j + 1}", float(log.rmse[j])
    for k, name in enumerate(arm.effects):
        for j in range(len(log.rmse)):
            yield f"{name}_{j + 1}", float(log.effects[k, j])
            yield f"{name}_std_{j + 1}", float(log.effects_std[k, j])


def write_table(found: Fleet, path: Path) -> Path:
    """Write it, whole or not at all, as Parquet (.parquet) or CSV.

    Raises:
        MeansError: Parquet, and pyarrow is not installed.
    """
    listed = rows(found)
    if path.suffix == ".parquet":
        try:
            arrow = importlib.import_module("pyarrow")
            parquet = importlib.import_module("pyarrow.parquet")
        except ImportError:
            raise MeansError(
                f"{path}: Parquet is written with pyarrow; pip install 'panda-adapter[tables]'"
            ) from None
        with whole_file(path) as part:
            parquet.write_table(arrow.Table.from_pylist(listed), part)
        return path
    with whole_file(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(listed[0]) if listed else ["log"])
        writer.writeheader()
        writer.writerows(listed)
    return path
