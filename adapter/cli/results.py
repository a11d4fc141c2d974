"""What `run` and `replay` leave behind and print at the end."""

from __future__ import annotations

import argparse
import shlex
import sys
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.table import Table

from adapter.cli.common import console, plain, program_version, warn, write_json
from adapter.errors import ModelError
from adapter.export import to_urdf
from adapter.front_end import FrontEnd
from adapter.gap.monitor_book import sentence
from adapter.model import SelfModel
from adapter.outcome import Outcome
from adapter.report import write_report
from adapter.run_folder import run_data, save_run
from adapter.score import Reference


def results_folder(args: argparse.Namespace, kind: str) -> Path:
    """The folder results go to: the one asked for, or a new one in runs/."""
    folder: Path = args.out or Path("runs") / f"{datetime.now():%Y%m%d-%H%M%S}-{kind}"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def conclude(
    args: argparse.Namespace,
    folder: Path,
    outcome: Outcome,
    robot: SelfModel,
    reference: Reference,
    figures: dict[str, Any],
    front_end: FrontEnd,
    source: str,
) -> None:
    """Write model, figures and report; print the headline."""
    warn(front_end.messages)
    figures["model"] = str(folder / "model.json")
    data = run_data(
        outcome,
        robot,
        plain(figures),
        reference,
        delay_s=front_end.delay_s,
        first_moving_ns=front_end.first_moving_ns,
        program=f"panda-adapter {program_version()}",
        command=shlex.join(["adapter", *sys.argv[1:]]),
        source=source,
        robot=robot.name,
    )
    try:
        (folder / "model.urdf").write_text(to_urdf(data.model))
    except ModelError as error:
        warn([f"no URDF: {error}"])
    save_run(folder, data)
    if not args.no_report:
        figures["report"] = str(write_report(folder / "report.html", data))
    write_json(args.json, figures)
    print_figures(figures)


def print_figures(figures: dict[str, Any]) -> None:
    """The few figures that people want first."""
    lam, theta, tick = figures["lambda"], figures["theta"], figures["tick_us"]
    table = Table(show_header=False, box=None, pad_edge=False)
    refused = ", ".join(f"{count} {reason}" for reason, count in figures["refused"].items())
    table.add_row("samples", f"{figures['samples']}, learned {figures['learned']}")
    if refused:
        table.add_row("not learned", refused)
    table.add_row(
        f"λ ({lam['source']})",
        f"{_seconds(lam['converged_s'])}; worst joint {max(lam['rotation_error_rad']):.2g} rad, "
        f"{max(lam['position_error_m']):.2g} m against {lam['reference']}; "
        f"{lam['identifiable_rank']} directions shown",
    )
    rmse = theta["torque_rmse_nm"]
    fit = f"; fit {max(rmse):.3f} N m on the worst joint" if rmse else ""
    table.add_row("θ", _seconds(theta["converged_s"]) + fit)
    for change in theta["changes"]:
        load = change.get("payload")
        what = f"{load['m']:.3f} ± {load['m_std']:.3f} kg" if load else "superseded"
        table.add_row("change at the hand", f"at {change['stamp_s']:.2f} s: {what}")
    for line in disagreement_lines(figures.get("disagreements", [])):
        table.add_row("new disagreement", line)
    if theta["validation_torque_rmse_nm"]:
        values = " ".join(f"{value:.3f}" for value in theta["validation_torque_rmse_nm"])
        table.add_row("held-out torque", f"{values} N m")
    if tick.get("p50") is not None:
        table.add_row(
            "tick",
            f"p50 {tick['p50']:.0f} µs, p99 {tick['p99']:.0f} µs; "
            f"{figures['missed_deadlines']} deadlines missed",
        )
    table.add_row("model", figures["model"])
    if "report" in figures:
        table.add_row("report", figures["report"])
    console.print(table)


def disagreement_lines(reports: list[dict[str, Any]] | None) -> list[str]:
    """One line each; one that says so where nothing watched."""
    if reports is None:
        return ["not watched for in batches (--every above 1)"]
    return [sentence(report) for report in reports]


def _seconds(value: float | None) -> str:
    return "not converged" if value is None else f"converged {value:.2f} s after the first motion"
