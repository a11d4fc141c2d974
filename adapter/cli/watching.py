"""Who may watch a run: the page, and Foxglove's protocol."""

from __future__ import annotations

import argparse
import secrets
import socket
from functools import partial

from adapter.cli.run_options import ANY
from adapter.model.self_model import SelfModel
from adapter.realtime.showing import DisplayJob
from adapter.runs.terminal import say
from adapter.view.foxglove_view import free_port, need_foxglove
from adapter.view.now import KnownRun
from adapter.view.page import PERIOD_S, make_view
from adapter.view.server import HOST, address, bind


def known_run(
    args: argparse.Namespace, robot: SelfModel, effects: tuple[str, ...], duration_s: float
) -> KnownRun:
    """What is known of a run before it begins."""
    return KnownRun(robot, effects, args.driver, duration_s, secrets.token_hex(8))


def view_job(args: argparse.Namespace, known: KnownRun) -> DisplayJob | None:
    """The view process of a run, and a line for each address; None where nobody asked.

    Raises:
        UsageError: a port is taken. MeansError: Foxglove's library is missing.
    """
    listening: socket.socket | None = None
    port: int | None = None
    if args.foxglove is not None:
        need_foxglove()
        port = free_port(args.foxglove)
        say(f"Foxglove, PlotJuggler: ws://{HOST}:{port}")
    if args.view is not None:
        listening = bind(None if args.view == ANY else args.view)
        say(f"watch it: {address(listening)}")
    if listening is None and port is None:
        return None
    make = partial(make_view, known, listening, port)
    return DisplayJob(make, period_s=PERIOD_S, idle=True)
