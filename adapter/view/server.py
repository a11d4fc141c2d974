"""One page over HTTP on this machine alone, and a stream of events for it.

A page asks once for `/events` (server-sent events, WHATWG HTML, 9.2) and comes back by itself
where the connection breaks. Each listener has a thread that sends the newest message of each
kind: one that is slow gets fewer of them, and nobody waits for it. Nothing can be written: the
stream goes one way, and every other method than GET and HEAD is refused.

A page of another site must not read along. It cannot by its own name, since the answers name no
other origin, and not by a name that it lets point here (DNS rebinding), since `Host` must be this
machine's; `Origin`, where there is one, must be the same.
"""

from __future__ import annotations

import os
import socket
import threading
import time
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from adapter.errors import UsageError

HOST = "127.0.0.1"
NAMES = ("127.0.0.1", "localhost")  # that a browser on this machine may call it by
DEFAULT_PORT = 8400
LISTENERS, CONNECTIONS = 8, 32  # at most: pages, and all that are open at a time
HEAD_S, SEND_S = 5.0, 5.0  # a request has to be whole, and a listener to take something, in this
GOODBYE_S = 1.5
STREAM = ("hello", "history", "news", "estimate", "timing", "frame")  # in this order
HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "X-Frame-Options": "DENY",
}


def bind(port: int | None) -> socket.socket:
    """A socket that listens on this machine; any free port where 0.

    Args:
        port: None for the usual one, or any other where that is taken.

    Raises:
        UsageError: the port is taken, or may not be used.
    """
    wanted = (DEFAULT_PORT, 0) if port is None else (port,)
    for candidate in wanted:
        try:
            return socket.create_server((HOST, candidate), backlog=16)
        except OSError as error:
            if candidate == wanted[-1]:
                reason = os.strerror(error.errno) if error.errno else error
                raise UsageError(
                    f"no page on port {candidate} ({reason}); choose another: --view PORT, or "
                    "--view 0 for any that is free"
                ) from None
    raise AssertionError("unreachable")


def address(listening: socket.socket) -> str:
    """Where a browser finds it."""
    return f"http://{HOST}:{listening.getsockname()[1]}/"


class Newest:
    """The newest message of each kind, for any number of threads; encoded once."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._parts: dict[str, tuple[int, bytes]] = {}
        self._version, self.closed = 0, False

    def put(self, parts: dict[str, bytes]) -> None:
        """Newer ones; never waits for anybody."""
        with self._changed:
            for kind, data in parts.items():
                self._version += 1
                self._parts[kind] = self._version, data
            self._changed.notify_all()

    def close(self) -> None:
        """Nothing comes any more."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def after(self, seen: dict[str, int], wait_s: float) -> dict[str, bytes]:
        """What is newer than seen, which is brought up to date; {} where nothing came in time."""
        with self._changed:
            if not self._newer(seen) and not self.closed:
                self._changed.wait(wait_s)
            found = self._newer(seen)
            for kind in found:
                seen[kind] = self._parts[kind][0]
            return {kind: self._parts[kind][1] for kind in STREAM if kind in found}

    def all(self) -> dict[str, bytes]:
        """Of every kind."""
        with self._changed:
            return {kind: self._parts[kind][1] for kind in STREAM if kind in self._parts}

    def _newer(self, seen: dict[str, int]) -> list[str]:
        return [kind for kind, (at, _) in self._parts.items() if at > seen.get(kind, 0)]


