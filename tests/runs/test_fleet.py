"""Fleets: moments that add up exactly, loads, drifts, logs that disagree, stores that go on."""

from __future__ import annotations

import csv
import os
import shutil
import signal
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapter.errors import MeansError, SettingsError
from adapter.model import model_file
from adapter.physics.identifiability import base_parameters
from adapter.report.fleet_page import summary, write_fleet_page
from adapter.runs.config import PipelineSettings
from adapter.runs.fleet import fleet as fleets
from adapter.runs.fleet.arm import FleetArm, learn_arm
from adapter.runs.fleet.course import Drift, Series, StandsOut, courses
from adapter.runs.fleet.fleet import (
    AT_HAND,
    Fleet,
    Settings,
    forget,
    found_logs,
    here,
    learn_fleet,
    on_cluster,
    read_manifest,
)
from adapter.runs.fleet.moments import Broken, LogMoments, Task, learner_of, moments_of
from adapter.runs.pipeline import make_front_end
from drivers.files.mcap import read_log, write_log
from sim.effects import per_joint
from sim.scenarios import build
from sim.truth import Truth
from tests.helpers.arm_data import Motion, panda_model, record, rubbing
from tests.helpers.gap_effects import regressor
from tests.helpers.robot_models import entry

# The log with a load; joint (from 1) whose friction grows; another arm.
LOADED, WORN, OTHER = 2, 3, 6
LOGS, MASS, WEAR = 6, 1.2, 0.05  # N m s/rad a day


def truth_on(day: int) -> Truth:
    """The arm as it is on a day: the friction of one joint grows."""
    worn = per_joint("viscous_friction", "Fv", [WEAR * day * (j == WORN - 1) for j in range(7)])
    truth = rubbing(0.3, 0.2)
    truth = truth.with_changes(effects=(*truth.effects, *worn))
    if day == LOADED:
        (load,) = build("payload_at_20s", mass=MASS, t_s=0.0).truth.effects
        truth = truth.with_changes(effects=(*truth.effects, replace(load, interval_s=None)))
    return truth


