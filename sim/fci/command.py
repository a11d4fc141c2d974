"""The simulated robot from a shell: one line when it is ready, a summary at the end."""

from __future__ import annotations

import argparse
import json
import sys

from sim.ending import Ending
from sim.fci.codec import HOST, PORT
from sim.fci.gripper import PORT as GRIPPER_PORT
from sim.fci.gripper import GripperServer
from sim.fci.options import chosen
from sim.fci.server import FciServer
from sim.scenarios import build

EXIT_OK, EXIT_USAGE = 0, 2


def run(args: argparse.Namespace) -> int:
    """Serve until SIGTERM, SIGINT or the end of the duration; the process's exit code."""
    try:
        scenario = build(args.scenario, args.seed, **chosen(args))
        hand = _hand(args)
        try:
            server = FciServer(
                scenario, args.port, args.protocol, args.fault, args.core, args.patience
            )
            server.hand = hand
        except OSError as error:
            raise ValueError(_taken(args.port, error)) from error
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_USAGE
    try:
        with Ending(args.duration) as ending:
            address = f"fci://{HOST}" + (f":{server.port}" if server.port != PORT else "")
            protocol = f"(protocol {server.protocol})"
            print(f"ready: a simulated arm on {address} {protocol}", flush=True)
            if hand is not None:
                print(f"the gripper on {HOST}:{hand.port}", flush=True)
            server.serve(ending.is_set)
    finally:
        server.close()
    summary = server.summary()
    for key, value in summary.items():
        print(f"{key}: {value}")
    if args.json is not None:
        args.json.write_text(json.dumps(summary, indent=1) + "\n", "utf-8")
    return EXIT_OK


def _hand(args: argparse.Namespace) -> GripperServer | None:
    """The gripper: on its port where the robot is on its own, or where one is named."""
    port = args.gripper_port
    if port is None:
        if args.port != PORT:
            return None
        port = GRIPPER_PORT
    try:
        return GripperServer(port, args.object)
    except OSError as error:
        raise ValueError(_taken(port, error)) from error


def _taken(port: int, error: OSError) -> str:
    return f"port {port} of {HOST} cannot be used ({error.strerror}); stop what uses it"
