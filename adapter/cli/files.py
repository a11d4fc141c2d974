"""`adapter import`, `export`, `report`, `recover`, `info`: work on files."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from adapter.cli.common import add_json_option, console, warn, write_json
from adapter.export import to_urdf
from adapter.export_effects import UrdfParts
from adapter.import_spec import ImportSpec
from adapter.importer import import_table
from adapter.model import SelfModel
from adapter.recording import describe
from adapter.report import write_report
from adapter.robots import documented
from adapter.run_folder import load_run
from drivers.mcap_file import recover


def add_parsers(commands: Any) -> None:
    """Declare the subcommands."""
    _add_import(commands)
    export = commands.add_parser("export", help="write a model file as URDF")
    export.add_argument("model", type=Path, metavar="MODEL", help="model file (.json)")
    export.add_argument("--urdf", type=Path, required=True, metavar="FILE", help="to write")
    add_json_option(export)
    export.set_defaults(run=run_export)
    report = commands.add_parser("report", help="make the HTML page of a run again")
    report.add_argument("folder", type=Path, metavar="FOLDER", help="results of run or replay")
    report.add_argument("--html", type=Path, metavar="FILE", help="default: FOLDER/report.html")
    add_json_option(report)
    report.set_defaults(run=run_report)
    mend = commands.add_parser("recover", help="mend a recording that was cut")
    mend.add_argument("file", type=Path, metavar="FILE")
    mend.add_argument("--to", type=Path, metavar="FILE", help="default: NAME.recovered.mcap")
    add_json_option(mend)
    mend.set_defaults(run=run_recover)
    info = commands.add_parser("info", help="what is in a recording or a model file")
    info.add_argument("file", type=Path, metavar="FILE")
    add_json_option(info)
    info.set_defaults(run=run_info)


def _add_import(commands: Any) -> None:
    parser = commands.add_parser(
        "import",
        help="turn tables into a recording",
        description="Turn CSV, whitespace tables or .npz into an MCAP recording. Sources are one "
        "FILE, or SIGNAL=FILE for each of time, q, dq, tau.",
    )
    parser.add_argument("sources", nargs="+", metavar="[SIGNAL=]FILE")
    parser.add_argument("--to", type=Path, required=True, metavar="FILE", help="recording to write")
    parser.add_argument(
        "--columns", default="", metavar="MAP", help="as in time=0,q=1:8,dq=8:15,tau=tau_*"
    )
    parser.add_argument("--units", default="", metavar="MAP", help="as in q=deg,tau=mNm,time=ms")
    parser.add_argument(
        "--robot", metavar="NAME|FILE", help="take the joint names from this robot, in its order"
    )
    parser.add_argument("--joints", default="", metavar="LIST", help="joint names, commas between")
    parser.add_argument("--flat", action="store_true", help="one value per line")
    parser.add_argument("--period", type=float, metavar="S", help="where there is no time")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing recording")
    add_json_option(parser)
    parser.set_defaults(run=run_import)


def run_import(args: argparse.Namespace) -> int:
    """Carry `import` out."""
    joints = tuple(name for name in args.joints.split(",") if name)
    if args.robot is not None:
        joints = documented(args.robot).tree.joint_names
    spec = ImportSpec.from_options(
        args.sources,
        args.columns,
        args.units,
        joint_names=joints,
        flat=args.flat,
        period_s=args.period,
        overwrite=args.overwrite,
    )
    report = import_table(spec, args.to)
    warn(list(report.warnings))
    facts = report.as_dict()
    write_json(args.json, facts)
    console.print(f"{args.to}: {facts['samples']} samples")
    return 0


def run_export(args: argparse.Namespace) -> int:
    """Carry `export` out."""
    model = SelfModel.load(args.model)
    args.urdf.write_text(to_urdf(model))
    left_out = UrdfParts.of(model).names
    if left_out:
        listed = ", ".join(left_out)
        warn([f"a URDF has no full place for {listed}; a comment in it lists what is missing"])
    facts = {
        "model": str(args.model),
        "urdf": str(args.urdf),
        "lambda_source": model.lambda_source,
        "left_out": left_out,
    }
    write_json(args.json, facts)
    console.print(f"{args.urdf}: {model.name}, λ {model.lambda_source}")
    return 0


def run_report(args: argparse.Namespace) -> int:
    """Carry `report` out."""
    page = write_report(args.html or args.folder / "report.html", load_run(args.folder))
    write_json(args.json, {"report": str(page)})
    console.print(str(page))
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
    console.print(f"{found.out}: {total} messages, {found.lost_bytes} bytes could not be read")
    return 0


def run_info(args: argparse.Namespace) -> int:
    """Carry `info` out."""
    facts = _model_facts(args.file) if args.file.suffix == ".json" else describe(args.file)
    write_json(args.json, facts)
    for key, value in facts.items():
        console.print(f"{key}: {value}", soft_wrap=True)
    return 0


def _model_facts(path: Path) -> dict[str, Any]:
    model = SelfModel.load(path)
    return {
        "name": model.name,
        "joints": list(model.tree.joint_names),
        "lambda_source": model.lambda_source,
        "gravity": model.gravity.tolist(),
        "effects": sorted({str(entry["effect"]) for entry in model.effects}),
        "provenance": dict(model.provenance),
    }