def write(path: Path, truth: Truth, day: int, arm: str | None = None, seconds: float = 8.0) -> Path:
    data = record(truth, Motion(seconds, 50 + day))
    log = replace(data.log(), stamp_ns=day * 86_400 * 10**9 + data.stamp_ns + 1)
    write_log(log, path, {} if arm is None else {"serial": arm})
    return path


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six days of one arm, one log of another, one that is broken."""
    folder = tmp_path_factory.mktemp("logs")
    for day in range(LOGS):
        write(folder / f"day{day}.mcap", truth_on(day), day, "A-1")
    (folder / "other").mkdir()
    write(folder / "other" / "log.mcap", rubbing(0.1, 0.05), OTHER, "B-2")
    (folder / "other" / "cut.mcap").write_bytes(b"\x89MCAP0\r\n not a recording")
    return folder


def taken(path: Path) -> LogMoments:
    found = moments_of(Task(str(path), model_file.dumps(panda_model())))
    assert isinstance(found, LogMoments)
    return found


@pytest.fixture(scope="module")
def fleet(logs: Path, tmp_path_factory: pytest.TempPathFactory) -> Fleet:
    out = tmp_path_factory.mktemp("fleet")
    return learn_fleet(found_logs([str(logs)]), panda_model(), Settings(out, workers=2))


def the_arm(found: Fleet) -> FleetArm:
    return next(arm for arm in found.arms if arm.name == "A-1")


def off(ours: FleetArm, theirs: FleetArm) -> float:
    """Largest difference of two solutions in standard deviations."""
    outcome = theirs.outcome
    std = np.r_[np.sqrt(outcome.covariance.diagonal()), np.zeros(10), outcome.effects_std.ravel()]
    known = std > 0.0
    return float(np.max(np.abs(ours.solution - theirs.solution)[known] / std[known]))


def test_a_law_that_only_some_arms_have_is_told(tmp_path: Path) -> None:
    model = replace(panda_model(), effects=(entry("law: dq³", [2], c=1.0),))
    for name, c in (("A", 2.0), ("B", 0.0)):
        data = record(rubbing(0.3, 0.2), Motion(8.0, 50))
        data = replace(data, tau=data.tau + c * data.true[1] ** 3 * np.eye(7)[1])
        write_log(data.log(), tmp_path / f"{name}.mcap", {"serial": name})
    found = learn_fleet(found_logs([str(tmp_path)]), model, Settings(tmp_path, workers=0))
    _, said = summary(found)
    assert said.startswith("Not all arms have a torque of c dq³ on joint 2 (N m s³/rad³): A has (")
    page = write_fleet_page(found, tmp_path / "page.html").read_text()
    assert ", B not (" in said and said in page


def test_logs_are_told_apart_and_broken_ones_said(fleet: Fleet) -> None:
    assert [(arm.name, len(arm.logs)) for arm in fleet.arms] == [("A-1", LOGS), ("B-2", 1)]
    (broken,) = fleet.broken
    assert broken.path.endswith("cut.mcap") and broken.why
    assert fleet.read == LOGS + 1 and fleet.known == 0
    assert all(log.worth > 0.0 and not log.disagrees for log in the_arm(fleet).logs)


def test_the_load_of_one_log_is_weighed(fleet: Fleet) -> None:
    loads = [log.load for log in the_arm(fleet).logs]
    assert [x is not None for x in loads] == [day == LOADED for day in range(LOGS)]
    load = loads[LOADED]
    assert abs(load.mass - MASS) < max(4.0 * load.std, 0.05 * MASS)


def test_friction_that_grows_is_named(fleet: Fleet) -> None:
    (first, *more) = the_arm(fleet).drifts
    assert (first.effect, first.joint, first.follows) == ("viscous_friction", WORN, "time")
    assert abs(first.slope - WEAR) < max(4.0 * first.std, 0.1 * WEAR)
    assert not more


def oracle_moments(paths: Sequence[Path]) -> LogMoments:
    """All samples of some recordings in one pass: Pinocchio's regressor, numpy's product."""
    model = panda_model()
    truth = rubbing(0.3, 0.2)  # its frames are the documented ones
    theta = learner_of(model).theta
    states, gain = [], 0.0
    for path in reversed(paths):
        front_end = make_front_end(model, PipelineSettings(learner=learner_of(model).settings))
        log = read_log(path)
        states.append(front_end.step_table(log.stamp_ns, log.q, log.dq, log.tau))
        gain = front_end.filter.noise_gain
    table, at = np.concatenate(states), theta.layout
    Y = regressor(truth, table[:, at.q], table[:, at.dq], table[:, at.ddq])
    effects, tau = theta.effect_columns(table), table[:, at.joint_tau]
    A = theta.moments.A.copy()
    for j, size in enumerate(theta.rows.sizes):
        bodies = theta.rows.place[j, : size - theta.columns]
        Z = np.column_stack([Y[:, j][:, bodies], effects[:, :, j], tau[:, j]])
        upper = np.triu_indices(size + 1)
        A[theta.rows.starts[j] :][: len(upper[0])] = (Z.T @ Z)[upper]
    samples = len(table)
    return LogMoments("0", "all", "A-1", 0.0, 0.0, samples, samples / gain, A / gain)


def test_sums_are_those_of_one_pass(fleet: Fleet, logs: Path, tmp_path: Path) -> None:
    """All that torques show of θ, and the effects, against an oracle that sums all samples itself.

    What they do not show is the documentation's in the model, whatever the sums.
    """
    paths = [logs / f"day{day}.mcap" for day in (0, 1)]
    model = panda_model()
    ours = learn_fleet([*map(str, paths)], model, Settings(tmp_path, workers=0)).arms[0]
    once = learn_arm("A-1", [oracle_moments(paths)], model)
    basis = base_parameters(model.tree, model.lam, model.gravity).basis
    of_effects = np.eye(len(ours.solution))[:, 80:]
    shown = np.column_stack([np.vstack([basis, np.zeros((len(of_effects) - 70, 43))]), of_effects])
    of_basis = np.sqrt(np.einsum("ab,ac,cb->b", basis, ours.outcome.covariance, basis))
    std = np.concatenate([of_basis, ours.outcome.effects_std.ravel()])
    apart = np.abs(shown.T @ (ours.solution - once.solution)) / std
    assert np.max(apart) < 1e-9
    sure = ours.model.theta_std > 1e-6  # below that is what rounding leaves of a zero
    apart = np.abs(ours.model.theta - once.model.theta)[sure] / ours.model.theta_std[sure]
    assert np.max(apart) < 1e-5  # a conic solver has looked for possible bodies


def test_neither_workers_nor_order_nor_parts_matter(
    fleet: Fleet, logs: Path, tmp_path: Path
) -> None:
    """One process, logs in two parts and another order: the same to the last bit."""
    given = found_logs([str(logs / "day*.mcap")])
    alone = Settings(tmp_path, workers=0)
    learn_fleet(given[3:], panda_model(), alone)
    whole = learn_fleet([*reversed(given[:3]), given[4]], panda_model(), alone)
    assert (whole.read, whole.known) == (3, 3)
    assert off(the_arm(whole), the_arm(fleet)) == 0.0


def test_forgetting_is_exact_and_lasts(logs: Path, tmp_path: Path) -> None:
    bad, *rest = found_logs([str(logs / "day*.mcap")])
    settings = Settings(tmp_path / "all", workers=0)
    learn_fleet([bad, *rest], panda_model(), settings)
    forget([bad], panda_model(), settings)
    after = learn_fleet([bad, *rest], panda_model(), settings)
    assert after.forgotten == (bad,) and after.read == 0
    never = learn_fleet(rest, panda_model(), Settings(tmp_path / "rest", workers=0))
    assert off(the_arm(after), the_arm(never)) == 0.0


def test_nothing_is_computed_twice_and_damage_is_mended(logs: Path, tmp_path: Path) -> None:
    settings = Settings(tmp_path / "out", workers=0)
    first = str(logs / "day0.mcap")
    copy = shutil.copy(first, tmp_path / "copy.mcap")
    found = learn_fleet([first, str(copy)], panda_model(), settings)
    assert found.read == 1 and found.alike == ((str(copy), first),)
    assert learn_fleet([first], panda_model(), settings).read == 0
    (kept,) = (tmp_path / "out" / "moments").glob("*.npz")
    kept.write_bytes(kept.read_bytes()[:1000])
    assert not learn_fleet([], panda_model(), settings).arms
    assert learn_fleet([first], panda_model(), settings).read == 1
    heavier = replace(panda_model(), theta=1.1 * panda_model().theta)
    assert learn_fleet([first], heavier, settings).read == 1  # another model, other moments


def test_another_arm_among_the_logs_disagrees(logs: Path, tmp_path: Path) -> None:
    """Whose links are another unit's: the model is that of the five logs which agree."""
    moments = [taken(logs / f"day{day}.mcap") for day in (0, 1, 3, 4, 5)]
    heavy = truth_on(1)
    heavy = heavy.with_changes(theta=heavy.theta * np.linspace(0.6, 1.5, 7)[:, None])
    moments.append(taken(write(tmp_path / "x.mcap", heavy, 9, "A-1")))
    found = learn_arm("A-1", moments, panda_model())
    assert [bool(log.disagrees) for log in found.logs] == [False] * 5 + [True]
    assert [log.used for log in found.logs] == [True] * 5 + [False]
    assert off(found, learn_arm("A-1", moments[:5], panda_model())) == 0.0


