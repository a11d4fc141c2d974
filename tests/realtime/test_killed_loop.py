"""A loop that is killed while it drives an arm over a wire: the arm is braked, not dropped."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from drivers.fci.arm import FciArm
from drivers.files.mcap import read_log
from drivers.interface import DriverError
from tests.helpers import hardware_rigs as rigs
from tests.helpers.live_tools import wait_for

pytestmark = pytest.mark.alone

ATTEMPTS = 3
SECOND = 1000  # samples
MOVING = 0.05  # rad/s, of the fastest joint; slower it is at rest


def test_a_robot_whose_loop_is_killed_brakes_by_itself(tmp_path):
    # A robot rightly ends a motion whose machine was away for 20 ms; then there is no loop to kill.
    for k in range(ATTEMPTS):
        ended = _killed_in_motion(tmp_path / str(k))
        if not ended:
            return
    pytest.skip(f"this machine is away too often for a robot to move: {ended}")


def _killed_in_motion(folder: Path) -> str:
    """Kill the loop of a moving robot, which has to come to rest; why it ended before, or ""."""
    folder.mkdir()
    figures = folder / "run.json"
    served = *rigs.SERVE, "fci", "--port", "0", "--patience", rigs.PATIENCE_S
    with rigs.process(*served) as line:
        address = rigs.fci_address(line)
        command = [sys.executable, "-m", "adapter", "run", "--driver", address, "--allow-motion"]
        command += ["--yes", "--duration=60", "--quiet", f"--out={folder}", f"--json={figures}"]
        recording = folder / "recording.mcap"
        loop = subprocess.Popen(command, stderr=subprocess.DEVNULL, start_new_session=True)
        try:
            # A second of samples is some 0.25 MB.
            under_way = lambda: recording.exists() and recording.stat().st_size > 8e5  # noqa: E731
            wait_for(lambda: under_way() or loop.poll() is not None, 120)
            if loop.poll() is not None:
                ended = json.loads(figures.read_text())  # rightly: states or commands were late
                assert (loop.returncode, ended["ended"]) == (3, "driver_error") and ended["fault"]
                return ended["fault"]
            assert under_way()
        finally:
            with suppress(ProcessLookupError):
                os.killpg(loop.pid, signal.SIGKILL)
            loop.wait()
        assert np.abs(read_log(recording).dq[-SECOND:]).max(axis=1).min() > MOVING
        q = _at_rest(address)
        time.sleep(0.5)
        assert np.abs(_at_rest(address) - q).max() < 1e-3
    return ""


def _at_rest(address: str) -> np.ndarray:
    """Where the robot stands; it does not move."""
    for _ in range(40):  # it takes a moment to notice that its client is gone
        arm = FciArm(address)
        try:
            arm.connect()
        except DriverError:
            time.sleep(0.2)
            continue
        samples = [arm.read() for _ in range(200)]
        arm.close()
        if max(np.abs(s.dq).max() for s in samples[100:]) < MOVING:
            return np.mean([s.q for s in samples[100:]], axis=0)
    pytest.fail("the robot never came to rest")
