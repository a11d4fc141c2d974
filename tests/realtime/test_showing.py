"""Looking at a run: what is read is whole, and who looks never matters to the loop."""

from __future__ import annotations

import os
import signal
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from adapter.realtime import SnapshotReader, SnapshotWriter
from adapter.realtime.ring import Ring
from adapter.realtime.showing import DisplayJob, Looker
from adapter.realtime.snapshot import NEWS_BYTES
from adapter.realtime.timing import COUNTED, LINES_BYTES, LoopBoard, Timing
from tests.helpers import live_tools as tools

pytestmark = [pytest.mark.alone, pytest.mark.usefixtures("no_leftovers")]


def test_a_spectator_sees_the_newest_and_takes_nothing() -> None:
    ring = Ring.create(2, 8)
    for k in range(5):
        ring.push(np.array([float(k), -float(k)]))
    other = Ring.attach(ring.name)
    np.testing.assert_array_equal(other.newest(3)[:, 0], [2.0, 3.0, 4.0])
    np.testing.assert_array_equal(other.newest(100)[:, 0], np.arange(5.0))
    assert ring.unread == 5
    ring.release(5)
    for k in range(5, 16):
        ring.push(np.array([float(k), 0.0]))
        ring.release(1)
    np.testing.assert_array_equal(other.newest(3)[:, 0], [13.0, 14.0, 15.0])  # round the end
    assert len(other.newest(100)) == 7  # the eighth may be written at this moment
    for part in (other, ring):
        part.close()
    ring.unlink()


def test_a_spectator_never_sees_half_of_a_record() -> None:
    """While a producer writes as fast as it can into a ring that is short."""
    ring, stop, looks = Ring.create(64, 32), threading.Event(), 0
    other = Ring.attach(ring.name)

    def produce() -> None:
        k = 0
        while not stop.is_set():
            ring.push(np.full(64, float(k)))
            ring.release(1)
            k += 1

    thread = threading.Thread(target=produce)
    thread.start()
    end = time.monotonic() + 0.5
    while time.monotonic() < end or looks < 100:
        rows = other.newest(16)
        assert (rows == rows[:, :1]).all() and (np.diff(rows[:, 0]) == 1.0).all()
        looks += len(rows) > 0
    stop.set()
    thread.join()
    for part in (other, ring):
        part.close()
    ring.unlink()


def test_news_and_what_is_too_much_of_it() -> None:
    board = SnapshotWriter.create(("a", "b"), name=None)
    with SnapshotReader(board.name) as reader:
        assert reader.read_news() == {}
        board.publish_news({"findings": [{"what": "θ"}], "load": None})
        assert reader.read_news() == {"findings": [{"what": "θ"}], "load": None}
        with pytest.raises(ValueError, match=f"at most {NEWS_BYTES}"):
            board.publish_news({"notes": ["x" * NEWS_BYTES]})
        with pytest.raises(ValueError):
            board.publish_news({"m": float("nan")})
        assert reader.read_news() == {"findings": [{"what": "θ"}], "load": None}
    board.close()
    board.unlink()


def test_what_the_loop_says_of_itself() -> None:
    board = LoopBoard.create()
    other = LoopBoard.attach(board.name)
    assert (other.lines(), other.end(), other.began_ns) == ([], None, 0)
    timing = Timing(board.bins)
    for k in range(1000):
        timing.add(k * 1_000_000, k * 1_000_000 + 50_000, k * 1_000_000 + 100_000 + 1000 * k, 0)
    board.count_missed(7, 2)
    seen, report = other.timing(), timing.report(7, 2)
    assert (seen.missed, seen.missed_own) == (7, 2)
    for what in COUNTED:
        told = getattr(report, what)
        for share, name in ((50.0, "p50"), (99.0, "p99")):
            found = seen.of(what).percentile_us(share)
            assert found == (told[name] and pytest.approx(told[name], rel=2e-3))
    assert abs(1e-3 * seen.of("loop_us").max_ns - report.loop_us["max"]) < 2e-3 * 1099.0
    timing.add(10**9, 10**9, 10**9 + 5_000_000, 0)
    assert other.timing().since(seen).of("loop_us").count == 1
    assert board.write_line("one\nline") and other.lines() == ["one line"]
    while board.write_line("x" * 900):
        pass
    assert len(other.lines()) > LINES_BYTES // 1000
    board.write_begin(5)
    board.write_end("driver_error", "the cable came off")
    assert other.end() == ("driver_error", "the cable came off") and other.began_ns == 5
    for part in (other, board):
        part.close()
    board.unlink()


