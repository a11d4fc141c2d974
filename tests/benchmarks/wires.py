"""What the hardware drivers cost and lose, against simulated arms: `make bench`.

`fci`: states at 1 kHz from `adapter sim fci`, a busy Python thread beside the loop; a sample's age,
processor time of `read` and of the reader process, and every id that did not come, the kernel's
drops and the milliseconds in which the machine stood still counted apart.
`virtual`, `udp`: seven joints both ways at 1 kHz; processor time of `read` and `command`.
"""

from __future__ import annotations

import json
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from soak import simulated

from adapter.realtime.real_time import Clock, RealTime, split_cores
from tests.helpers.benchmark import options, write

SHARES = (50, 99, 99.9, 100)
FRESH_NS = 1_000_000


def spread(values_ns: np.ndarray) -> dict[str, float]:
    """Percentiles of durations, µs."""
    return {f"p{p:g}": float(np.percentile(values_ns, p)) * 1e-3 for p in SHARES}


def process_time_ns(pid: int) -> int:
    """Processor time that a process has used."""
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[0])


@contextmanager
def busy_thread() -> Iterator[None]:
    """Another Python thread that never rests."""
    done = threading.Event()

    def spin() -> None:
        count = 0
        while not done.is_set():
            count += 1

    threading.Thread(target=spin, daemon=True).start()
    try:
        yield
    finally:
        done.set()


def fci(minutes: float) -> dict[str, Any]:
    """Only listening, as fast as the robot sends."""
    from drivers.fci import FciArm

    count = round(60e3 * minutes)
    ages, used = np.zeros(count, np.int64), np.zeros(count, np.int64)
    with tempfile.TemporaryDirectory() as folder, busy_thread():
        with simulated("fci", 0.0, Path(folder)) as (address, summary):
            arm = FciArm(address)
            arm.connect()
            arm.read()
            assert arm._connection is not None
            reader_pid = arm._connection.reader.pid
            with RealTime(min(split_cores()[0])):
                while arm.read() and time.monotonic_ns() - arm.arrived_ns > FRESH_NS:
                    pass  # what came while memory was locked
                before = process_time_ns(reader_pid)
                for k in range(count):
                    begun = time.thread_time_ns()
                    arm.read()
                    used[k] = time.thread_time_ns() - begun
                    ages[k] = time.monotonic_ns() - arm.arrived_ns
                reader_us = 1e-3 * (process_time_ns(reader_pid) - before) / count
            drops, intake = arm.kernel_drops, arm.intake
            arm.close()
        served = json.loads(summary.read_text())
    return {
        "samples": count,
        "lost": intake.lost,
        "dropped_by_the_kernel": drops,
        "refused": dict(intake.refused),
        "robot_stalled_ms": served["stalled_ms"],
        "age_us": spread(ages),
        "read_us": spread(used),
        "reader_process_us_mean": reader_us,
    }


def can_on(
    address: str,
    arm: Any,
    minutes: float,
    stop: Callable[[], None],
    service: Callable[[], object] = lambda: None,
) -> dict[str, Any]:
    """Hold the arm by torques for so long; `service` lets motors of this process work."""
    count = round(60e3 * minutes)
    used = np.zeros(count, np.int64)
    clock = Clock(arm.period_ns)
    for _ in range(200):
        clock.wait()
        service()
        sample = arm.read()
    q0, tau0 = sample.q, np.nan_to_num(sample.tau)
    K = 0.3 * np.array([600.0, 700.0, 400.0, 600.0, 40.0, 50.0, 10.0])
    unusable = 0
    with RealTime(min(split_cores()[0])):
        for k in range(count):
            clock.wait()
            service()
            begun = time.thread_time_ns()
            sample = arm.read()
            used[k] = time.thread_time_ns() - begun
            unusable += not np.isfinite(sample.q).all()
            tau = tau0 + np.nan_to_num(K * (q0 - sample.q) - 0.01 * K * sample.dq)
            begun = time.thread_time_ns()
            arm.command(tau)
            used[k] += time.thread_time_ns() - begun
    stop()
    intake = arm.intake
    return {
        "address": address,
        "ticks": count,
        "unusable": unusable,
        "missed": clock.missed,
        "received": intake.received,
        "lost": intake.lost,
        "refused": dict(intake.refused),
        "tick_us": spread(used),
    }


def can_virtual(minutes: float) -> dict[str, Any]:
    """Driver and motors in this process, on python-can's virtual bus."""
    import can

    from drivers.damiao.arm import DamiaoArm
    from sim.damiao.host import ServedBus
    from sim.damiao.server import Boards
    from sim.scenarios import build

    far = can.Bus(interface="virtual", channel="bench")
    boards = Boards(far, build("nominal"))
    served = ServedBus("bench", boards)
    address = "can://bench?interface=virtual"
    arm = DamiaoArm(address, allow_motion=True, bus=served)
    arm.connect()
    served.serving = False

    def stop() -> None:
        served.serving = True  # the motors work while the arm stops
        arm.stop()

    found = can_on(address, arm, minutes, stop, boards.service)
    arm.close()
    boards.close()
    served.shutdown()
    far.shutdown()
    return found


def can_udp(minutes: float) -> dict[str, Any]:
    """Motors in a process of their own, over udp_multicast."""
    from drivers.damiao.arm import DamiaoArm

    with (
        tempfile.TemporaryDirectory() as folder,
        simulated("can", 0.0, Path(folder)) as (address, _),
    ):
        arm = DamiaoArm(address + "&guardian=0", allow_motion=True)
        arm.connect()
        found = can_on(address, arm, minutes, arm.stop)
        arm.close()
    return found


def main() -> None:
    """Measure what was asked for; print and write."""
    parser = options(__doc__, minutes=0.5)
    kinds = {"fci": fci, "virtual": can_virtual, "udp": can_udp}
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {', '.join(kinds)}")
    args = parser.parse_args()
    found: dict[str, Any] = {}
    for kind in args.kinds or kinds:
        if kind not in kinds:
            parser.error(f"no kind '{kind}'; have: {', '.join(kinds)}")
        found[kind] = kinds[kind](args.minutes)
        print(kind, json.dumps(found[kind], indent=1), flush=True)
    write(args.json, found)


if __name__ == "__main__":
    main()