def test_a_manifest_tells_arms_and_temperature(logs: Path, tmp_path: Path) -> None:
    table = tmp_path / "logs.csv"
    with table.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["log", "arm", "temperature", "who"])
        for day in range(LOGS):
            rows.writerow([logs / f"day{day}.mcap", "left", 20 + 3 * day, "Ada"])
    manifest = read_manifest(table)
    given = found_logs([str(logs / "day*.mcap")])
    found = learn_fleet(given, panda_model(), Settings(tmp_path, workers=0, manifest=manifest))
    (arm,) = found.arms
    assert arm.name == "left"
    ((joint, follows),) = {(x.joint, (x.follows, *x.rivals)) for x in arm.drifts}
    assert joint == WORN and set(follows) == {"time", "temperature"}  # which of them nobody can say
    table.write_text("recording,arm\na.mcap,left\n")
    with pytest.raises(SettingsError, match="log, path, file"):
        read_manifest(table)


def test_what_is_no_recording_is_said(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="no recording there"):
        found_logs([str(tmp_path)])
    missing = moments_of(Task(str(tmp_path / "none.mcap"), model_file.dumps(panda_model())))
    assert isinstance(missing, Broken) and "No such file" in missing.why


def dies_at_first(task: Task) -> int:
    """Ends its process once, or always; keeps account of what was done."""
    place = Path(task.path)
    with (place.parent / "done").open("a") as file:
        file.write(f"{place.name}\n")
    if place.name == "poison":
        os._exit(9)
    if place.name == "weak" and not place.exists():
        place.touch()
        os._exit(9)
    return 7


