"""`adapter discover`: which joint moves which link, and who is whose parent."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from rich.table import Column
from rich.text import Text
from rich.tree import Tree as Shown

from adapter import discovery
from adapter.errors import ModelError
from adapter.model.model_file import save_model
from adapter.runs.compiling import announce_compiling
from adapter.runs.terminal import labelled, output, print_table, say, show, warn, write_json
from drivers.files.mcap import read_log


def run(args: argparse.Namespace) -> int:
    """Carry the subcommand out."""
    announce_compiling(say)
    part = args.from_s, args.from_s + args.seconds
    log = read_log(args.log, topic=args.topic, beside="sensors", within_s=part)
    warn(log.warnings)
    found = discovery.discover(log, args.cutoff or discovery.CUTOFF_HZ, args.base)
    warn(list(found.notes))
    _print_tree(found)
    for sentence in found.undecided:
        labelled("undecided:", "yellow", sentence)
    figures = found.as_dict()
    try:
        learned = discovery.learn(found)
    except ModelError as error:
        if args.model is not None:
            raise
        warn([f"λ is not learned: {error}"])
    else:
        tree, schema = learned.data.tree, learned.schema
        known = np.where(schema.observable, schema.std, np.nan)
        figures["lambda"] = {
            "joint_names": list(tree.joint_names),
            "link_names": list(tree.link_names),
            "lam": schema.lam,
            "std": known,
            "shown": list(schema.ranks),
            "arbitrary": schema.freedom.words(tree),
        }
        _print_lambda(learned, known)
        rows = []  # where sensors that do not turn about their z sit in their joints' frames
        for name, mounting in found.mountings.items():
            numbers = (mounting.axis, mounting.as_dict()["position"])
            rows.append((name, *(" ".join(f"{x:6.3f}" for x in row) for row in numbers)))
        if rows:
            heads = "sensor of", "axis in its frame", "x y z in the joint's frame, m"
            print_table([Column(x, no_wrap=True) for x in heads], rows)
        if args.model is not None:
            figures.update(_write_model(args, found, learned))
    write_json(args.json, figures)
    return 0


def _print_tree(found: discovery.Discovery) -> None:
    log = found.log
    show(
        f"{len(log.joint_names)} joints, {len(log.link_names)} links; "
        f"{log.duration_s:.1f} s of {', '.join(log.measured)} at {log.rate_hz:.0f} Hz"
    )
    carried = {edge.link for edge in found.edges}
    parents = [edge.parent for edge in found.edges if edge.parent is not None]
    roots = [name for name in log.link_names if name not in carried]
    roots += [name for name in parents if name not in log.link_names]
    for root in dict.fromkeys(roots):
        top = Shown(Text(root, "bold"))
        _hang(top, root, found.edges)
        output.print(top)


def _hang(on: Shown, parent: str, edges: tuple[discovery.Edge, ...]) -> None:
    for edge in edges:
        if edge.parent == parent:
            sure = edge.confidence if edge.directed else edge.connected
            style = "green" if sure >= discovery.DECIDED else "yellow"
            by = edge.joint if edge.joint is not None else "(no joint)"
            way = "" if edge.directed else " this way or the other"
            label = Text.assemble(f"{edge.link}  ", ("by", "dim"), f" {by}  ")
            # never rounded up to certainty
            said = f"{min(sure, 0.9999):.4f}" if sure >= discovery.DECIDED else f"{sure:.2f}"
            label.append(said, style).append(way, "dim")
            _hang(on.add(label), edge.link, edges)


def _print_lambda(learned: discovery.LearnedTree, known: np.ndarray) -> None:
    """`known`: (n, 6) standard deviations, NaN where a single turn or shift is not shown."""
    tree, schema = learned.data.tree, learned.schema
    rows = []
    for j, name in enumerate(tree.joint_names):
        turn, place = (" ".join(f"{x:6.3f}" for x in part) for part in np.split(schema.lam[j], 2))
        most = (np.fmax.reduce(part) for part in np.split(known[j], 2))
        spread = " ".join(f"{x:.1g}" if np.isfinite(x) else "-" for x in most)
        rows.append((name, turn, place, f"{schema.ranks[j]}/6", spread))
    heads = ("joint", "α β γ rad", "p m", "shown", "± rad, m")
    print_table([Column(x, no_wrap=True) for x in heads], rows)
    for sentence in schema.freedom.words(tree):
        show(f"arbitrary, as no motion shows it: {sentence}")


def _write_model(
    args: argparse.Namespace, found: discovery.Discovery, learned: discovery.LearnedTree
) -> dict[str, Any]:
    model, left = discovery.self_model(found, learned, args.log.stem)
    save_model(model, args.model)
    lacking = "no torques" if found.log.tau is None else "no torques above 0"
    what = f"λ alone ({lacking if 'a' in found.bodies.motion else 'no accelerations'})"
    if left is not None:
        what = f"λ and θ; torque left unexplained {left.max():.2g} N m rms at the worst joint"
    show(f"{args.model}: {what}")
    arbitrary = model.provenance["discovered"]["theta_arbitrary"]
    if left is not None and arbitrary:
        said = "is arbitrary where no torque shows it; the model file lists what"
        show(f"θ of {len(arbitrary)} links {said}")
    return {"model": str(args.model), "torque_rmse_nm": left, "theta_arbitrary": arbitrary}
