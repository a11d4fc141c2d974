"""Files of others: each is read, or one sentence says what is wrong with it, and where."""

import gzip
import json
import re
from pathlib import Path

import numpy as np
import pytest

from adapter.cli import main
from adapter.cli.exit_codes import ExitCode
from drivers.files.mcap import read_log
from tests.helpers.bags import Motion, write_ros1, write_ros2

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

JOINT_STATE = "sensor_msgs/msg/JointState"
MOTION = Motion.of(2, samples=80)
TIME = (MOTION.stamp_ns - MOTION.stamp_ns[0]) * 1e-9
TABLE = np.column_stack([TIME, MOTION.q, MOTION.dq, MOTION.tau])
NAMES = ("t", "q_1", "q_2", "dq_1", "dq_2", "tau_1", "tau_2")
READ = "joint states: "


def text(table=TABLE, delimiter=",", names=NAMES, comma=False, end="\n"):
    rows = [delimiter.join(f"{x:.15g}" for x in row) for row in table]
    if comma:
        rows = [row.replace(".", ",") for row in rows]
    return end.join(([delimiter.join(names)] if names else []) + rows) + end


def spoilt(row, column, word):
    lines = [line.split(",") for line in text().splitlines()]
    lines[row][column] = word
    return "\n".join(map(",".join, lines))


def scaled(columns, factor):
    table = TABLE.copy()
    table[:, columns] *= factor
    return text(table)


