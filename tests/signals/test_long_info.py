"""`adapter info` on a long recording: by its index and a sample, beside all of it."""

from pathlib import Path

import numpy as np
import pytest

from adapter.signals.recording import describe, summary
from drivers.files.mcap import McapWriter, sample_log, sampled

NAMES = ("a", "b")
SAMPLES, HOLE_AT, HOLE_NS = 12_000, 7_000, 2 * 10**9


def write(path: Path) -> Path:
    """States and commands in 24 chunks, with a hole between two of them."""
    rng = np.random.default_rng(2)
    with McapWriter(path, NAMES, metadata={"arm": "left"}) as writer:
        for i in range(SAMPLES):
            if i % 500 == 0:
                writer.flush()
            stamp_ns = 10**9 + 10**6 * i + HOLE_NS * (i >= HOLE_AT)
            q = np.sin([1e-3 * i, 2e-3 * i])
            dq = np.cos([1e-3 * i, 2e-3 * i]) * (1.0, 2.0)
            writer.write_joint_state(stamp_ns, q, dq, rng.standard_normal(2))
            if i % 10 == 0:
                writer.write_command(stamp_ns, np.zeros(2))
        writer.attach("note.json", b"{}")
    return path


@pytest.fixture
def sampling(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampled, "SAMPLED_FROM", 0)
    monkeypatch.setattr(sampled, "STRETCHES", 6)
    monkeypatch.setattr(sampled, "STRETCH_BYTES", 1)


def test_a_sample_tells_what_the_whole_tells(tmp_path: Path, monkeypatch, request) -> None:
    path = write(tmp_path / "long.mcap")
    whole = describe(path)
    request.getfixturevalue("sampling")
    found = describe(path)
    assert whole["samples_judged"] == SAMPLES and found["samples_judged"] == 6 * 500
    alike = ("bytes", "problem", "topics", "joints", "source", "samples", "commands", "metadata")
    for name in (*alike, "attachments", "start_s", "duration_s", "rate_hz", "not_finite", "gaps"):
        assert found[name] == whole[name], name
    assert found["gaps"]["count"] == 1 and found["period_ms"]["p50"] == 1.0
    assert found["period_ms"]["max"] == 1.0  # stretches are not taken for holes
    for name, limits in whole["range"].items():
        for side, values in limits.items():
            assert found["range"][name][side] == pytest.approx(values, abs=1.0), name
    assert any("judged from 3000 of 12000 samples, in 6 stretches" in x for x in summary(found))
    assert not any("judged from" in x for x in summary(whole))


def test_a_file_without_a_sound_index_is_read_whole(tmp_path: Path, sampling: None) -> None:
    path = write(tmp_path / "long.mcap")
    assert sample_log(path) is not None
    path.write_bytes(path.read_bytes()[:-200])
    assert sample_log(path) is None
    assert describe(path)["truncated"]
