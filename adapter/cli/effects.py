"""`adapter effects`: what can be named, and laws of one's own beside it."""

from __future__ import annotations

import argparse
from pathlib import Path

from adapter.effects.catalogue import CATALOGUE
from adapter.effects.kept import keep, with_kept
from adapter.effects.law import EXPRESSIONS, LAW
from adapter.errors import UsageError
from adapter.runs.terminal import print_table, show


def run(args: argparse.Namespace) -> int:
    """Carry the subcommand out."""
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
