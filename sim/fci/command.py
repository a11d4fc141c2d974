"""The simulated robot from a shell: one line when it is ready, a summary at the end."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
from collections.abc import Callable

from sim.fci.codec import HOST
from sim.fci.server import FciServer
from sim.options import options_of
from sim.scenarios import build

EXIT_OK, EXIT_USAGE = 0, 2


def run(args: argparse.Namespace) -> int:
    """Serve until SIGTERM, SIGINT or the end of the duration; the process's exit code."""
    try:
        scenario = build(args.scenario, args.seed, **options_of(args.set))
        server = FciServer(scenario, args.port, args.protocol, args.fault, args.core)
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