class ViewServer(ThreadingHTTPServer):
    """Serves the page and the stream from a socket that listens already.

    Args:
        listening: see `bind`.
        page: HTML.
        policy: its Content-Security-Policy.

    Attributes:
        newest: what is sent to listeners; "history" only to those that come.
        listeners: how many listen now.
    """

    daemon_threads, block_on_close = True, False

    def __init__(self, listening: socket.socket, page: str, policy: str) -> None:
        super().__init__(listening.getsockname(), _Handler, bind_and_activate=False)
        self.socket.close()
        self.socket = listening
        self.page, self.policy, self.newest = page.encode(), policy, Newest()
        self._places, self.listeners = threading.Semaphore(CONNECTIONS), 0
        self._lock = threading.Lock()
        self._heads: dict[Any, float] = {}  # connections whose request is not whole yet
        self._thread = threading.Thread(target=self.serve_forever, args=(0.2,), daemon=True)

    def start(self) -> None:
        """Serve from now on."""
        self._thread.start()

    def stop(self) -> None:
        """Let listeners have what is newest, then let go of them."""
        self.newest.close()
        latest = time.monotonic() + GOODBYE_S
        while self.listeners and time.monotonic() < latest:
            time.sleep(0.02)
        self.shutdown()
        self.server_close()

    def take_listener(self) -> bool:
        """A place for one more, if there is any."""
        with self._lock:
            if self.listeners >= LISTENERS:
                return False
            self.listeners += 1
            return True

    def drop_listener(self) -> None:
        """Its place is free again."""
        with self._lock:
            self.listeners -= 1

    def process_request(self, request: Any, client_address: Any) -> None:
        """As the base does, for as many as there are places."""
        if not self._places.acquire(blocking=False):
            self.shutdown_request(request)
            return
        with self._lock:
            self._heads[request] = time.monotonic() + HEAD_S
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """As the base does; the place is free afterwards."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.head_is_whole(request)
            self._places.release()

    def head_is_whole(self, request: Any) -> None:
        """It need not be watched any longer."""
        with self._lock:
            self._heads.pop(request, None)

    def service_actions(self) -> None:
        """Called a few times a second: end connections whose request does not come."""
        now = time.monotonic()
        with self._lock:
            late = [request for request, until in self._heads.items() if now > until]
        for request in late:
            with suppress(OSError):
                request.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that has gone is no news."""


class _Handler(BaseHTTPRequestHandler):
    """One request."""

    server: ViewServer
    timeout = SEND_S
    server_version, sys_version = "panda-adapter", ""

    def do_GET(self) -> None:
        self.server.head_is_whole(self.request)
        if not self._is_of_this_machine():
            self._answer(HTTPStatus.FORBIDDEN, b"this page is for this machine alone\n")
            return
        path = self.path.partition("?")[0]
        if path == "/":
            policy = {"Content-Security-Policy": self.server.policy}
            self._answer(HTTPStatus.OK, self.server.page, "text/html; charset=utf-8", policy)
        elif path == "/state":
            parts = [b'"%s":%s' % (k.encode(), v) for k, v in self.server.newest.all().items()]
            data = b"{" + b",".join(parts) + b"}\n"
            self._answer(HTTPStatus.OK, data, "application/json; charset=utf-8")
        elif path == "/events" and self.command == "GET":
            self._listen()
        else:
            self._answer(HTTPStatus.NOT_FOUND, b"there are /, /events and /state\n")

    do_HEAD = do_GET

    def _refuse(self) -> None:
        self.server.head_is_whole(self.request)
        self._answer(
            HTTPStatus.METHOD_NOT_ALLOWED, b"only GET and HEAD\n", more={"Allow": "GET, HEAD"}
        )

    do_POST = do_PUT = do_DELETE = do_OPTIONS = do_PATCH = do_TRACE = do_CONNECT = _refuse

    def _is_of_this_machine(self) -> bool:
        hosts, origins = self.headers.get_all("Host", []), self.headers.get_all("Origin", [])
        if len(hosts) != 1 or len(origins) > 1:
            return False
        name, _, port = hosts[0].partition(":")
        if name not in NAMES or (port and not port.isdecimal()):
            return False
        return not origins or origins[0] == f"http://{hosts[0]}"

    def _answer(
        self,
        status: HTTPStatus,
        data: bytes,
        kind: str = "text/plain; charset=utf-8",
        more: dict[str, str] | None = None,
    ) -> None:
        self.send_response(status)
        for name, value in {**HEADERS, **(more or {}), "Content-Type": kind}.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    def _listen(self) -> None:
        server = self.server
        if not server.take_listener():
            retry = {"Retry-After": "5"}
            self._answer(HTTPStatus.SERVICE_UNAVAILABLE, b"too many pages listen\n", more=retry)
            return
        try:
            # what waits for a slow listener is a second or two of frames
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 17)
            self.send_response(HTTPStatus.OK)
            for name, value in {**HEADERS, "Content-Type": "text/event-stream"}.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(b"retry: %d\n\n" % 1500)  # ms
            seen: dict[str, int] = {}
            last = False
            while not last:
                last = server.newest.closed
                parts = server.newest.after(seen, 2.0)
                events = [b"event: %s\ndata: %s\n\n" % (k.encode(), v) for k, v in parts.items()]
                self.wfile.write(b"".join(events) or b": still here\n\n")
                seen["history"] = 1 << 62  # once
        except OSError:  # gone, or too slow for too long
            pass
        finally:
            server.drop_listener()

    def log_message(self, format: str, *args: Any) -> None:
        """Nobody asked."""