FRANKA = ("time", "q[0]", "q[1]", "dq[0]", "dq[1]", "tau_J[0]", "tau_J[1]")
STAMPS = TABLE.copy()
STAMPS[:, 0] += 1.7e9
TEXTS = {  # name: (content, expected words, options)
    "comma.csv": (text(), READ),
    "semicolon decimal.csv": (text(delimiter=";", comma=True), READ),
    "tab decimal.tsv": (text(delimiter="\t", comma=True), READ),
    "tab spaced names.tsv": (
        text(delimiter="\t", names=("time", *(f"{a} {k}" for a in "qvw" for k in "12"))),
        READ,
        *("--columns", "q=q*,dq=v*,tau=w*"),
    ),
    "pipe.txt": (text(delimiter="|"), READ),
    "space.dat": (text(delimiter=" "), READ),
    "space decimal.txt": (text(delimiter="  ", comma=True), READ),
    "no header, no map.csv": (text(names=()), "which column is time"),
    "comment header.txt": ("# " + text(delimiter=" "), READ),
    "quoted.csv": (text(names=tuple(f'"{n}"' for n in NAMES)), READ),
    "windows.csv": (text(end="\r\n"), READ),
    "byte order mark.csv": ("\ufeff" + text(), READ),
    "blank lines.csv": (text(end="\n\n"), READ),
    "bad pattern.csv": (text(), "no column 'x_\\*' for q; named t, q_1", "--columns", "q=x_*"),
    "milliseconds untold.csv": (
        scaled([0], 1e3),
        "10 s apart; is the time in s\\? Say --units time=",
    ),
    "ten seconds apart.csv": (scaled([0], 1e3), READ, "--units", "time=s"),
    "nanoseconds untold.csv": (scaled([0], 1e9), "is the time in s\\?|is no time"),
    "stamps.csv": (text(STAMPS), READ),
    "others beside.csv": (
        text(np.hstack([TABLE, TABLE[:, 1:4]]), names=(*FRANKA, "q_d[0]", "q_d[1]", "tau_error")),
        READ,
    ),
    "index of pandas.csv": (
        text(np.hstack([TABLE[:, :1], TABLE]), names=("", *NAMES)).replace(",t,", ",time_s,"),
        READ,
    ),
    "dates.csv": (
        text().replace("\n", "\n2026-01-02 10:20:").rsplit("\n", 1)[0],
        "line 2, column 0 \\(t\\): '2026-01-02 10:20:0' is not",
    ),
    "milliseconds told.csv": (scaled([0], 1e3).replace("t,", "time_ms,", 1), READ),
    "stamps in ns untold.csv": (text(STAMPS * [1e9, 1, 1, 1, 1, 1, 1]), "line 2: .* is no time"),
    "degrees untold.csv": (scaled([1, 2, 3, 4], 57.3), "are they degrees\\? Say --units q=deg"),
    "far turned.csv": (scaled([1, 2, 3, 4], 57.3), "look like degrees", "--units", "q=rad"),
    "velocity in degrees.csv": (scaled([3, 4], 57.3), "velocities 57.* times the slope"),
    "word.csv": (spoilt(7, 2, "abc"), "line 8, column 2 \\(q_2\\): 'abc' is not a number"),
    "empty cell.csv": (spoilt(7, 2, ""), "line 8, column 2 \\(q_2\\): '' is not a number"),
    "nan.csv": (spoilt(7, 2, "nan"), "q is not a number in 1 samples"),
    "huge angle.csv": (spoilt(7, 2, "1e300"), "line 8: 1e\\+300 is no angle"),
    "huge torque.csv": (spoilt(9, 6, "-1e308"), "line 10: -1e\\+308 is no torque"),
    "huge time.csv": (spoilt(9, 0, "1e20"), "line 10: 1e\\+20 is no time"),
    "no time.csv": (spoilt(9, 0, "nan"), "the time of sample 8 is not a number"),
    "digits.csv": (spoilt(9, 1, "9" * 5000), "line 10: inf is no angle"),
    "backwards.csv": (text(TABLE[::-1]), "time runs backwards 79 times"),
    "ragged.csv": (text() + "1,2,3\n", "line 82 has 3 values"),
    "cut.csv": (text()[:-25], "line 81"),
    "header only.csv": (",".join(NAMES), "holds a header .* and no numbers"),
    "empty.csv": ("", "holds no numbers"),
    "blank.csv": ("\n \n\n", "holds no numbers"),
    "one sample.csv": (text(TABLE[:1]), READ),
    "prose.txt": ("It was a dark night.\nThe arm moved.\n", "is not a number"),
    "binary.csv": ("\x00\x01\x02" * 40, "is not a number|which column|holds"),
    "-dash.csv": (text(), READ),
    "50% #1 ?x=[b]'.csv": (text(), READ),
    "ünï 名.csv": (text(), READ),
    "quote open.csv": (text() + '"1,2,3,4,5,6,7\n', "line 82"),
}


def told(path, capsys, *options):
    code = main(["info", *options, "--", str(path)])
    said = capsys.readouterr()
    assert "Traceback" not in said.out + said.err
    assert code in (0, ExitCode.WRONG_USE)
    assert Path(path).name in said.out + said.err
    if code:
        assert [line.startswith("reading ") for line in said.err.strip().splitlines()] in (
            [True, False],
            [False],
        )
    return said.out + said.err


@pytest.mark.parametrize("name", TEXTS)
@pytest.mark.filterwarnings("error")
def test_texts(tmp_path, capsys, name):
    content, expected, *options = TEXTS[name]
    (tmp_path / name).write_bytes(content.encode())
    assert re.search(expected, told(tmp_path / name, capsys, *options))


@pytest.mark.parametrize("name", ["comma.csv", "semicolon decimal.csv", "word.csv", "space.dat"])
def test_packed_texts(tmp_path, capsys, name):
    content, expected, *options = TEXTS[name]
    path = tmp_path / f"{name}.gz"
    path.write_bytes(gzip.compress(content.encode()))
    assert re.search(expected, told(path, capsys, *options))
    path.write_bytes(path.read_bytes()[:-20])
    assert "cannot be read" in told(path, capsys, *options)


