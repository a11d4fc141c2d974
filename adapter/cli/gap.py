"""`adapter gap`: where model and data disagree, which effect is missing, the gap with it."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.markup import escape

from adapter.cli.common import UsageError, console, warn, write_json
from adapter.cli.results import results_folder
from adapter.cli.rollouts import Rollouts
from adapter.errors import ModelError
from adapter.export import to_urdf
from adapter.export_effects import UrdfParts
from adapter.gap.refusals import Refusal
from adapter.gap.result import GapResult, Shortfall
from adapter.gap.summary import console_summary
from adapter.gap.workflow import GapSettings, analyse
from adapter.model import SelfModel
from adapter.report.gap_page import write_gap_page
from adapter.robots import documented

EXIT_REFUSED = 2


def add_parser(commands: Any) -> None:
    """Declare the subcommand."""
    parser = commands.add_parser(
        "gap",
        help="find what a model lacks",
        description="Find where a model and recordings disagree, name the effects that the model "
        "lacks, add them, and measure the gap again on data that the fit never saw. Of several "
        "recordings the last one is held out; of one, blocks of it. Exit codes: 0 analysed, also "
        "where too little moves to tell anything; 2 wrong use, or a recording that does not fit "
        "the model (another robot, flipped signs, other units).",
    )
    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG", help="MCAP recording")
    parser.add_argument(
        "--model",
        required=True,
        metavar="MODEL",
        help="self model (.json), .urdf, or a robot known by name: panda",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write findings and figures")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="where results go")
    parser.add_argument(
        "--inertia-prior",
        type=float,
        default=GapSettings.inertia_prior,
        metavar="SHARE",
        help="standard deviation of the model's inertial numbers, of their size (default 0.02)",
    )
    parser.add_argument(
        "--validate-from", type=float, metavar="S", help="fit before this second, score after it"
    )
    parser.add_argument("--no-report", action="store_true", help="do not write the HTML page")
    parser.add_argument("--no-simulation", action="store_true", help="compare torques only")
    parser.add_argument("--quiet", action="store_true", help="no progress")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Carry the subcommand out."""
    if args.validate_from is not None and len(args.logs) > 1:
        raise UsageError("--validate-from splits one LOG; of several the last one is held out")
    settings = GapSettings(args.inertia_prior, args.validate_from)
    nominal = documented(args.model)
    folder = results_folder(args, "gap")
    model_out = _new_model(folder, args.model)
    rollouts = None if args.no_simulation else Rollouts()
    try:
        with _progress(args.quiet) as tell:
            result = analyse(args.logs, nominal, settings, rollouts, model_out, tell)
    except Refusal as refusal:
        names, logs = nominal.tree.joint_names, [log.name for log in args.logs]
        nothing = GapResult.untold(names, nominal.name, logs, args.model, str(refusal))
        _write(args, folder, nothing, {"refused": refusal.kind})
        console.print(f"[red]error:[/] {escape(str(refusal))}", soft_wrap=True)
        return EXIT_REFUSED
    result = replace(result, model_in=args.model)
    if rollouts is not None:
        notes = (*result.notes, *rollouts.troubles)
        result = replace(_without_empty_rollouts(result), notes=notes)
    _conclude(args, folder, result)
    return 0


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
        yield status.update


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
    if result.model_out is not None:
        more["urdf_out"] = _write_urdf(SelfModel.load(result.model_out), folder / "model.urdf")
    if not args.no_report:
        more["report"] = str(write_gap_page(result, folder / "report.html"))
    _write(args, folder, result, more)
    for line in console_summary(result):
        console.print(line, soft_wrap=True)
    if "report" in more:
        console.print(f"report {more['report']}", soft_wrap=True)


def _write_urdf(model: SelfModel, path: Path) -> str | None:
    """The new model as URDF; None where a body of it cannot exist."""
    try:
        path.write_text(to_urdf(model))
    except ModelError as error:
        warn([f"no URDF: {error}"])
        return None
    left_out = UrdfParts.of(model).names
    if left_out:
        warn([f"{path}: a URDF has no full place for {', '.join(left_out)}; the model file has"])
    return str(path)


def _write(args: argparse.Namespace, folder: Path, result: GapResult, more: dict[str, Any]) -> None:
    figures = {**result.as_dict(), **more}
    write_json(folder / "gap.json", figures)
    write_json(args.json, figures)
