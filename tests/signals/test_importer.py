"""Tables of other tools become recordings; what is wrong with them is said with its place."""

from pathlib import Path

import numpy as np
import pytest

from adapter.signals.importer import import_file
from adapter.signals.recording import describe
from adapter.signals.source_signals import ImportSpec
from drivers.files.mcap import read_log
from drivers.interface import DriverError
from tests.helpers.robot_models import shared

ROWS = 400
RNG = np.random.default_rng(3)
TIME = 2.0 + np.arange(ROWS) * 1e-3
Q = 0.5 * np.sin(3 * TIME[:, None] + [0.0, 1.0])
DQ = 1.5 * np.cos(3 * TIME[:, None] + [0.0, 1.0])
TAU = RNG.standard_normal((ROWS, 2)) * 10
TABLE = np.column_stack([TIME, Q, DQ, TAU])
JOINTS = ("a", "b")
COLUMNS = "time=0,q=1:3,dq=3:5,tau=5:7"


def write(path: Path, table, delimiter=",", header="") -> Path:
    np.savetxt(path, table, fmt="%.17g", delimiter=delimiter, header=header, comments="")
    return path


def run(tmp_path, sources, columns="", units="", **other):
    other = {"joint_names": JOINTS, "overwrite": True, **other}
    spec = ImportSpec.from_options([str(s) for s in sources], columns, units, **other)
    report = import_file(spec, tmp_path / "out.mcap")
    return read_log(report.out), report


def assert_same(log, q=Q, dq=DQ, tau=TAU, atol=1e-15):
    assert np.array_equal(log.stamp_ns, np.round(TIME * 1e9).astype(np.int64))
    for ours, expected in ((log.q, q), (log.dq, dq), (log.tau, tau)):
        assert np.allclose(ours, expected, rtol=1e-15, atol=atol)


@pytest.mark.parametrize("delimiter", [",", " ", "\t", ";"])
def test_columns_by_place(tmp_path, delimiter):
    table = write(tmp_path / "t.txt", TABLE, delimiter)
    log, report = run(tmp_path, [table], COLUMNS)
    assert_same(log)
    assert report.warnings == []
    assert report.samples == ROWS
    assert report.rate_hz == pytest.approx(1000)
    assert log.metadata["imported"]["columns"]["q"] == ["1:3"]


def test_columns_by_name_and_pattern(tmp_path):
    header = "angle_b,stamp,angle_a,w_a,w_b,load_a,load_b"
    table = write(tmp_path / "t.csv", TABLE[:, [2, 0, 1, 3, 4, 5, 6]], header=header)
    log, _ = run(tmp_path, [table], "t=stamp,q=angle_a,angle_b,dq=w_*,tau=load_*")
    assert_same(log)


