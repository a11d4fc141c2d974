"""`adapter experiment` from simulation to page, on fewer and shorter falls than the paper's."""

from __future__ import annotations

import json
import shlex
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from adapter.cli import main
from adapter.experiments.baselines.compare import Choice, Errors, compare
from adapter.experiments.baselines.paper import ElmCommittee
from adapter.experiments.command import run_panda
from adapter.experiments.falls import SETS, split
from adapter.experiments.results import LearnerScores
from tests.helpers.pages import every_command

CHANNELS = {"w", "v", "a", "dw"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the pages' small experiment left its results; in three trials of `discover`."""
    place = tmp_path_factory.mktemp("experiment")
    line = next(x for x in every_command() if x.startswith("adapter experiment atlas --"))
    small = shlex.split(line)[1:]
    small += ["--seed", "4", "--seeds", "3"]
    where = ["--cache", str(place / "cache"), "--out", str(place), "--json", str(place / "e.json")]
    assert main([*small, *where]) == 0
    return place


def test_numbers_of_the_humanoid(folder: Path) -> None:
    found = json.loads((folder / "e.json").read_text())["atlas"]
    assert found["joints"] == 30 and found["learned_samples"] == 60
    errors = found["kinematic_error_max"]
    assert set(errors) == CHANNELS and 0.0 < max(errors.values()) < 1e-6
    for name in SETS:
        assert 0.0 < found["torque_relative_error_median"][name] < 1e-6
        assert 0.0 < found["torque_relative_error_p99"][name] < 1e-3
    assert found["min_pseudo_inertia_eigenvalue"] > 0.0
    assert found["base_parameters"] == 220
    names = {stage["name"] for stage in found["sub_problems"]}
    assert {"left leg", "right leg", "upper body"} <= names
    assert 0.5 < found["noise"]["ratio"] < 1.5
    assert found["best_baseline"] is None
    assert found["online"]["samples_per_second"] > 0.0
    trees = found["discover"]
    assert trees["right"] == trees["trials"] == 3 and trees["measured"] == "w, a"
    assert trees["most_confidence_wrong"] == 0.0 < 0.9 < trees["least_confidence_right"]
    page = (folder / "experiment.html").read_text()
    assert page.count("<svg") > 6 and "500 000" in page and "epoch 50" in page


def test_the_row_fop_networks_is_that_of_the_papers_mini_batches(folder: Path) -> None:
    """Of 60 samples they do not find every frame, and their torques show it; moments' do not."""
    found = json.loads((folder / "e.json").read_text())["atlas"]
    learners, stated = found["learners"], {row["key"]: row for row in found["stated"]}
    assert found["schema_networks_not_converged"]
    assert max(found["kinematic_error_max_networks"].values()) > 1e-3
    networks, moments = learners["FOPnet"], learners["FOPnet, moments"]
    assert networks["median"] == found["torque_relative_error_median_networks"]
    assert moments["median"] == found["torque_relative_error_median"]
    assert networks["median"]["control"] > 1e-4 > moments["median"]["control"]
    assert stated["torque_median_control"]["ours"] == networks["median"]["control"]
    assert stated["torque_median_moments"]["ours"] == moments["median"]["control"]
    assert networks["train_s"] == pytest.approx(found["schema_networks_s"] + found["theta_s"])
    assert stated["learning_s"]["ours"] == found["learning_s"] == networks["train_s"]
    assert (stated["arm"]["ours"], stated["minibatch"]["ours"]) == ("24 to 30", "10; 10")


def test_the_arm_learns_as_the_paper_s_and_sooner() -> None:
    found = run_panda(seed=1, duration_s=9.0, topologies=1)
    assert 0.0 < found.numbers["lambda_converged_s"] < 5.0
    assert found.numbers["rate_hz"] == pytest.approx(1000.0, rel=1e-3)
    assert found.numbers["discover"]["right"] == 1
    assert found.lam.shape[1:] == (7, 6) and found.theta.shape[1:] == (7, 10)
    assert found.numbers["min_pseudo_inertia_eigenvalue"] > 0.0


def test_learners_are_compared_on_every_set() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(600, 4))
    y = np.stack([np.sin(x[:, 0]) + 2.0, x[:, 1] * x[:, 2] + 3.0], axis=1)
    sets = {name: (x[k::3], y[k::3]) for k, name in enumerate(SETS)}
    said: list[str] = []
    small = Choice(
        "ELM",
        "A small committee",
        partial(ElmCommittee, members=2, units=60, points=150),
        ({"ridge": 1e-9}, {"ridge": 1e3}),
        {"units": 40},
    )
    (learned,) = compare(sets, [small], 0, said.append)
    assert "training: A small committee" in said
    assert learned.selection["chosen"] == {"ridge": 1e-9}
    assert "50 shuffled samples held out" in learned.tuning[-1]
    assert "ridge 1e-09" in learned.tuning[-1]
    for name in sets:
        assert learned.boxes[name].shape == (2, 5)
        assert 1e-4 < learned.median[name] < 0.2
        assert (learned.rmse[name] < 0.5 * y.std(axis=0) + 0.3).all()
    assert learned.median["train"] < learned.median["control"]


