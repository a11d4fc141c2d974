"""Files that claim, nest or grow without measure are refused; the sentence states the limit."""

import json
import struct
import zipfile
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard

from adapter.cli.exit_codes import ExitCode
from adapter.cli.main import main
from adapter.errors import SettingsError
from adapter.learning.checkpoint import load_checkpoint, save_checkpoint
from adapter.model.model_file import dumps
from adapter.model.robots import documented
from drivers.files.bounded import DEPTH_LIMIT, parse_json, read_arrays
from drivers.files.mcap import survey
from drivers.files.mcap.records import MAGIC
from tests.helpers.arm_data import learner_for
from tests.helpers.mcap_tools import weighed_alone

ZEROS = 2**28  # bytes, in a few kB of a chunk


def chunk(name: bytes, content: bytes, size: int) -> bytes:
    """A chunk record that claims to make `size` bytes."""
    head = struct.pack("<QQQII", 0, 0, size, 0, len(name)) + name
    body = head + struct.pack("<Q", len(content)) + content
    return struct.pack("<BQ", 6, len(body)) + body


def frame(name: bytes) -> bytes:
    """A small frame of very many zeros."""
    zeros = bytes(ZEROS)
    return zstandard.compress(zeros) if name == b"zstd" else lz4.frame.compress(zeros)


@pytest.mark.parametrize("name", [b"zstd", b"lz4"])
@pytest.mark.parametrize("kind", ["honest", "lying", "cut"])
def test_a_chunk_does_not_grow_beyond_its_limit(tmp_path: Path, name: bytes, kind: str) -> None:
    """Whether it says how large it is, says something else, or is cut."""
    path, said = tmp_path / "bomb.mcap", 1000 if kind == "lying" else ZEROS
    content = chunk(name, frame(name), said)
    path.write_bytes(MAGIC + (content[:-100] if kind == "cut" else content))
    told, most_kib = weighed_alone("survey", path)
    assert most_kib < 300_000, told
    limit = {"honest": "at most 134217728 are read", "lying": "the 1000 bytes that it claims"}
    assert limit.get(kind, "incomplete record") in told


def test_many_chunks_do_not_grow_beyond_what_a_log_does(tmp_path: Path) -> None:
    path, most = tmp_path / "bombs.mcap", 2**26
    one = chunk(b"zstd", zstandard.compress(bytes(most)), most)
    path.write_bytes(MAGIC + 60 * one)
    _, told, _ = survey(path)
    assert any("would grow more than 300 times" in line for line in told)
    assert len(told) < 60


def test_damage_is_not_listed_without_end(tmp_path: Path) -> None:
    path = tmp_path / "damaged.mcap"
    path.write_bytes(MAGIC + 5000 * struct.pack("<BQ", 3, 0))  # schemas of no bytes
    _, told, _ = survey(path)
    assert len(told) < 60 and any("more damage" in line for line in told)


@pytest.mark.parametrize("key", ["theta.x", "schema.R0", "adam.second"])
def test_checkpoints_are_whole_and_finite(tmp_path: Path, key: str) -> None:
    path = tmp_path / "c.npz"
    save_checkpoint(learner_for(), path)
    load_checkpoint(learner_for(), path)
    arrays = read_arrays(path)
    for wrong in (np.full_like(arrays[key], np.nan), None):
        content = {**arrays, key: wrong}
        np.savez(path, **{name: x for name, x in content.items() if x is not None})
        with pytest.raises(SettingsError, match=f"'{key}'"):
            load_checkpoint(learner_for(), path)


DEEP = "[" * 100_000 + "]" * 100_000
BAD_JSON = {
    DEEP: "more than 64 deep",
    "[" * 65 + "]" * 65: "more than 64 deep",
    '{"a": NaN}': "'NaN' is not a number",
    "[-Infinity]": "not a number",
    "[1e999]": "too large",
    "9" * 5000: "5000 digits",
}


@pytest.mark.parametrize("text", BAD_JSON, ids=range(len(BAD_JSON)))
def test_json_that_no_program_should_read(text: str) -> None:
    with pytest.raises(ValueError, match=BAD_JSON[text]):
        parse_json(text)


def test_json_that_is_deep_enough() -> None:
    text = "[" * DEPTH_LIMIT + "1.5" + "]" * DEPTH_LIMIT
    assert parse_json(text) == json.loads(text)


def npz(path: Path, header: str, compression: int = zipfile.ZIP_DEFLATED) -> Path:
    """An .npz file of one array with this header and few bytes."""
    head = header.encode().ljust(117) + b"\n"
    array = np.lib.format.MAGIC_PREFIX + bytes([1, 0]) + struct.pack("<H", len(head)) + head
    with zipfile.ZipFile(path, "w", compression) as file:
        file.writestr("q.npy", array + bytes(80))
    return path


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000000,), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-5,), }",
        "{'descr': '|O', 'fortran_order': False, 'shape': (10,), }",
        "(" * 100,
        "{'descr': [[[[[",
    ],
)
def test_arrays_that_claim_what_is_not_there(tmp_path: Path, header: str) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        read_arrays(npz(tmp_path / "a.npz", header))


def test_arrays_that_grow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.files.bounded.ARRAYS_LIMIT", 10_000)
    np.savez_compressed(tmp_path / "a.npz", q=np.zeros(9000))
    with pytest.raises(ValueError, match="at most 10000 are read"):
        read_arrays(tmp_path / "a.npz")
    np.savez_compressed(tmp_path / "b.npz", q=np.arange(900.0))
    assert read_arrays(tmp_path / "b.npz")["q"].sum() == 900 * 899 / 2
    (tmp_path / "c.npz").write_bytes(b"no zip")
    with pytest.raises(ValueError, match="not a zip"):
        read_arrays(tmp_path / "c.npz")


@pytest.mark.parametrize("text", [DEEP, "[1e999]", "[NaN]"], ids=["deep", "large", "nan"])
def test_commands_refuse_them(tmp_path: Path, capsys, text: str) -> None:
    """Models, truths, settings and what a run left: one sentence, no traceback."""
    log = Path(__file__).parents[2] / "recordings" / "panda_nominal_6s.mcap"
    bad, folder = tmp_path / "bad.json", tmp_path / "run"
    folder.mkdir()
    robot = documented("panda")
    bad.write_text(dumps(robot).replace('"provenance": {', f'"provenance": {{"x": {text}, ', 1))
    (tmp_path / "truth.json").write_text(f'{{"lambda": {text}}}')
    (tmp_path / "bad.toml").write_text(f"gravity = {text.lower().replace('1e999', '1e9999')}")
    for name in ("model.json", "documented.json"):
        (folder / name).write_text(dumps(robot))
    (folder / "figures.json").write_text(text)
    for line in (
        ["info", bad],
        ["replay", log, "--robot", bad],
        ["replay", log, "--truth", tmp_path / "truth.json"],
        ["replay", log, "--config", tmp_path / "bad.toml"],
        ["report", folder],
    ):
        assert main([str(word) for word in line]) == ExitCode.WRONG_USE, line
        assert capsys.readouterr().err.count("error: ") == 1
