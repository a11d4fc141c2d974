"""`adapter sim ros2`: an arm behind ros2_control until SIGTERM or Ctrl-C."""

from __future__ import annotations

import argparse
import json

from sim.ending import Ending
from sim.faults import read_fault
from sim.options import options_of
from sim.ros2.arm import Place, ServedArm
from sim.ros2.options import KINDS, check
from sim.scenarios import build


def run(args: argparse.Namespace) -> int:
    """Serve until a signal comes or the time is over. Raises ValueError for wrong options."""
    check(args)
    scenario = build(args.scenario, args.seed, **options_of(args.set))
    place = Place(
        args.domain, args.states, args.commands, args.every, args.watch, not args.no_description
    )
    arm = ServedArm(scenario, place, [read_fault(text, KINDS) for text in args.fault])
    try:
        with Ending(args.duration) as ending:
            hz = "" if args.every == 1 else f"&hz={1000 // args.every}"
            address = f"ros2://{args.states}?command={args.commands}&domain={args.domain}&local=1"
            print(f"ready: a simulated arm on {address}{hz}", flush=True)
            arm.serve(ending.is_set)
    finally:
        arm.close()
    summary = arm.summary()
    for key, value in summary.items():
        print(f"{key}: {value}")
    if args.json is not None:
        args.json.write_text(json.dumps(summary, indent=1) + "\n", "utf-8")
    return 0
