"""What `run` and `replay` leave behind and print at the end; `export` and `report` from it."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from rich.table import Column, Table
from rich.text import Text

from adapter.cli.exit_codes import ExitCode
from adapter.cli.files_options import FORMATS
from adapter.effects.active import check_effects, with_bodies
from adapter.effects.ranges import ranges
from adapter.effects.robots import read_robot, robot_urdf
from adapter.errors import ModelError
from adapter.gap.monitor_judge import sentence
from adapter.gap.servo_files import servo_mjcf, servo_urdf
from adapter.gap.servo_model import read_servos
from adapter.model.model_file import load_model
from adapter.model.numbers import plus_minus
from adapter.model.self_model import SelfModel, theta_doubt
from adapter.model.tree import Tree
from adapter.report import write_report
from adapter.report.next_steps import next_steps
from adapter.report.trust import headline
from adapter.report.words import NOT_WATCHED, not_learned, small
from adapter.report.worth import Worth
from adapter.runs.library import EXPORTED
from adapter.runs.outcome import Outcome
from adapter.runs.run_folder import RunData, load_run, run_data, save_run
from adapter.runs.score import Reference, counted_from
from adapter.runs.terminal import json_ready, output, program_version, show, warn, write_json
from adapter.signals.front_end import FrontEnd
from adapter.signals.lerobot import write_lerobot


class Learned(NamedTuple):
    """What a run or a replay ended with, and what it is judged against.

    Attributes:
        accounts: lines on how long things took and the like, told behind the figures.
    """

    outcome: Outcome
    robot: SelfModel
    reference: Reference
    front_end: FrontEnd
    accounts: Sequence[str] = ()


def conclude(
    args: argparse.Namespace, folder: Path, learned: Learned, figures: dict[str, Any], source: str
) -> None:
    """Write model, figures and report; print the headline."""
    outcome, robot, reference, front_end, accounts = learned
    figures["model"] = str(folder / "model.json")
    data = run_data(
        outcome,
        robot,
        json_ready(figures),
        reference,
        delay_s=front_end.delay_s,
        first_moving_ns=front_end.first_moving_ns,
        program=f"panda-adapter {program_version()}",
        command=shlex.join(["adapter", *sys.argv[1:]]),
        source=source,
        robot=robot.name,
    )
    doubt = filter(None, [theta_doubt(data.model)])
    warn([*front_end.messages, *outcome.lam_notes, *(f"model.json, θ: {why}" for why in doubt)])
    page, other = folder / "report.html", folder / "model.urdf"
    for stale in (page, other):  # of an earlier model, which they alone describe
        stale.unlink(missing_ok=True)
    write_urdf(data.model, other)
    save_run(folder, data)
    if not args.no_report:
        figures["report"] = str(write_report(page, data))
    write_json(args.json, figures)
    print_figures(data, figures.get("report"), accounts)


def code_of(outcome: Outcome, usual: ExitCode = ExitCode.DONE) -> ExitCode:
    """How a run with results ends: `usual` where θ had converged, or something worse happened."""
    if not outcome.learned or outcome.verdict.refusal:
        return ExitCode.NOTHING_LEARNED
    return usual if usual or outcome.theta_settled else ExitCode.NOT_CONVERGED


def print_figures(data: RunData, report: str | None, accounts: Sequence[str]) -> None:
    """What changed and what it is worth, the figures behind it, and what to do next."""
    worth = Worth.of(data)
    for number, said in enumerate(headline(data, worth)):
        output.print(said, style="bold" if number == 0 else "", soft_wrap=True)
    output.print(_figures(data.figures, data.documented.tree, report))
    for line in accounts:
        output.print(line, style="dim", soft_wrap=True, highlight=False)
    for step in next_steps(data, worth):
        output.print(Text.assemble(("next ", "cyan"), step.why), soft_wrap=True)
        if step.command:
            output.print(f"  {step.command}", soft_wrap=True)


def _figures(figures: dict[str, Any], tree: Tree, report: str | None) -> Table:
    start_s = figures.get("start_s") or 0.0
    lam, theta = figures["lambda"], figures["theta"]
    table = Table("", Column("", overflow="fold"), show_header=False, box=None, pad_edge=False)
    reasons = figures["refused"].items()
    refused = ", ".join(f"{count} {reason.replace('_', ' ')}" for reason, count in reasons)
    table.add_row("samples", f"{figures['samples']}, learned {figures['learned']}")
    if refused:
        table.add_row("not learned", refused)
    table.add_row(
        f"λ ({lam['source']})",
        f"{_reached(figures, 'lambda')}; worst joint "
        f"{small(1e3 * max(lam['rotation_error_rad']), 'mrad')}, "
        f"{small(1e3 * max(lam['position_error_m']), 'mm')} from {lam['reference']}; "
        f"{lam['identifiable_rank']} directions shown",
    )
    if lam["restarts"]:
        table.add_row("  out of wrong valleys", f"joints started anew {lam['restarts']} times")
    for words in lam["filled"]:
        table.add_row("  from the documentation", words)
    rmse = theta["torque_rmse_nm"]
    unit = tree.unit("N m", "N", rmse.index(max(rmse))) if rmse else ""
    fit = f"; fit {max(rmse):.3f} {unit} on the worst joint" if rmse else ""
    table.add_row("θ", _reached(figures, "theta") + fit)
    for change in theta["changes"]:
        load = change.get("payload")
        what = f"{plus_minus(load['m'], load['m_std'])} kg" if load else "superseded"
        table.add_row("change at the hand", f"at {change['stamp_s'] - start_s:.2f} s: {what}")
    watched = figures.get("disagreements", []) is not None
    for line in [sentence(x, start_s) for x in not_learned(figures)] if watched else [NOT_WATCHED]:
        table.add_row("new disagreement", line)
    if theta["validation_torque_rmse_nm"]:
        values = " ".join(f"{value:.3f}" for value in theta["validation_torque_rmse_nm"])
        table.add_row("held-out torque", f"{values} {tree.unit('N m', 'N')}")
    table.add_row("model", figures["model"])
    if report:
        table.add_row("report", report)
    return table


def _reached(figures: dict[str, Any], which: str) -> str:
    at = figures[which]["converged_s"]
    if at is None:
        late = which == "theta" and figures[which]["settled"]
        return "converged at the end" if late else "not converged"
    if not at and figures["slow_s"]:
        return "converged in the slow phase"
    return f"converged {at:.2f} s after {counted_from(figures)}"


def write_urdf(model: SelfModel, path: Path, whose: str = "", told: bool = False) -> bool:
    """Write a model as URDF, or warn where a body of it cannot exist; whether it was written.

    Args:
        whose: said before the warning; told: warn as well of what the file lacks.
    """
    try:
        written = robot_urdf(model)
    except ModelError as error:
        warn([f"{whose}no URDF: {error}"])
        return False
    path.write_bytes(written.text.encode())
    if told:
        warn([f"{path}: {what}" for what in (written.lacks, *written.notes) if what])
    return True


def run_export(args: argparse.Namespace) -> int:
    """Carry `export` out."""
    if args.lerobot is not None:
        warn(write_lerobot(args.model, args.lerobot))
        write_json(args.json, {"lerobot": str(args.lerobot)})
        show(str(args.lerobot))
        return 0
    writers = {kind: EXPORTED[ends] for kind, (ends, _) in FORMATS.items()}
    if args.servo is None:
        model = check_effects(load_model(args.model), args.model)
    else:
        model = read_robot(str(args.model))
        servos = read_servos(args.servo, model.tree.joint_names)
        with_servos = {"urdf": servo_urdf, "mjcf": servo_mjcf}
        writers = {kind: partial(write, servos=servos) for kind, write in with_servos.items()}
    facts: dict[str, Any] = {"model": str(args.model), "lambda_source": model.lambda_source}
    for key in ("lambda_filled", "theta_filled"):
        facts[key] = list(model.provenance.get(key, ()))
    drawn = [] if args.samples is None else with_bodies(model).sample(args.samples, args.seed)
    for kind, text_of in writers.items():
        path, ends = getattr(args, kind), FORMATS[kind][0]
        if path is None:
            continue
        fits = args.onto is not None and args.onto.suffix[:4] == ends[:4]
        write = partial(text_of, onto=args.onto if fits else None, alone=args.alone)
        written = write(model)
        if args.samples is None or kind == "c":
            path.write_bytes(written.text.encode())
        else:
            path.mkdir(parents=True, exist_ok=True)
            for number, own in enumerate(drawn):
                file = path / f"{number:04d}{ends}"
                file.write_bytes(write(own).text.encode())
        warn([f"{path}: {note}" for note in written.notes])
        facts[kind] = str(path)
        facts["onto"] = facts.get("onto") or written.onto
        facts["left_out"] = sorted({*facts.get("left_out", ()), *written.left_out})
        facts["notes"] = [*facts.get("notes", ()), *written.notes]
        onto = "" if written.onto is None else f" onto {written.onto}"
        show(f"{path}: {model.name}{onto}, λ {model.lambda_source}")
        if written.lacks:
            show(f"  {written.lacks}")
    if args.ranges is not None:
        found = ranges(model)
        write_json(args.ranges, found)
        facts["ranges"] = str(args.ranges)
        show(f"{args.ranges}: {len(found['directions'])} directions, {model.name}")
    write_json(args.json, facts)
    for key, what in (("lambda_filled", "no motion"), ("theta_filled", "no torque")):
        if facts[key]:
            show(f"from the documentation, as {what} shows it alone:")
        for words in facts[key]:
            show(f"  {words}")
    return 0


def run_report(args: argparse.Namespace) -> int:
    """Carry `report` out."""
    page = write_report(args.html or args.folder / "report.html", load_run(args.folder))
    write_json(args.json, {"report": str(page)})
    show(str(page))
    return 0
