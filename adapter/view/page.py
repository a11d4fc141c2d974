"""The live page, and the view process's side of it."""

from __future__ import annotations

import base64
import hashlib
import socket
from collections.abc import Callable

from markupsafe import Markup

from adapter.realtime.showing import View
from adapter.report.html import fill
from adapter.view.foxglove_view import FoxgloveView
from adapter.view.messages import Messages, encode
from adapter.view.now import KnownRun, Now, Onlooker
from adapter.view.server import ViewServer

PERIOD_S = 0.05  # between two frames
HISTORY_EVERY = 20  # frames; for pages that come
Show = Callable[[Now], None]


def page_of(known: KnownRun) -> tuple[str, str]:
    """HTML of the page and its Content-Security-Policy: nothing from elsewhere, no other script."""
    script = fill("live.js", {}, __package__)
    context = {"robot": known.documented.name, "script": Markup(script)}
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; "
        "connect-src 'self'; img-src data:; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'"
    )
    return fill("live.html", context, __package__), policy


class LivePage:
    """Serves the page and feeds it.

    Args:
        onlooker: of the run.
        listening: where it is served.
    """

    def __init__(self, onlooker: Onlooker, listening: socket.socket) -> None:
        self._messages = Messages(onlooker)
        self._server = ViewServer(listening, *page_of(onlooker.known))
        self._server.newest.put({"hello": encode(self._messages.hello())})
        self._server.start()
        self._frames = 0

    def __call__(self, now: Now) -> None:
        """Take what is to be seen now; waits for nobody."""
        due = {kind: encode(message) for kind, message in self._messages.take(now).items()}
        if now.view.done or self._frames % HISTORY_EVERY == 0:
            due["history"] = self._messages.history()
        self._frames += 1
        self._server.newest.put(due)
        if now.view.done:
            self._server.stop()


def make_view(
    known: KnownRun, listening: socket.socket | None, foxglove_port: int | None
) -> Callable[[View], None]:
    """What the view process shows: the page, Foxglove's protocol, or both."""
    onlooker, shows = Onlooker(known), list[Show]()
    if listening is not None:
        shows.append(LivePage(onlooker, listening))
    if foxglove_port is not None:
        shows.append(FoxgloveView(known, foxglove_port))

    def show(view: View) -> None:
        now = onlooker.look(view)
        for one in shows:
            one(now)

    return show
