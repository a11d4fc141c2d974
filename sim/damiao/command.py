"""`adapter sim can`: joint boards in a process of their own until SIGTERM or Ctrl-C."""

from __future__ import annotations

import argparse
import json
import signal
import threading
import time
from pathlib import Path
from typing import Any

from sim.damiao.boards import Boards
from sim.damiao.faults import MOTORS, SECONDS, SHARES
from sim.damiao.motor_types import SETS
from sim.damiao.open_bus import (
    INTERFACES,
    MULTICAST_GROUP,
    MULTICAST_PORT,
    address_of,
    check_alone,
    open_bus,
)
from sim.scenarios import SCENARIOS, build, options_of


class Ending:
    """Ends at a signal or when the time is over."""

    def __init__(self, duration_s: float | None) -> None:
        self._event = threading.Event()
        self._end = None if duration_s is None else time.monotonic() + duration_s

    def on_signal(self, number: int, frame: object) -> None:
        """Handler of SIGTERM and SIGINT."""
        self._event.set()

    def is_set(self) -> bool:
        """Whether to end."""
        return self._event.is_set() or (self._end is not None and time.monotonic() >= self._end)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--interface", choices=INTERFACES, default=INTERFACES[0], help=f"default {INTERFACES[0]}"
    )
    parser.add_argument(
        "--channel",
        default=MULTICAST_GROUP,
        metavar="WHERE",
        help=f"multicast group (default {MULTICAST_GROUP}) or CAN interface, as in vcan0",
    )
    parser.add_argument(
        "--port",
        type=int,
        default=MULTICAST_PORT,
        help=f"of the multicast group, default {MULTICAST_PORT}",
    )
    parser.add_argument("--fd", type=int, choices=(0, 1), default=1, help="CAN FD, default 1")
    parser.add_argument("--motors", choices=tuple(SETS), default="panda", help="default panda")
    parser.add_argument(
        "--scenario", default="nominal", metavar="NAME", help=f"{', '.join(SCENARIOS)}"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="option of the scenario; noise=real adds a Panda's sensor noise to the quantisation",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the arm, noise and faults")
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="NAME[=VALUE][@SECONDS]",
        help="seconds count from the first frame. VALUE is a share of frames: "
        f"{', '.join(key for key in SHARES if key != 'enobufs')}; the number of a motor: "
        f"{', '.join(MOTORS)}; or seconds: {', '.join(SECONDS)}",
    )
    parser.add_argument("--duration", type=float, metavar="S", help="end after so many seconds")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")


def run(args: argparse.Namespace) -> int:
    """Serve until a signal comes or the time is over. Raises ValueError for wrong options."""
    if any(text.startswith("enobufs") for text in args.fault):
        raise ValueError("fault 'enobufs' strikes a host's own controller, not the boards")
    options = options_of(args.set)
    scenario = build(args.scenario, args.seed, **options)
    noise = scenario.noise if options.keys() & {"noise", "levels"} else None
    fd = bool(args.fd)
    ending = Ending(args.duration)
    before = {kind: signal.signal(kind, ending.on_signal) for kind in _SIGNALS}
    try:
        bus = open_bus(args.interface, args.channel, args.port, fd)
        try:
            boards = Boards(bus, scenario, args.seed, args.motors, args.fault, noise=noise)
            try:
                check_alone(bus, boards.motors[0].motor_id, boards.motors[0].reply_id, fd)
                address = address_of(args.interface, args.channel, args.port, fd)
                print(f"ready: a simulated arm on {address}", flush=True)
                boards.serve(ending)
                report = boards.report()
            finally:
                boards.close()
        finally:
            bus.shutdown()
    finally:
        for kind, handler in before.items():
            signal.signal(kind, handler)
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


_SIGNALS = (signal.SIGTERM, signal.SIGINT)


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{key} {count}" for key, count in counts.items()) or "none"
