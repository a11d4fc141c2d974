"""What every test of live processes begins with and leaves behind: nothing."""

from __future__ import annotations

import pytest

from tests.helpers import live_tools as tools


@pytest.fixture
def no_leftovers(tmp_path, monkeypatch):
    """No shared memory and no kept state of a learner is left; a busy machine is no end."""
    monkeypatch.setenv("TEST_GRAVES", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.setattr("adapter.realtime.loop.WALL_EXTRA_S", 60.0)
    blocks = tools.created_blocks(monkeypatch)
    yield
    assert tools.wait_for(lambda: not tools.left_behind(blocks))
    assert tools.wait_for(lambda: not list(tmp_path.glob("adapter-learner-*")))
