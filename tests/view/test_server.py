"""The page's server: for this machine alone, read only, and nobody waits for who is slow."""

from __future__ import annotations

import http.client
import json
import socket
import time
from collections.abc import Iterator
from contextlib import suppress

import pytest

from adapter.errors import UsageError
from adapter.view import server as served
from adapter.view.server import ViewServer, address, bind
from tests.helpers.live_tools import wait_for

PAGE = "<!doctype html><title>a page</title>"


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[ViewServer]:
    monkeypatch.setattr(served, "HEAD_S", 0.5)
    monkeypatch.setattr(served, "GOODBYE_S", 0.3)
    found = ViewServer(bind(0), PAGE, "default-src 'none'")
    found.newest.put({"hello": b'{"key":"k"}', "history": b"{}", "frame": b'{"t":0}'})
    found.start()
    yield found
    found.stop()


def port_of(server: ViewServer) -> int:
    return int(server.socket.getsockname()[1])


def ask(
    server: ViewServer, path: str = "/", method: str = "GET", **headers: str
) -> tuple[int, bytes, dict[str, str]]:
    connection = http.client.HTTPConnection("127.0.0.1", port_of(server), timeout=10)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    found = answer.status, answer.read(), dict(answer.getheaders())
    connection.close()
    return found


class Listener:
    """A page that listens: events as they come."""

    def __init__(self, server: ViewServer, buffer: int | None = None) -> None:
        self.socket = socket.socket()
        if buffer is not None:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
        self.socket.settimeout(10.0)
        self.socket.connect(("127.0.0.1", port_of(server)))
        self.socket.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        self.file = self.socket.makefile("rb")

    def event(self) -> tuple[str, dict]:
        """The next one."""
        kind = ""
        for line in self.file:
            if line.startswith(b"event: "):
                kind = line[7:].strip().decode()
            elif line.startswith(b"data: "):
                return kind, json.loads(line[6:])
        raise EOFError

    def close(self) -> None:
        self.file.close()
        self.socket.close()


def test_the_page_and_its_rules(server: ViewServer) -> None:
    status, body, headers = ask(server)
    assert (status, body.decode()) == (200, PAGE)
    assert headers["Content-Security-Policy"] == "default-src 'none'"
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
    assert not any(name.lower().startswith("access-control") for name in headers)
    state = json.loads(ask(server, "/state")[1])
    assert state == {"hello": {"key": "k"}, "history": {}, "frame": {"t": 0}}
    assert ask(server, "/", "HEAD")[:2] == (200, b"")
    assert ask(server, "/../etc/passwd")[0] == 404
    assert server.socket.getsockname()[0] == "127.0.0.1"


@pytest.mark.parametrize("path", ["/", "/state", "/events"])
@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},  # a name that somebody lets point here
        {"Host": "127.0.0.1.evil.example:80"},
        {"Host": "localhost:80:80"},
        {"Host": "127.0.0.1", "Origin": "http://evil.example"},
        {"Host": "127.0.0.1:8400", "Origin": "http://127.0.0.1:1"},  # another page of this machine
        {"Host": "localhost", "Origin": "null"},
    ],
)
def test_pages_of_others_read_nothing(
    server: ViewServer, path: str, headers: dict[str, str]
) -> None:
    status, body, _ = ask(server, path, **headers)
    assert status == 403 and b"key" not in body and b"title" not in body


def test_those_of_this_machine_do(server: ViewServer) -> None:
    for host in ("127.0.0.1", "localhost", "localhost:9999"):  # the last one through a tunnel
        assert ask(server, "/state", Host=host)[0] == 200
        assert ask(server, "/state", Host=host, Origin=f"http://{host}")[0] == 200


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "PATCH"])
def test_nothing_can_be_written(server: ViewServer, method: str) -> None:
    assert ask(server, "/state", method)[0] == 405


def test_a_listener_gets_what_is_there_and_then_the_newest(server: ViewServer) -> None:
    listener = Listener(server)
    assert [listener.event()[0] for _ in range(3)] == ["hello", "history", "frame"]
    server.newest.put({"history": b"{}", "frame": b'{"t":1}'})
    assert listener.event() == ("frame", {"t": 1})  # what was before is said once
    listener.close()


def test_one_that_is_slow_loses_frames_and_holds_nobody_up(server: ViewServer) -> None:
    slow, quick = Listener(server, buffer=4096), Listener(server)
    filler = "x" * 20_000
    for _ in range(3):
        quick.event()
    longest_s, last = 0.0, 400
    for k in range(1, last + 1):
        began = time.monotonic()
        server.newest.put({"frame": json.dumps({"t": k, "filler": filler}).encode()})
        longest_s = max(longest_s, time.monotonic() - began)
        time.sleep(0.001)
    while quick.event()[1].get("t") != last:
        pass
    seen = []
    while not seen or seen[-1] != last:
        kind, data = slow.event()
        if kind == "frame":
            seen.append(data["t"])
    assert seen == sorted(seen) and len(seen) < last // 2  # 8 MB; its buffers hold far less
    assert longest_s < 1.0
    slow.close()
    quick.close()


def test_one_that_takes_nothing_is_let_go(
    server: ViewServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(served._Handler, "timeout", 0.5)
    dead = Listener(server, buffer=4096)
    assert wait_for(lambda: server.listeners == 1)
    for k in range(60):
        server.newest.put({"frame": json.dumps({"t": k, "filler": "x" * 100_000}).encode()})
        time.sleep(0.01)
    assert wait_for(lambda: server.listeners == 0)
    dead.close()


def test_so_many_listen_and_no_more(server: ViewServer) -> None:
    many = [Listener(server) for _ in range(served.LISTENERS)]
    assert wait_for(lambda: server.listeners == served.LISTENERS)
    assert ask(server, "/events", Host="localhost")[0] == 503
    assert ask(server, "/")[0] == 200
    many.pop().close()
    server.newest.put({"frame": b"{}"})
    assert wait_for(lambda: server.listeners == served.LISTENERS - 1)
    for listener in many:
        listener.close()


def test_connections_that_ask_for_nothing_are_ended(server: ViewServer) -> None:
    idle = [
        socket.create_connection(("127.0.0.1", port_of(server)), timeout=10)
        for _ in range(served.CONNECTIONS + 5)
    ]
    for connection in idle[:5]:
        connection.sendall(b"GET / HT")
    for connection in idle:
        assert connection.recv(100) == b""  # the first ones too late, the last ones too many
        connection.close()

    def answers() -> bool:
        with suppress(OSError):
            return ask(server)[0] == 200
        return False

    assert wait_for(answers)


def test_a_request_that_is_too_long_is_refused(server: ViewServer) -> None:
    assert ask(server, "/" + "x" * 70_000)[0] == 414
    assert ask(server, "/", **{f"X-{k}": "y" for k in range(150)})[0] == 431


def test_a_port_that_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    taken = bind(0)
    port = int(taken.getsockname()[1])
    with pytest.raises(UsageError, match=rf"port {port} .*--view PORT, or\s--view 0"):
        bind(port)
    monkeypatch.setattr(served, "DEFAULT_PORT", port)
    other = bind(None)
    assert address(other).startswith("http://127.0.0.1:") and str(port) not in address(other)
    taken.close()
    other.close()
