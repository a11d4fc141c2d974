"""A small arm that speaks the wire of `docs/examples/udp/example_arm.py`, in a process of its own.

    python tests/udp_arm.py --port 5800 --joints 6

Each joint is a driven flywheel with a damper: I ddq = tau - d dq. It prints its port, then runs
until it is killed. It has its own encoder: nothing here is imported from the driver.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import random
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator

INERTIA, DAMPING = 0.5, 2.0  # kg m², N m s/rad
WATCH_S = 0.02  # without a command for so long the brakes close
PERIOD_S = 1e-3


class Flywheels:
    """The arm: n joints, torques in, state out."""

    def __init__(self, n: int) -> None:
        self.q, self.dq, self.tau = [0.1 * j for j in range(n)], [0.0] * n, [0.0] * n
        self.commanded_s = -math.inf

    def tick(self, now_s: float) -> None:
        """Move on by one period."""
        braked = now_s - self.commanded_s > WATCH_S
        for j, tau in enumerate(self.tau):
            if braked:
                self.tau[j] = self.dq[j] = 0.0
            self.dq[j] += PERIOD_S * (tau * (not braked) - DAMPING * self.dq[j]) / INERTIA
            self.q[j] += PERIOD_S * self.dq[j]

    def hear(self, data: bytes, now_s: float) -> None:
        """A command, or the wish to brake."""
        n = len(self.q)
        if len(data) == 8 + 8 * n:
            _, *self.tau = struct.unpack(f"<Q{n}d", data)
            self.commanded_s = now_s
        elif len(data) == 8:
            self.commanded_s = -math.inf

    def state(self, counter: int) -> bytes:
        """The datagram of a tick."""
        noise = [random.gauss(0.0, 1e-5) for _ in self.q]
        q = [a + b for a, b in zip(self.q, noise, strict=True)]
        stamp_ns = counter * round(1e9 * PERIOD_S)
        return struct.pack(f"<QQ{3 * len(q)}d", counter, stamp_ns, *q, *self.dq, *self.tau)


def serve(port: int, joints: int, bad: float) -> None:
    """Speak until killed; a share `bad` of the datagrams is lost, and as many twice or cut."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", port))
    sock.setblocking(False)
    print(sock.getsockname()[1], flush=True)
    arm, peer, counter, begin_s = Flywheels(joints), None, 0, time.monotonic()
    random.seed(7)
    while True:
        counter += 1
        time.sleep(max(0.0, begin_s + counter * PERIOD_S - time.monotonic()))
        now_s = counter * PERIOD_S
        with contextlib.suppress(OSError):
            while True:
                data, peer = sock.recvfrom(4096)
                arm.hear(data, now_s)
        arm.tick(now_s)
        if peer is None or random.random() < bad:
            continue
        data = arm.state(counter)
        with contextlib.suppress(OSError):
            sock.sendto(data, peer)
            if random.random() < bad:
                sock.sendto(data, peer)
            if random.random() < bad:
                sock.sendto(data[:-3], peer)


@contextlib.contextmanager
def running(joints: int = 6, bad: float = 0.0) -> Iterator[int]:
    """The arm in a process of its own; gives its port."""
    command = [sys.executable, __file__, "--port", "0", "--joints", str(joints), "--bad", str(bad)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield int(process.stdout.readline())
        finally:
            process.kill()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--port", type=int, default=5800)
    parser.add_argument("--joints", type=int, default=6)
    parser.add_argument("--bad", type=float, default=0.0, help="share of datagrams gone wrong")
    given = parser.parse_args()
    serve(given.port, given.joints, given.bad)