@pytest.mark.parametrize(("unit", "scale"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_units(tmp_path, unit, scale):
    factors = np.array([scale] + 4 * [180 / np.pi] + 2 * [1e3])
    table = write(tmp_path / "t.csv", TABLE * factors)
    log, report = run(tmp_path, [table], COLUMNS, f"q=deg,tau=mNm,time={unit}")
    assert_same(log, atol=1e-14)
    assert report.warnings == []


def test_one_value_a_line(tmp_path):
    files = {"time": TIME, "q": Q.ravel(), "dq": DQ.ravel(), "tau": TAU.ravel()}
    sources = [f"{name}={write(tmp_path / f'{name}.txt', v)}" for name, v in files.items()]
    assert_same(run(tmp_path, sources)[0])
    spec = ImportSpec.from_options(
        sources[1:], flat=True, period_s=1e-3, joint_names=JOINTS, overwrite=True
    )
    log = read_log(import_file(spec, tmp_path / "out.mcap").out)
    assert np.allclose(log.q, Q)
    assert log.stamp_ns[:3].tolist() == [0, 1_000_000, 2_000_000]


def test_npz(tmp_path):
    path = tmp_path / "m.npz"
    np.savez(path, times=TIME, phi=Q, velocities=DQ, torques=TAU, text="x")
    assert_same(run(tmp_path, [path], "q=phi")[0])
    with pytest.raises(DriverError, match=r"m\.npz: no array 'angles' for q; have: times, phi"):
        run(tmp_path, [path], "q=angles")
    with pytest.raises(DriverError, match=r"m\.npz: which column is q\?.*its arrays: times"):
        run(tmp_path, [path])


def test_missing_velocity_is_derived(tmp_path):
    table = write(tmp_path / "t.csv", TABLE)
    log, report = run(tmp_path, [table], "time=0,q=1:3,tau=5:7")
    assert np.allclose(log.dq[1:-1], DQ[1:-1], atol=1e-5)
    assert "no velocities; derived" in report.warnings[0]


@pytest.mark.parametrize(
    ("columns", "units", "sentence"),
    [
        ("time=0,q=1:9,dq=3:5,tau=5:7", "", "column 1:9 for q isn't there; it has 7 columns"),
        ("time=0,q=q1,dq=3:5,tau=5:7", "", "no column 'q1' for q; it has no header"),
        ("time=0,q=1:4,dq=3:5,tau=5:7", "", r"q has 3 columns for 2 joints \(a, b\)"),
        ("q=1:3,tau=5:7", "", r"which column is time\? .*its columns: 0 to 6"),
        ("time=0,q=1:3", "", r"which column is tau\?"),
        ("time=0:2,q=1:3,tau=5:7", "", "time has 2 columns, need 1"),
        ("time=0,position=1:3", "", "no signal 'position' for a column; have: time, q, dq, tau"),
        (COLUMNS, "q=grad", "no unit 'grad' for q; have: rad, deg"),
        (COLUMNS, "x=deg", "no signal 'x' for a unit"),
        ("3,time=0", "", "column '3' belongs to no signal; write SIGNAL=3"),
    ],
)
def test_wrong_choices_name_the_right_ones(tmp_path, columns, units, sentence):
    table = write(tmp_path / "t.csv", TABLE)
    with pytest.raises(DriverError, match=sentence):
        run(tmp_path, [table], columns, units)
    assert not (tmp_path / "out.mcap").exists()


def test_lengths_that_do_not_fit(tmp_path):
    time, q = write(tmp_path / "t.txt", TIME), write(tmp_path / "q.txt", Q[:-1])
    with pytest.raises(DriverError, match=r"q\.txt: q has 399 lines of 2 values for 400 samples"):
        run(tmp_path, [f"time={time}", f"q={q}", f"tau={q}"])
    with pytest.raises(DriverError, match=r"no file for tau.*add tau=FILE"):
        run(tmp_path, [f"time={time}", f"q={q}"])
    with pytest.raises(DriverError, match=r"nowhere\.txt: cannot be read: No such file"):
        run(tmp_path, [tmp_path / "nowhere.txt"])


def test_describe(tmp_path):
    table = TABLE.copy()
    table[100:, 0] += 0.06
    table[200, 1:] = table[199, 1:]
    table[300, 3] = np.nan
    run(tmp_path, [write(tmp_path / "t.csv", table)], COLUMNS)
    facts = describe(tmp_path / "out.mcap")
    assert facts["samples"] == ROWS
    assert facts["repeated_samples"] == 1
    assert facts["not_finite"] == 1
    assert facts["gaps"]["count"] == 1
    assert facts["gaps"]["first"][0]["length_s"] == pytest.approx(0.061)
    assert facts["period_ms"]["p50"] == pytest.approx(1.0)
    assert facts["topics"]["/joint_states"]["messages"] == ROWS
    assert not facts["truncated"]


def test_the_real_panda_log(tmp_path):
    folder = shared("data/panda_gaz2019")
    files = {"time": "time", "q": "positions", "dq": "velocity", "tau": "torques"}
    sources = [f"{s}={folder}/exciting_traj_{name}.txt" for s, name in files.items()]
    log, report = run(tmp_path, sources, joint_names=tuple(f"panda_joint{i}" for i in range(1, 8)))
    assert len(log) == 20544
    assert report.warnings == []
    assert np.array_equal(log.q.ravel(), np.loadtxt(folder / "exciting_traj_positions.txt"))
    facts = describe(report.out)
    assert 0.05 < facts["repeated_samples"] / facts["samples"] < 0.07
    assert facts["period_ms"]["max"] == pytest.approx(8.81, abs=0.01)


def test_the_real_lwr_log(tmp_path):
    names = tuple(f"lwr_{i}_joint" for i in range(7))
    log, report = run(tmp_path, [shared("data/lwr4/measurements_1.npz")], joint_names=names)
    assert len(log) == 5027
    assert ["cmd=target_positions" in said for said in report.warnings] == [True]
    assert report.rate_hz == pytest.approx(200, rel=1e-3)
