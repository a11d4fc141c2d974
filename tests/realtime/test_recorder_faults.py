"""A disk that is full, slow or loses its writer: the arm goes on, what was written stays."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import threading
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from adapter.cli.common import recording_metadata
from adapter.cli.exit_codes import ExitCode
from adapter.cli.main import main
from drivers.files.mcap import read_log
from tests.helpers import live_tools as tools

pytestmark = [pytest.mark.alone, pytest.mark.usefixtures("no_leftovers")]

ROOM = 49 * 4096  # bytes, for a second or so of samples
RUN_S = 2.5


class Shaky(tools.Swinging):
    """An arm whose readings do not compress."""

    def __init__(self) -> None:
        super().__init__()
        self._rng = np.random.default_rng(3)

    def read(self):
        sample = super().read()
        return replace(sample, q=sample.q + 1e-6 * self._rng.random(7))


class Trap:
    """A word in a recording's metadata; where a recorder's process takes it in, `spring` is called.

    Args:
        spring: takes the path of the recording.
        path: of the recording.
    """

    def __init__(self, spring, path: Path) -> None:
        self.spring, self.path = spring, path

    def __reduce__(self):
        return _sprung, (self.spring, self.path)


def _sprung(spring, path: Path) -> str:
    spring(path)
    return "a trap"


def _in_the_middle(path: Path, act) -> None:
    """Call `act` beside the recorder once samples of half a second are in the file."""

    def wait() -> None:
        assert tools.wait_for(lambda: path.exists() and path.stat().st_size > ROOM // 2, 120.0)
        act()

    threading.Thread(target=wait, daemon=True).start()


def _run(path: Path, spring=None, ring_s: float = 5.0, duration_s: float = RUN_S):
    arm = Shaky()
    metadata = {"note": "test" if spring is None else Trap(spring, path)}
    recording = replace(tools.recording_job(path), metadata=metadata)
    options = tools.live_options(duration_s, ring_s)
    result = tools.live(arm, options, learner=tools.learner_job(), recording=recording)
    assert (result.ended, result.fault) == ("duration", None) and arm.stops == 1
    assert result.samples == round(1e3 * duration_s) + 1
    assert result.samples == result.recorded + result.unrecorded
    assert result.collected[:2] == (result.passed_on, True)
    return result


def _stamps(path: Path) -> list[int]:
    return read_log(path).stamp_ns.tolist()


@pytest.fixture
def small_disk(tmp_path):
    """A folder on a disk of `ROOM` bytes, where this user may have one; None elsewhere."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={ROOM}", "tmpfs", str(disk)]
    try:
        mounted = subprocess.run(mount, capture_output=True).returncode == 0
    except FileNotFoundError:
        mounted = False
    yield disk if mounted else None
    if mounted:
        subprocess.run(["umount", str(disk)], check=True)


def _little_room(path: Path) -> None:
    """From now on this process may write files of so many bytes."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (ROOM, resource.RLIM_INFINITY))


def _no_more_room(path: Path) -> None:
    def fill() -> None:
        most = path.stat().st_size + 4096
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, resource.RLIM_INFINITY))

    _in_the_middle(path, fill)


def test_a_full_disk_stops_the_recording_and_nothing_else(tmp_path, small_disk):
    """Where there is no small disk to be had, a file that may not grow is as good."""
    path = (small_disk or tmp_path) / "a.mcap"
    result = _run(path, None if small_disk else _little_room)
    assert small_disk is None or "No space left on device" in result.troubles[0]
    assert len(result.troubles) == 1 and "nothing more is recorded" in result.troubles[0]
    assert f"{path}: cannot be written" in result.troubles[0]
    assert "what was recorded before stays readable" in result.troubles[0]
    stamps = _stamps(path)
    assert stamps == [1_000_000 * k for k in range(1, len(stamps) + 1)]
    assert 0 < result.recorded <= len(stamps) and result.unrecorded > 0
    assert result.restarts == 0 and not list(path.parent.glob("*.part2*"))
    assert path.stat().st_size <= ROOM


def test_a_run_whose_recording_is_incomplete_says_so(tmp_path, monkeypatch, capsys):
    """By its exit code, in words, and in its figures."""
    trap = {"note": Trap(_no_more_room, tmp_path / "recording.mcap")}
    said_usually = recording_metadata
    monkeypatch.setattr(
        "adapter.cli.run.recording_metadata",
        lambda *x, **more: {**said_usually(*x, **more), **trap},
    )
    run = ["run", "--duration", "3", "--quiet", "--no-report", "--out", str(tmp_path)]
    assert main([*run, "--json", str(tmp_path / "o.json")]) == ExitCode.INCOMPLETE
    figures = json.loads((tmp_path / "o.json").read_text())
    assert figures["fault"] is None and figures["unrecorded"] > 0
    said = capsys.readouterr().err
    assert f"{figures['unrecorded']} samples (" in said and "not in the recording" in said


def _stop_once(path: Path) -> None:
    """Hangs once, as a write to a disk does that has other work."""

    def stop() -> None:
        place = Path(os.environ["TEST_GRAVES"]) / "hanging"
        if not place.exists():
            place.write_text(str(os.getpid()))
            os.kill(os.getpid(), signal.SIGSTOP)

    _in_the_middle(path, stop)


@pytest.mark.parametrize(("hangs_s", "ring_s"), [(0.7, 5.0), (2.0, 1.0)])
def test_a_slow_disk_costs_what_the_ring_cannot_hold(tmp_path, hangs_s, ring_s):
    place, path = tmp_path / "hanging", tmp_path / "a.mcap"

    def wake() -> None:
        assert tools.wait_for(lambda: place.exists() and place.read_text(), 120.0)
        time.sleep(hangs_s)
        os.kill(int(place.read_text()), signal.SIGCONT)

    waker = threading.Thread(target=wake)
    waker.start()
    result = _run(path, _stop_once, ring_s, duration_s=3.5 if hangs_s > ring_s else RUN_S)
    waker.join()
    stamps = _stamps(path)
    assert result.troubles == [] and len(stamps) == result.recorded
    assert (np.diff(stamps) > 0).all()
    assert (result.unrecorded == 0) == (ring_s > hangs_s)


def test_a_killed_recorder_is_followed_by_one_with_a_file_of_its_own(tmp_path):
    path = tmp_path / "a.mcap"
    result = _run(path, partial(_in_the_middle, act=partial(tools.die_once, "recorder")))
    assert result.restarts == 1 and result.unrecorded == 0
    assert len(result.troubles) == 1 and "exit code -9" in result.troubles[0]
    first, second = _stamps(path), _stamps(tmp_path / "a.part2.mcap")
    assert read_log(path).truncated and not read_log(tmp_path / "a.part2.mcap").truncated
    assert len(first) > 0 and second[-1] == 1_000_000 * result.samples
    assert 0 <= first[-1] + 1_000_000 - second[0] < 500_000_000  # was not handed over yet
    assert sorted({*first, *second}) == [1_000_000 * k for k in range(1, result.samples + 1)]
