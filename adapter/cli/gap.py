"""`adapter gap`: where model and data disagree, which effect is missing, the gap with it.

Of a position-controlled arm, whose recordings have commands and encoders but no torque, the servos.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.text import Text

from adapter.cli.common import robot_of, told_of
from adapter.cli.exit_codes import ExitCode
from adapter.cli.results import write_urdf
from adapter.effects.kept import with_kept
from adapter.errors import MeansError, UsageError
from adapter.gap import servo_words
from adapter.gap.result import GapResult, Shortfall
from adapter.gap.servo import explain
from adapter.gap.servo_arms import beside
from adapter.gap.servo_model import read_servos
from adapter.gap.words import as_json, console_summary
from adapter.gap.workflow import GapSettings, find_gap, names_of
from adapter.model.model_file import load_model
from adapter.report.gap_page import render_gap_page
from adapter.report.html import write_whole
from adapter.report.servo_page import render_servo_page
from adapter.runs import terminal
from adapter.runs.compiling import announce_compiling
from adapter.screening.screen import RecordingRefused
from adapter.signals.importer import read_log, read_position_log
from adapter.simulate import Rollouts
from drivers.files.mcap import Log

WITH_TORQUE = (  # options
    *("validate_from", "rounds", "turn_or_zero", "tau", "trust_log"),
    *("tau_gain", "gear", "known_load"),
)


def run(args: argparse.Namespace) -> int:
    """Carry the subcommand out."""
    with with_kept(args.kept):
        return _run(args)


def _run(args: argparse.Namespace) -> int:
    positions = _position_logs(args)
    if positions is not None:
        return _explain_positions(args, *positions)
    logs, hold_out = args.logs, tuple(args.hold_out)
    if args.topic is not None:  # read here
        read = {path: read_log(path, topic=args.topic) for path in {*logs, *hold_out}}
        logs, hold_out = [read[path] for path in logs], tuple(read[path] for path in hold_out)
    told = told_of(args)
    settings = GapSettings(validate_from_s=args.validate_from, hold_out=hold_out, told=told)
    if args.inertia_prior is not None:
        settings = replace(settings, inertia_prior=args.inertia_prior)
    if args.rounds is not None:
        settings = replace(settings, rounds=args.rounds)
    announce_compiling(terminal.say)
    nominal = robot_of(args, args.model)
    folder = terminal.results_folder(args.out, "gap")
    model_out = folder / "model.json"
    for new in (model_out, model_out.with_suffix(".urdf")):  # never over the one it comes from
        if new.exists() and Path(args.model).exists() and new.samefile(args.model):
            raise UsageError(f"--out {folder} would overwrite {args.model}; give another folder")
    rollouts: Rollouts | None = None
    try:
        rollouts = None if args.no_simulation else Rollouts(args.simulator or "pybullet")
    except MeansError as error:
        if args.simulator is not None:
            raise
        terminal.warn([f"torques are compared, and nothing is simulated: {error}"])
    try:
        with _progress(args.quiet) as tell:
            result = find_gap(logs, nominal, settings, rollouts, model_out, tell)
    except RecordingRefused as refusal:
        names, called = nominal.tree.joint_names, names_of([*args.logs, *args.hold_out])
        nothing = GapResult.untold(names, nominal.name, called, args.model, str(refusal))
        _write(args, folder, {**as_json(nothing), "refused": refusal.kind})
        terminal.complain(refusal)
        return ExitCode.WRONG_USE
    result = replace(result, model_in=args.model)
    if rollouts is not None:
        notes = (*result.notes, *rollouts.troubles)
        result = replace(_without_empty_rollouts(result), notes=notes, simulator=rollouts.simulator)
    _conclude(args, folder, result)
    return 0


@contextmanager
def _progress(quiet: bool) -> Iterator[Callable[[str], None]]:
    if quiet:
        yield lambda text: None
        return
    with terminal.console.status("starting") as status:
        yield lambda text: status.update(Text(text))


def _without_empty_rollouts(result: GapResult) -> GapResult:
    """Rollouts that could not be simulated are none."""

    def known(figures: Shortfall) -> Shortfall:
        errors = figures.rollout_rmse_rad
        if errors is None or np.isfinite(errors).any():
            return figures
        return replace(figures, rollout_rmse_rad=None, rollout_rmse_rad_s=None)

    before, after = known(result.before), known(result.after)
    rollouts = result.rollouts if before.rollout_rmse_rad is not None else ()
    return replace(result, before=before, after=after, rollouts=rollouts)


def _conclude(args: argparse.Namespace, folder: Path, result: GapResult) -> None:
    """Print the summary; write URDF, page and figures beside the model."""
    for line in console_summary(result):
        terminal.output.print(Text.from_markup(line), soft_wrap=True)
    more: dict[str, Any] = {}
    for stale in ("report.html", "model.urdf"):  # of an earlier model
        (folder / stale).unlink(missing_ok=True)
    if result.model_out is not None:
        urdf = folder / "model.urdf"
        written = write_urdf(load_model(result.model_out), urdf, told=True)
        more["urdf_out"] = str(urdf) if written else None
    if not args.no_report:
        page = write_whole(folder / "report.html", render_gap_page(result, folder))
        more["report"] = str(page)
    _write(args, folder, {**as_json(result), **more})
    if "report" in more:
        terminal.show(f"report {more['report']}")


def _write(args: argparse.Namespace, folder: Path, figures: Mapping[str, object]) -> None:
    terminal.write_json(folder / "gap.json", figures)
    terminal.write_json(args.json, figures)


def _position_logs(args: argparse.Namespace) -> tuple[list[Log], list[Log]] | None:
    """The recordings and those held out; None where they are not of such an arm.

    Raises:
        DriverError: a file is unreadable. UsageError: some have torques and others have not.
    """
    paths = [*args.logs, *args.hold_out]
    read = {path: read_position_log(path, args.topic) for path in dict.fromkeys(paths)}
    without = [path for path, log in read.items() if log is None]
    if len(without) == len(read):
        if args.servo is not None or args.beside:
            option = "--beside" if args.servo is None else "--servo"
            raise UsageError(
                f"{option}: {without[0]} holds no position commands beside positions without "
                "efforts (/joint_commands and /joint_states)"
            )
        return None
    if without:
        said = "not commands and positions alone, as the others are; give recordings of one kind"
        raise UsageError(f"{', '.join(map(str, without))}: {said}")
    found = {path: log for path, log in read.items() if log is not None}
    return [found[path] for path in args.logs], [found[path] for path in args.hold_out]


def _explain_positions(args: argparse.Namespace, logs: list[Log], hold_out: list[Log]) -> int:
    """What commands and encoders alone tell of the servos; returns the exit code."""
    unusable = [name for name in WITH_TORQUE if getattr(args, name)]
    if unusable:
        options = ", ".join("--" + name.replace("_", "-") for name in unusable)
        raise UsageError(f"{options}: for recordings with torques; these have commands alone")
    model = robot_of(args, args.model)
    names = model.tree.joint_names
    documented = None if args.servo is None else read_servos(args.servo, names)
    announce_compiling(terminal.say)
    folder = terminal.results_folder(args.out, "gap")
    target = folder / "servo.toml"
    if args.servo is not None and target.exists() and target.samefile(args.servo):
        raise UsageError(f"--out {folder} would overwrite {args.servo}; give another folder")
    more = {} if args.inertia_prior is None else {"inertia_prior": args.inertia_prior}
    try:
        with _progress(args.quiet) as tell:
            gap = explain(logs, model, documented, hold_out, progress=tell, **more)
    except RecordingRefused as refusal:
        _write(args, folder, {"headline": str(refusal), "problem": str(refusal), "findings": []})
        terminal.complain(refusal)
        return ExitCode.DONE if refusal.kind.is_an_answer else ExitCode.WRONG_USE
    gap.servos.save(target)
    facts = {**servo_words.as_json(gap), "servos_out": str(target)}
    own = "this arm" if args.out is None else folder.resolve().name
    numbers = beside(facts, own, args.beside) if args.beside else []
    facts["beside"] = [asdict(number) for number in numbers]
    page = folder / "report.html"
    page.unlink(missing_ok=True)  # of an earlier result
    if not args.no_report:
        text = render_servo_page(gap, str(args.model), target, numbers)
        facts["report"] = str(write_whole(page, text))
    _write(args, folder, facts)
    for line in servo_words.lines(gap):
        terminal.output.print(Text.from_markup(line), soft_wrap=True)
    for line in (text for number in numbers for text in number.sentences()):
        terminal.show(f"differs: {line}")
    if numbers and not any(number.odd for number in numbers):
        terminal.show(f"{len(numbers)} numbers beside other arms: none differs beyond both doubts")
    terminal.say(f"servos {target}")
    if not args.no_report:
        terminal.show(f"report {page}")
    return 0
