"""A loop that is killed while it drives an arm over a wire: the arm is braked, not dropped."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress

import numpy as np
import pytest

from drivers.fci.arm import FciArm
from drivers.interface import DriverError
from tests.helpers import hardware_rigs as rigs
from tests.helpers.live_tools import wait_for

pytestmark = pytest.mark.alone


def test_a_robot_whose_loop_is_killed_brakes_by_itself(tmp_path):
    settings = tmp_path / "fast.toml"
    settings.write_text("[excitation]\nslow_s = 1.0\n")  # in motion at once
    with rigs.process("-m", "sim.fci", "--port", "0", "--patience", rigs.PATIENCE_S) as line:
        address = f"fci://{line.split()[2]}"
        command = [
            sys.executable, "-m", "adapter", "run", "--driver", address, "--allow-motion",
            "--duration", "60", "--quiet", "--out", str(tmp_path), "--config", str(settings),
        ]  # fmt: skip
        recording = tmp_path / "recording.mcap"
        loop = subprocess.Popen(command, stderr=subprocess.DEVNULL, start_new_session=True)
        try:
            # A second of samples is some 0.25 MB; after three seconds it moves at full speed.
            full_speed = lambda: recording.exists() and recording.stat().st_size > 0.7e6  # noqa: E731
            wait_for(lambda: full_speed() or loop.poll() is not None, 120)
            assert loop.poll() is None and full_speed()
        finally:
            with suppress(ProcessLookupError):
                os.killpg(loop.pid, signal.SIGKILL)
            loop.wait()
        q = _at_rest(address)
        time.sleep(0.5)
        assert np.abs(_at_rest(address) - q).max() < 1e-3


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
        if max(np.abs(s.dq).max() for s in samples[100:]) < 0.05:
            return np.mean([s.q for s in samples[100:]], axis=0)
    pytest.fail("the robot never came to rest")
