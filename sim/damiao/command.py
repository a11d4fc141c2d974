"""`adapter sim can`: joint boards in a process of their own until SIGTERM or Ctrl-C."""

from __future__ import annotations

import argparse
import json
from contextlib import ExitStack
from typing import Any

from sim.damiao.bus import address_of, check_alone, open_bus
from sim.damiao.options import check
from sim.damiao.server import BoardOptions, Boards
from sim.ending import Ending
from sim.options import options_of
from sim.scenarios import build


def run(args: argparse.Namespace) -> int:
    """Serve until a signal comes or the time is over. Raises ValueError for wrong options."""
    check(args)
    options = options_of(args.set)
    scenario = build(args.scenario, args.seed, **options)
    noise = scenario.noise if options.keys() & {"noise", "levels"} else None
    fd = bool(args.fd)
    with Ending(args.duration) as ending, ExitStack() as stack:
        bus = open_bus(args.interface, args.channel, args.port, fd)
        stack.callback(bus.shutdown)
        boards = Boards(bus, scenario, BoardOptions(args.motors, noise), args.fault)
        stack.callback(boards.close)
        check_alone(bus, boards.motors[0].motor_id, boards.motors[0].reply_id, fd)
        address = address_of(args.interface, args.channel, args.port, fd)
        print(f"ready: a simulated arm on {address}", flush=True)
        boards.serve(ending)
        report = boards.report()
    print(summary(report), flush=True)
    if args.json is not None:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        args.json.write_text(json.dumps({"address": address, **report}, indent=1) + "\n", "utf-8")
    return 0


def summary(report: dict[str, Any]) -> str:
    """What happened, in a few lines."""
    frames, faults = report["frames"], report["faults"]
    lines = [
        f"simulated {report['ticks'] / 1000:.1f} s, slipped {report['slipped_ms']:.0f} ms",
        f"frames: {_counts(frames)}; replies {report['replies']}",
        f"status of motors 1 to 7: {' '.join(f'{status:X}' for status in report['status'])}; "
        f"fastest joint {report['fastest_rad_s']:.2f} rad/s; limp {report['limp_ticks']} ms, "
        f"on an end stop {report['stop_ticks']} ms",
    ]
    if faults:
        lines.append(f"faults struck: {_counts(faults)}")
    return "\n".join(lines)


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{key} {count}" for key, count in counts.items()) or "none"