def test_a_worker_that_dies_costs_time_only(tmp_path: Path) -> None:
    """And a task that always kills it is given up; only what was at hand is done again."""
    names = ["weak", "poison", *map(str, range(20))]
    tasks = {name: Task(str(tmp_path / name), "") for name in names}
    done = dict(here(dies_at_first, list(tasks.values()), 2))
    lost = done.pop(tasks.pop("poison"))
    assert isinstance(lost, Broken) and "died" in lost.why
    assert done == dict.fromkeys(tasks.values(), 7)
    times = Counter((tmp_path / "done").read_text().split())
    assert sum(times[str(k)] - 1 for k in range(20)) <= 2 * AT_HAND * 2


def test_a_cluster_gives_the_same_though_a_worker_is_killed(
    fleet: Fleet, logs: Path, tmp_path: Path
) -> None:
    """A real Dask scheduler and two worker processes; one is killed as the first result is in."""
    distributed = pytest.importorskip("distributed", reason="the extra [cluster] is not installed")
    given = found_logs([str(logs / "day*.mcap")])
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0"
    ) as cluster:
        pids = [worker.pid for worker in cluster.workers.values()]

        def kill_one(done: int, whole: int) -> None:
            if done == 1:
                os.kill(pids[0], signal.SIGKILL)

        address = cluster.scheduler_address
        settings = Settings(tmp_path, cluster=address, progress=kill_one)
        found = learn_fleet(given, panda_model(), settings)
    assert not found.broken and found.read == LOGS
    assert off(the_arm(found), the_arm(fleet)) == 0.0


