"""`adapter fleet`: one model per arm from many recordings."""

from __future__ import annotations

import argparse
import csv
import re
from pathlib import Path
from typing import Any

from rich.progress import Progress
from rich.table import Column

from adapter import optional
from adapter.cli.common import robot_of, told_of
from adapter.cli.exit_codes import ExitCode
from adapter.cli.results import write_urdf
from adapter.errors import MeansError
from adapter.model.model_file import save_model, whole_file
from adapter.report import fleet_page
from adapter.runs.fleet import fleet
from adapter.runs.fleet.arm import FleetArm
from adapter.runs.terminal import console, print_table, results_folder, say, show, warn, write_json


def run(args: argparse.Namespace) -> int:
    """Carry the subcommand out."""
    robot = robot_of(args, args.model)
    given = fleet.found_logs(args.logs)
    folder = results_folder(args.out, "fleet")
    manifest = fleet.read_manifest(args.manifest) if args.manifest else fleet.Manifest({}, {})
    how = args.workers, args.cluster, args.by, manifest, args.topic
    settings = fleet.Settings(folder, *how, told_of(args))
    fleet.forget(args.forget, robot, settings)
    fleet.forget(args.remember, robot, settings, back=True)
    say(f"{len(given)} recording{'s' * (len(given) != 1)}; moments are kept in {folder}")
    with Progress(console=console, transient=True, disable=args.quiet) as bar:
        task = bar.add_task("reading", total=len(given))
        settings = settings._replace(progress=lambda n, m: bar.update(task, completed=n, total=m))
        found = fleet.learn_fleet(given, robot, settings)
    warn([f"{x.path}: left out: {x.why}" for x in found.broken])
    told = {*manifest.arms, *manifest.told}
    if told and not told & {*given, *(x.moments.path for a in found.arms for x in a.logs)}:
        warn([f"{args.manifest}: tells of none of these recordings (paths are as in its folder)"])
    warn([f"{path}: the same recording as {other}; it counts once" for path, other in found.alike])
    figures = fleet_page.as_json(found)
    for arm, names in zip(found.arms, figures["arms"], strict=True):
        name = re.sub(r"[^\w.-]+", "_", arm.name).strip("._") or "arm"
        path = save_model(arm.model, folder / f"{name}.json")
        write_urdf(arm.model, path.with_suffix(".urdf"), f"{arm.name}: ")
        names["model"] = str(path)
        if args.quiet:
            continue
        shown = fleet_page.to_be_shown(arm, 40)  # of more, those that there is something to say of
        heads = [Column(x, no_wrap=k > 0, overflow="fold") for k, x in enumerate(fleet_page.HEADS)]
        print_table(heads, fleet_page.log_rows(arm, shown), title=arm.name, title_justify="left")
        if len(shown) < len(arm.logs):
            show(f"{len(arm.logs) - len(shown)} recordings of which nothing is to be said")
        for line in fleet_page.sentences(arm):
            show(line)
    for line in fleet_page.summary(found):
        show(line)
    figures["table"] = str(_write_table(found, folder))
    page = folder / "fleet.html"
    page.unlink(missing_ok=True)  # of earlier models
    if not args.no_report:
        figures["report"] = str(fleet_page.write_fleet_page(found, page))
        show(figures["report"])
    write_json(args.json, figures)
    return ExitCode.DONE if found.arms else ExitCode.NOTHING_LEARNED


def _write_table(found: fleet.Fleet, folder: Path) -> Path:
    """A row for each recording, whole or not at all: Parquet, or CSV where there is no pyarrow.

    Columns of joints are numbered from 1.
    """
    rows = [_row(arm, k) for arm in found.arms for k in range(len(arm.logs))]
    rows += [{"log": x.path, "state": "broken", "why": x.why} for x in found.broken]
    rows += [{"log": path, "state": "forgotten"} for path in found.forgotten]
    columns = dict.fromkeys(key for row in rows for key in row)
    listed = [{key: row.get(key) for key in columns} for row in rows]
    path = folder / "fleet.parquet"
    try:
        arrow, parquet = optional.load("pyarrow"), optional.load("pyarrow.parquet")
    except MeansError as error:
        warn([f"{path}: {error}; a CSV table is written instead"])
        path = path.with_suffix(".csv")
        with whole_file(path) as part, part.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(listed[0]) if listed else ["log"])
            writer.writeheader()
            writer.writerows(listed)
        return path
    with whole_file(path) as part:
        parquet.write_table(arrow.Table.from_pylist(listed), part)
    return path


def _row(arm: FleetArm, number: int) -> dict[str, Any]:
    log = arm.logs[number]
    load = log.load
    out = [f"{x.effect}_{x.joint}" for x in arm.standing_out if x.number == number]
    by_joint = {f"rmse_nm_{j}": float(x) for j, x in enumerate(log.rmse, start=1)}
    for k, name in enumerate(arm.effects):
        for j in range(len(log.rmse)):
            by_joint[f"{name}_{j + 1}"] = float(log.effects[k, j])
            by_joint[f"{name}_std_{j + 1}"] = float(log.effects_std[k, j])
    return {
        "log": log.moments.path,
        "state": "used" if log.used else "disagrees",
        "why": None,
        "arm": arm.name,
        **{key: getattr(log.moments, key) for key in ("content", "begin_s", "span_s", "samples")},
        "load_kg": None if load is None else load.mass,
        "load_std_kg": None if load is None else load.std,
        "disagrees": " ".join(map(str, log.disagrees)),
        "stands_out": " ".join(out),
        "worth_nats": log.worth,
        "notes": "; ".join(log.moments.notes),
        **by_joint,
    }