def test_errors_by_hand() -> None:
    tau = np.array([[1.0, 0.05], [-2.0, 0.1], [4.0, -0.02], [0.1, 0.0], [5.0, 0.0]])
    estimate = np.array([[1.0, 0.04], [-1.0, 0.0], [8.0, 0.0], [9.0, 0.0], [-5.0, 0.0]])
    errors = Errors(2)
    errors.add("test", tau[:2], estimate[:2])
    errors.add("test", tau[2:], estimate[2:])
    found = errors.into(LearnerScores("x", "x"))
    # Relative errors 0, 0.5, 0.5, 2: the fourth sample is not above 0.1 N m.
    np.testing.assert_allclose(found.boxes["test"][0], [0.075, 0.375, 0.5, 0.875, 1.775])
    assert np.isnan(found.boxes["test"][1]).all()
    assert found.median["test"] == 0.5
    assert found.p99["test"] == pytest.approx(np.percentile([0.0, 0.5, 0.5, 2.0], 99))
    squares = [0.0 + 1.0 + 16.0 + 8.9**2 + 100.0, 0.01**2 + 0.1**2 + 0.02**2]
    np.testing.assert_allclose(found.rmse["test"], np.sqrt(np.array(squares) / 5))
    assert "train" not in found.median


def test_split_is_the_paper_s() -> None:
    parts = split(63 * [10_000], seed=3)
    assert len(parts.lengths) == 50 and len(parts.control) == 13
    assert len(parts.train) == 375_000 and len(parts.test) == 125_000
    assert len(parts.learned) == 3750
    assert len(np.intersect1d(parts.train, parts.test)) == 0
    own = parts.rows_in(parts.train, 7)
    assert np.isin(own + 70_000, parts.train).all() and own.max() < 10_000


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (["--trajectories", "2"], "at least 5"),
        (["--trajectories", "5", "--seconds", "0.5"], "raise --trajectories or --seconds"),
        (["--seconds", "inf"], "above 0 and finite"),
        (["--seed", "-1"], "--seed and --seeds must be 0 or more"),
        (["--json", "/dev/null/e.json"], "/dev/null"),
        (["--out", "/dev/null/results"], "/dev/null"),
        (["--cache", "/dev/null/falls"], "/dev/null"),
    ],
)
def test_what_would_end_it_is_said_before_the_work(
    wrong: list[str], said: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    usual = ["--out", str(tmp_path / "out"), "--cache", str(tmp_path / "cache")]
    assert main(["experiment", "atlas", *usual, *wrong]) == 2
    assert said in "".join(capsys.readouterr())
    assert not list(tmp_path.glob("cache/*"))  # nothing was simulated