def bag_makers():
    topics = {"/joint_states": (JOINT_STATE, MOTION)}
    names = ("a", "b")
    wild = Motion(MOTION.stamp_ns, MOTION.q * 1e300, MOTION.dq, MOTION.tau * np.inf)
    still = Motion(MOTION.stamp_ns, MOTION.q, MOTION.dq, np.full((80, 2), np.nan))
    yield "wild.bag", READ, write_ros1, {"/s": (JOINT_STATE, wild)}, names
    yield "nan", "not a number throughout", write_ros2, {"/s": (JOINT_STATE, still)}, names
    yield "no [bold]names%20?#'.bag", "names joints", write_ros1, topics, ()
    yield "twice", "names joints", write_ros2, topics, ("a", "a")


@pytest.mark.parametrize("maker", list(bag_makers()), ids=lambda maker: maker[0])
def test_bags(tmp_path, capsys, maker):
    name, expected, write, *arguments = maker
    assert expected in told(write(tmp_path / name, *arguments), capsys)


def lerobot(folder, episodes=1, torque=True, names=("shoulder", "elbow")):
    (folder / "meta").mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    features = {"observation.state": {"dtype": "float32", "shape": [2], "names": list(names)}}
    (folder / "meta" / "info.json").write_text(json.dumps({"fps": 100, "features": features}))
    columns = {
        "observation.state": np.tile(MOTION.q, (episodes, 1)).tolist(),
        "observation.velocity": np.tile(MOTION.dq, (episodes, 1)).tolist(),
        "timestamp": np.tile(TIME, episodes),
        "episode_index": np.repeat(np.arange(episodes), len(TIME)),
        "task": ["lift"] * (episodes * len(TIME)),
    }
    if torque:
        columns["observation.effort"] = np.tile(MOTION.tau, (episodes, 1)).tolist()
    pq.write_table(pa.table(columns), folder / "data" / "chunk-000" / "file-000.parquet")
    return folder


def test_data_sets(tmp_path, capsys):
    assert "joints: 2, shoulder, elbow" in told(lerobot(tmp_path / "one"), capsys)
    two = lerobot(tmp_path / "two", episodes=2)
    assert "has 2 episodes, 0 to 1; choose one (--episode N)" in told(two, capsys)
    assert "80 samples" in told(two, capsys, "--episode", "1")
    assert "has no episode 7; have 0 to 1" in told(two, capsys, "--episode", "7")
    assert "which column is tau" in told(lerobot(tmp_path / "bare", torque=False), capsys)
    (two / "meta" / "info.json").write_text("{}")
    assert "does not describe observation.state" in told(two, capsys, "--episode", "1")
    for path in (tmp_path / "one").rglob("*.parquet"):
        path.unlink()
    assert "has no Parquet file" in told(tmp_path / "one", capsys)


def test_parquet(tmp_path, capsys):
    path = tmp_path / "flat.parquet"
    pq.write_table(pa.table(dict(zip(NAMES, TABLE.T, strict=True))), path)
    assert READ in told(path, capsys)
    path.write_bytes(path.read_bytes()[:500])
    assert "cannot be read as Parquet" in told(path, capsys)
    pq.write_table(pa.table({"name": ["a", "b"]}), path)
    assert "holds no numbers" in told(path, capsys)
    path.write_bytes(b"")
    assert "cannot be read as Parquet" in told(path, capsys)


def test_a_table_becomes_a_recording(tmp_path):
    """What `info` reads `import` writes: the same numbers, by every way."""
    folder = lerobot(tmp_path / "set")
    assert main(["import", str(folder), "--to", str(tmp_path / "a.mcap")]) == 0
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(text().encode()))
    assert main(["import", str(tmp_path / "a.csv.gz"), "--to", str(tmp_path / "b.mcap")]) == 0
    for name in ("a", "b"):
        log = read_log(tmp_path / f"{name}.mcap")
        assert np.allclose(log.q, MOTION.q, atol=1e-8)
        assert np.allclose(log.tau, MOTION.tau, atol=1e-7)