def _kill_first(folder: Path, done: threading.Event) -> None:
    """kill -9 of the first view once it has seen something; then wait for the next one."""
    while not done.wait(0.02):
        pids, last = list(folder.glob("*.view")), folder / "last"
        if pids and last.exists() and int(last.read_text().split()[0]) > 300:
            os.kill(int(pids[0].stem), signal.SIGKILL)
            last.unlink()
            return


def test_a_view_that_is_killed_is_followed_and_the_loop_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run is told of it through the display; a view that hangs at the end is let go."""
    monkeypatch.setattr("adapter.realtime.supervisor.DISPLAY_STALL_S", 60.0)
    done, said, options = threading.Event(), list[str](), tools.live_options(60.0)
    killer = threading.Thread(target=_kill_first, args=(tmp_path, done))

    def stop_when_followed() -> None:
        killer.join()
        tools.wait_for((tmp_path / "last").exists, 50.0)
        os.kill(os.getpid(), signal.SIGINT)

    killer.start()
    stopper = threading.Thread(target=stop_when_followed)
    stopper.start()
    result = tools.live(
        tools.Swinging(),
        options,
        say=said.append,
        learner=tools.learner_job(),
        display=DisplayJob(partial(tools.Lines, tmp_path / "lines"), period_s=0.02, says=True),
        view=DisplayJob(partial(tools.Witness, tmp_path), period_s=0.02),
    )
    done.set()
    stopper.join()
    assert (result.ended, result.fault) == ("interrupted", None)
    assert result.unlearned == 0 and result.collected[:2] == (result.passed_on, True)
    killed, hanging = result.troubles
    assert "view process failed" in killed and "exit code -9" in killed and "1 of 3" in killed
    assert "did not come to an end" in hanging
    assert killed in (tmp_path / "lines").read_text() and killed not in said
    assert len(list(tmp_path.glob("*.view"))) == 2
    samples, ticks, over, ended = (tmp_path / "last").read_text().split(" ")
    assert (int(samples), over, ended) == (result.passed_on, "True", "interrupted,")
    assert int(ticks) == result.timing.ticks


def test_a_view_that_cannot_start_is_no_reason_not_to_run() -> None:
    said: list[str] = []
    jobs = {"learner": tools.learner_job(), "view": DisplayJob(tools.no_view)}
    result = tools.live(tools.Swinging(), tools.live_options(0.2), say=said.append, **jobs)
    assert (result.ended, result.samples) == ("duration", 201)
    assert result.troubles == said[:1] and "the page cannot be drawn" in said[0]


def test_a_look_keeps_what_it_saw_where_a_writer_dies_half_way() -> None:
    """A block whose newest slot is half written: the estimate before stays on show."""
    ring, board = Ring.create(4, 8), SnapshotWriter.create(("a",), name=None)
    reader = SnapshotReader(board.name)
    board.publish_news({"refused": 1})
    looker = Looker(ring, reader, None)
    assert looker.look(False).news == {"refused": 1}
    reader._header[2] += 1  # names a slot that nobody has written
    assert looker.look(False).news == {"refused": 1}
    for part in (reader, board, ring):
        part.close()
    for made in (board, ring):
        made.unlink()
