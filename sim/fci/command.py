"""The simulated robot from a shell: options, one line when it is ready, a summary at the end."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from sim.fci.faults import describe
from sim.fci.layout import VERSIONS
from sim.fci.server import HOST, PORT, FciServer
from sim.scenarios import options_of

EXIT_OK, EXIT_USAGE = 0, 2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = "faults, NAME[=VALUE][@SECONDS]:\n" + describe()
    add = parser.add_argument
    add("--port", type=int, default=PORT, help=f"TCP port on {HOST}; clients know only {PORT}")
    add("--protocol", type=int, choices=VERSIONS, default=5, help="5 Panda (FER), 10 FR3")
    add("--scenario", default="nominal", help="which arm; an unknown name lists them")
    add("--set", action="append", default=[], metavar="KEY=VALUE", help="option of the scenario")
    add("--seed", type=int, default=0, help="of noise, truth and faults")
    add("--fault", action="append", default=[], metavar="FAULT", help="see below; repeatable")
    add("--core", type=int, default=None, help="processor to stay on")
    add("--duration", type=float, default=None, metavar="S", help="stop after so many seconds")
    add("--json", type=Path, default=None, metavar="FILE", help="write the summary there as well")


def run(args: argparse.Namespace) -> int:
    """Serve until SIGTERM, SIGINT or the end of the duration; the process's exit code."""
    try:
        server = FciServer(
            args.port,
            args.protocol,
            args.scenario,
            args.seed,
            args.fault,
            options_of(args.set),
            args.core,
        )
    except (ValueError, OSError) as error:
        print(f"error: {_sentence(error, args.port)}", file=sys.stderr)
        return EXIT_USAGE
    try:
        run_server(server, args.duration)
    finally:
        server.close()
    summary = server.summary()
    for key, value in summary.items():
        print(f"{key}: {value}")
    if args.json is not None:
        args.json.write_text(json.dumps(summary, indent=1) + "\n", "utf-8")
    return EXIT_OK


def run_server(server: FciServer, duration_s: float | None = None) -> None:
    """Say that it is ready and serve; to be called in the main thread."""
    stop = _stopper(duration_s)
    print(f"listening on {HOST}:{server.port} protocol {server.protocol}", flush=True)
    server.serve(stop)


def _stopper(duration_s: float | None) -> Callable[[], bool]:
    """True after a signal or when the time is over."""
    asked: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda got, frame: asked.append(got))
    end = None if duration_s is None else time.monotonic() + duration_s
    return lambda: bool(asked) or (end is not None and time.monotonic() > end)


def _sentence(error: Exception, port: int) -> str:
    if isinstance(error, OSError):
        return f"port {port} of {HOST} cannot be used ({error.strerror}); stop what uses it"
    return str(error)