def test_an_address_is_fetched_once(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For its content and its moments, and not again while its mark there is the same."""
    fsspec = pytest.importorskip("fsspec", reason="the extra [cluster] is not installed")
    memory, fetched = fsspec.filesystem("memory"), []
    memory.pipe("/fleet/a/one.mcap", (logs / "day0.mcap").read_bytes())
    memory.pipe("/fleet/a/notes.txt", b"no recording")
    get = type(memory).get
    monkeypatch.setattr(
        type(memory), "get", lambda *x, **y: (fetched.append(x[1]), get(*x, **y))[1]
    )
    settings, address = Settings(tmp_path, workers=0), "memory://fleet"
    for _ in range(2):
        (log,) = learn_fleet(found_logs([address]), panda_model(), settings).arms[0].logs
    assert log.moments.path == "memory:///fleet/a/one.mcap" and len(fetched) == 1
    assert found_logs(["memory://fleet/*/*.mcap"]) == [log.moments.path]
    memory.pipe("/fleet/a/one.mcap", (logs / "day1.mcap").read_bytes())
    assert learn_fleet(found_logs([address]), panda_model(), settings).read == 1
    with pytest.raises(SettingsError, match="no recording there"):
        found_logs(["memory://nothing"])


def test_a_log_that_has_grown_counts_once(logs: Path, tmp_path: Path) -> None:
    """It was read while it was still being recorded, and moved since; then it is forgotten."""
    whole, settings = logs / "day0.mcap", Settings(tmp_path / "out", workers=0)
    growing = tmp_path / "growing.mcap"
    growing.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    short = learn_fleet([str(growing)], panda_model(), settings).arms[0]
    shutil.copy(whole, growing)
    (long,) = learn_fleet([str(growing)], panda_model(), settings).arms[0].logs
    assert long.moments.samples > short.logs[0].moments.samples
    moved = growing.rename(tmp_path / "moved.mcap")
    (same,) = learn_fleet([str(moved)], panda_model(), settings).arms[0].logs
    assert same.moments.path == str(moved)
    moved.unlink()
    forget([str(moved)], panda_model(), settings)
    left = [x for arm in learn_fleet([], panda_model(), settings).arms for x in arm.logs]
    assert all(x.moments.content != same.moments.content for x in left)
    forget([str(moved)], panda_model(), settings, back=True)
    shutil.copy(whole, moved)
    assert learn_fleet([str(moved)], panda_model(), settings).read == 1


def test_nobody_answers_at_the_address(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed", reason="the extra [cluster] is not installed")
    monkeypatch.setattr(fleets, "ANSWER_S", 1.0)
    with pytest.raises(MeansError, match="no Dask scheduler there"):
        list(on_cluster(moments_of, [Task("x", "")], "tcp://127.0.0.1:1"))


PARAMETERS = 28  # of seven joints


def drawn(
    size: int, seed: int, drift: float = 0.0, off: float = 0.0, warm: float = 0.0
) -> tuple[list[Drift], list[StandsOut]]:
    """Parameters whose standard deviations are wrong by a factor; the first ones are moved.

    Args:
        drift, warm: of the first one over all time and temperature, off: of the second one in the
            first recording, all in standard deviations of the scatter.
    """
    rng = np.random.default_rng([seed, size])
    time = np.sort(rng.uniform(0.0, 30.0, size))
    columns = {"time": time, "temperature": 20.0 + 10.0 * rng.uniform(size=size)}
    series = []
    for k in range(PARAMETERS):
        own = rng.lognormal(0.0, 0.5) if k else 1.0
        std = np.full(size, 3.0 * own)  # three times what they scatter
        values = 5.0 + own * rng.standard_normal(size)
        if k == 0:
            values += own * (drift * time / 30.0 + warm * (columns["temperature"] - 20.0) / 10.0)
        if k == 1:
            values[0] += off * own
        series.append(Series(f"p{k}", 1, values, std))
    return courses(series, columns)


def test_where_nothing_drifts_hardly_anything_is_said_to() -> None:
    """One arm in a hundred may: of 150, more than eight would be 1 in 10 000."""
    found = [drawn(8, seed) for seed in range(150)]
    assert sum(bool(drifts) for drifts, _ in found) <= 8
    assert sum(bool(out) for _, out in found) <= 8


@pytest.mark.parametrize("size", [8, 30])
def test_what_drifts_is_found_with_its_slope(size: int) -> None:
    found = [drawn(size, seed, drift=15.0)[0] for seed in range(20)]
    named = [x for drifts in found for x in drifts if x.effect == "p0"]
    assert len(named) >= 18 and all(x.follows == "time" for x in named)
    off = np.array([(30.0 * x.slope - 15.0) / (30.0 * x.std) for x in named])
    assert np.mean(np.abs(off) < 3.0) > 0.9 and np.sqrt(np.mean(off**2)) < 2.0


def test_temperature_is_told_from_time() -> None:
    found = [drawn(12, seed, warm=15.0)[0] for seed in range(20)]
    named = [x for drifts in found for x in drifts if x.effect == "p0"]
    assert len(named) >= 18
    assert sum(x.follows == "temperature" and not x.rivals for x in named) >= 17


def test_columns_that_go_together_are_rivals() -> None:
    time = np.arange(10.0)
    rng = np.random.default_rng(0)
    flat = [Series(f"p{k}", 1, rng.normal(size=10), np.ones(10)) for k in range(6)]
    rising = Series("worn", 1, 3.0 * time + rng.normal(size=10), np.ones(10))
    (drift,), out = courses([*flat, rising], {"time": time, "age": 2.0 * time + 1.0})
    assert {drift.follows, *drift.rivals} == {"time", "age"} and not out


def test_one_that_stands_out_is_named_and_hides_no_drift() -> None:
    found = [drawn(12, seed, drift=15.0, off=15.0) for seed in range(20)]
    named = [[(x.effect, x.number) for x in out] for _, out in found]
    assert sum(("p1", 0) in x for x in named) >= 18
    assert all(x.count(("p1", 0)) <= 1 for x in named)
    assert all(abs(x.expected - 5.0) < 6.0 for _, out in found for x in out)


def test_a_few_numbers_say_nothing() -> None:
    four = Series("p", 1, np.arange(4.0), np.ones(4))
    assert courses([four], {"time": np.arange(4.0)}) == ([], [])
    nobody_told = {"time": np.zeros(9), "temperature": np.full(9, np.nan)}
    nine = Series("p", 1, np.arange(9.0), np.ones(9))
    assert courses([nine], nobody_told) == ([], [])
