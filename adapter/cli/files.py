"""`adapter import`, `recover`, `info`, `effects`: work on files, and bring nothing heavy."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from importlib import import_module
from itertools import compress
from pathlib import Path

import numpy as np

from adapter.cli.common import robot_of
from adapter.cli.exit_codes import ExitCode
from adapter.effects.active import check_effects
from adapter.effects.base import with_squares
from adapter.effects.catalogue import CATALOGUE
from adapter.effects.kept import keep, with_kept
from adapter.effects.law import EXPRESSIONS, LAW
from adapter.effects.robots import read_robot
from adapter.errors import UsageError
from adapter.judgement.priors import is_shown
from adapter.model.model_file import load_model
from adapter.model.numbers import plus_minus
from adapter.model.self_model import SelfModel, theta_doubt
from adapter.runs.terminal import print_table, show, warn, write_json
from adapter.signals.importer import import_file, is_table, recording_log, table_log
from adapter.signals.recording import describe, summary
from adapter.signals.source_signals import ImportSpec
from drivers.files.mcap import Log, recover


def run_import(args: argparse.Namespace) -> int:
    """Carry `import` out."""
    joints = args.joints if args.robot is None else read_robot(args.robot).tree.joint_names
    spec = ImportSpec.from_options(
        args.sources,
        args.columns,
        args.units,
        args.names,
        joint_names=joints,
        flat=args.flat,
        period_s=args.period,
        overwrite=args.overwrite,
        episode=args.episode,
        topic=args.topic,
    )
    report = import_file(spec, args.to)
    warn(list(report.warnings))
    facts = asdict(report) | {"out": str(report.out)}
    write_json(args.json, facts)
    show(f"{args.to}: {facts['samples']} samples")
    return 0


def run_recover(args: argparse.Namespace) -> int:
    """Carry `recover` out."""
    found = recover(args.file, args.to)
    warn(list(found.warnings))
    facts = {
        "file": str(found.path),
        "mended": str(found.out),
        "was_whole": found.was_whole,
        "messages": dict(found.messages),
        "lost_bytes": found.lost_bytes,
    }
    write_json(args.json, facts)
    total = sum(found.messages.values())
    show(f"{found.out}: {total} messages, {found.lost_bytes} bytes could not be read")
    return 0


def run_info(args: argparse.Namespace) -> int:
    """Carry `info` out."""
    path = args.file
    if path.suffix in (".json", ".urdf", ".xml"):
        own = path.suffix == ".json"
        model = check_effects(load_model(path), path) if own else robot_of(args, str(path))
        lines = _model_lines(model)
        facts = {
            "name": model.name,
            "joints": list(model.tree.joint_names),
            "lambda_source": model.lambda_source,
            "gravity": model.gravity.tolist(),
            "effects": sorted({str(entry["effect"]) for entry in model.effects}),
            "provenance": dict(model.provenance),
        }
    else:
        log = opened(args)
        robot = None if args.robot is None else robot_of(args, args.robot)
        slides = () if robot is None else compress(robot.tree.joint_names, robot.tree.slides)
        facts = describe(args.file if log is None else log, args.topic, tuple(slides))
        lines = summary(facts)
        teaching = facts["problem"] is None and facts["tracking_error_rad"] is None
        if robot is not None and teaching:
            # What predicts brings torch, which the rest of this file can do without.
            predict = import_module("adapter.cli.teachable").predict
            facts["teachable"], more = predict(args, robot, log)
            lines += more
    write_json(args.json, facts)
    for line in lines:
        show(line)
    asked = args.topic is not None and facts.get("problem") is not None
    return ExitCode.WRONG_USE if asked else ExitCode.DONE


def run_effects(args: argparse.Namespace) -> int:
    """Carry `effects` out."""
    if args.keep:
        if args.keep[0] != "keep" or len(args.keep) != 2 or args.name is None:
            raise UsageError("as in: adapter effects keep results/gap --as hose_joint_3")
        show(keep(Path(args.keep[1]), args.name, args.joint, args.kept))
        show(f"kept in {args.kept}; looked for by adapter gap ... --effects {args.kept}")
        return 0
    rows = []
    with with_kept(args.kept if args.kept.exists() else None):
        for effect in CATALOGUE.values():
            numbers = ", ".join(f"{p.key} {p.written}".rstrip() for p in effect.parameters)
            own = f" ({effect.in_files.removeprefix(LAW)})" if effect.in_files else ""
            rows.append((effect.name, f"{effect.title}{own}", effect.scope, numbers))
    print_table(("name", "what", "of", "numbers"), rows)
    said = ", ".join(EXPRESSIONS)
    show(f"laws of what none of these is: c times {said} (ⱼ: another joint's)")
    return 0


def opened(args: argparse.Namespace) -> Log | None:
    """A table, or a recording in other units; None of a recording as it is. Raises DriverError."""
    path, more = args.file, {"period_s": args.period, "episode": args.episode}
    if is_table(path):
        return table_log(ImportSpec.from_options([str(path)], args.columns, args.units, **more))
    if not (args.units or args.columns or any(x is not None for x in more.values())):
        return None
    spec = ImportSpec.from_options([str(path)], args.columns, args.units, topic=args.topic, **more)
    return recording_log(spec)


def _model_lines(model: SelfModel) -> list[str]:
    """What a model file holds, a line each."""
    told, n = model.provenance, model.tree.n
    names = model.tree.joint_names
    lines = [
        f"model      {model.name}",
        f"joints     {n}: {', '.join(names)}",
        f"λ          {model.lambda_source}",
        *(f"           from the documentation: {text}" for text in told.get("lambda_filled", ())),
        f"θ          {told.get('theta_source', 'documented')}",
        *(f"           {text}" for text in filter(None, [theta_doubt(model)])),
        *(f"           from the documentation: {text}" for text in told.get("theta_filled", ())),
    ]
    masses, hint = [f"{m:.3g}" for m in model.theta[:, 0]], ""
    if model.theta_identifiable is not None:  # else nothing was learned, and all is told
        shown, std = model.theta_identifiable[:, 0], model.theta_std[:, 0]
        masses = [
            f"{m} ± {s:.1g}" if known else m for m, s, known in zip(masses, std, shown, strict=True)
        ]
        hint = "" if shown.all() else "; without ±: no motion shows this one alone"
    lines.append(f"mass       {', '.join(masses)} kg, link by link{hint}")
    lines += [f"effect     {text}" for text in _effect_lines(model)]
    labels = ("command", "made by"), ("source", "from"), ("program", "with")
    lines += [f"{label:10s} {told[key]}" for key, label in labels if told.get(key)]
    return lines


def _effect_lines(model: SelfModel) -> list[str]:
    """Each effect with its parameters, those of joints side by side."""
    found: dict[tuple[str, str, str], dict[int, str]] = {}
    for entry in model.effects:
        for key, value in entry["parameters"].items():
            if np.ndim(value) == 0:
                name, std = str(entry["effect"]), (entry.get("std") or {}).get(key)
                at = found.setdefault((name.replace("_", " "), key, str(entry["units"][key])), {})
                slides = any(model.tree.slides[j - 1] for j in entry["joints"])
                shown = is_shown(name, key, std, slides)
                said = plus_minus(float(value), std) if shown else "not shown"
                at |= dict.fromkeys(entry["joints"] or [0], said)
    lines = []
    for (name, key, unit), at in found.items():
        joints = [0] if 0 in at else range(1, model.tree.n + 1)
        values = ", ".join(at.get(j, "-") for j in joints)
        where = " at the flange" if 0 in at else ""
        lines.append(f"{name} {key}{where}: {values} {with_squares(unit)}".rstrip())
    return lines
