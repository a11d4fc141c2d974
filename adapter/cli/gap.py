"""`adapter gap`: where model and data disagree, which effect is missing, the gap with it."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.text import Text

from adapter.cli import servo_gap
from adapter.cli.common import robot_of, told_of
from adapter.cli.exit_codes import ExitCode
from adapter.cli.results import write_robot
from adapter.effects.export import robot_urdf
from adapter.errors import MeansError, ModelError, UsageError
from adapter.gap.result import GapResult, Shortfall
from adapter.gap.words import as_json, console_summary
from adapter.gap.workflow import GapSettings, find_gap, names_of
from adapter.model.model_file import load_model
from adapter.model.self_model import SelfModel
from adapter.report.gap_page import write_gap_page
from adapter.runs.compiling import announce_compiling
from adapter.runs.terminal import (
    complain,
    console,
    output,
    results_folder,
    say,
    show,
    warn,
    write_json,
)
from adapter.screening.screen import RecordingRefused
from adapter.simulate import Rollouts
from drivers.files.mcap import Log, read_log


def run(args: argparse.Namespace) -> int:
    """Carry the subcommand out."""
    positions = servo_gap.position_logs(args)
    if positions is not None:
        return servo_gap.run(args, *positions)
    logs, hold_out = _opened(args)
    told = told_of(args)
    settings = GapSettings(validate_from_s=args.validate_from, hold_out=hold_out, told=told)
    if args.inertia_prior is not None:
        settings = replace(settings, inertia_prior=args.inertia_prior)
    if args.rounds is not None:
        settings = replace(settings, rounds=args.rounds)
    announce_compiling(say)
    nominal = robot_of(args, args.model)
    folder = results_folder(args.out, "gap")
    model_out = _new_model(folder, args.model)
    rollouts = _rollouts(args)
    try:
        with _progress(args.quiet) as tell:
            result = find_gap(logs, nominal, settings, rollouts, model_out, tell)
    except RecordingRefused as refusal:
        names, called = nominal.tree.joint_names, names_of([*args.logs, *args.hold_out])
        nothing = GapResult.untold(names, nominal.name, called, args.model, str(refusal))
        _write(args, folder, nothing, {"refused": refusal.kind})
        complain(refusal)
        return ExitCode.WRONG_USE
    result = replace(result, model_in=args.model)
    if rollouts is not None:
        notes = (*result.notes, *rollouts.troubles)
        result = replace(_without_empty_rollouts(result), notes=notes, simulator=rollouts.simulator)
    _conclude(args, folder, result)
    return 0


def _rollouts(args: argparse.Namespace) -> Rollouts | None:
    """What simulates, where it is wanted and there. Raises MeansError for one that was named."""
    if args.no_simulation:
        return None
    try:
        return Rollouts(args.simulator or "pybullet")
    except MeansError as error:
        if args.simulator is not None:
            raise
        warn([f"torques are compared, and nothing is simulated: {error}"])
        return None


def _opened(
    args: argparse.Namespace,
) -> tuple[Sequence[Path | Log], tuple[Path | Log, ...]]:
    """The recordings and those held out; read here where a topic was named. Raises DriverError."""
    if args.topic is None:
        return args.logs, tuple(args.hold_out)
    read = {path: read_log(path, topic=args.topic) for path in {*args.logs, *args.hold_out}}
    return [read[path] for path in args.logs], tuple(read[path] for path in args.hold_out)


def _new_model(folder: Path, model: str) -> Path:
    """Where the new model goes: never over the one it comes from. Raises UsageError."""
    path = folder / "model.json"
    for new in (path, path.with_suffix(".urdf")):
        if new.exists() and Path(model).exists() and new.samefile(model):
            raise UsageError(f"--out {folder} would overwrite {model}; give another folder")
    return path


@contextmanager
def _progress(quiet: bool) -> Iterator[Callable[[str], None]]:
    if quiet:
        yield lambda text: None
        return
    with console.status("starting") as status:
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
    """Write URDF, page and figures beside the model; print the summary."""
    more: dict[str, Any] = {}
    for stale in ("report.html", "model.urdf"):  # of an earlier model
        (folder / stale).unlink(missing_ok=True)
    if result.model_out is not None:
        more["urdf_out"] = _write_urdf(load_model(result.model_out), folder / "model.urdf")
    if not args.no_report:
        more["report"] = str(write_gap_page(result, folder / "report.html"))
    _write(args, folder, result, more)
    for line in console_summary(result):
        output.print(Text.from_markup(line), soft_wrap=True)
    if "report" in more:
        show(f"report {more['report']}")


def _write_urdf(model: SelfModel, path: Path) -> str | None:
    """The new model as URDF; None where a body of it cannot exist."""
    try:
        write_robot(path, robot_urdf(model))
    except ModelError as error:
        warn([f"no URDF: {error}"])
        return None
    return str(path)


def _write(args: argparse.Namespace, folder: Path, result: GapResult, more: dict[str, Any]) -> None:
    figures = {**as_json(result), **more}
    write_json(folder / "gap.json", figures)
    write_json(args.json, figures)
