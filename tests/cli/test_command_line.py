"""The commands as a user gives them: a live run, its replay, and what is made of the results."""

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from adapter.cli import main
from adapter.model.model_file import load_model
from drivers.files.mcap import read_log, read_messages
from tests.helpers.robot_models import PANDA
from tests.helpers.ros_messages import assert_read_by_everybody, same

pytestmark = pytest.mark.alone

SECONDS = 4.0
KEYS = {"samples", "learned", "refused", "missed_deadlines", "tick_us", "lambda", "theta", "model"}


def command(*arguments: object) -> dict[str, Any]:
    """Run a command that writes figures; the figures."""
    assert main([str(a) for a in arguments]) == 0
    return json.loads(Path(arguments[arguments.index("--json") + 1]).read_text())  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """A live run on the simulated arm, in real time, with its processes."""
    folder = tmp_path_factory.mktemp("run")
    out = ("--out", folder, "--json", folder / "o.json", "--quiet")
    out += ("--checkpoint", folder / "c.npz")
    return folder, command("run", "--driver", "pybullet:panda", "--duration", SECONDS, *out)


def test_figures_of_a_run(run: tuple[Path, dict[str, Any]]) -> None:
    folder, figures = run
    assert figures.keys() >= KEYS
    assert figures["samples"] == figures["learned"] + sum(figures["refused"].values())
    assert figures["recorded"] == figures["samples"] >= 1000 * SECONDS
    assert figures["unrecorded"] == 0 and not figures["refused"].get("not_reached_learner")
    assert figures["lambda"]["converged_s"] < 3.0
    assert figures["lambda"]["identifiable_rank"] == 36
    assert max(figures["lambda"]["rotation_error_rad"]) < 1e-6
    assert figures["lambda"]["source"] == "reproduces the documentation"
    assert 25 <= figures["theta"]["base_parameters"] <= 43  # what these seconds told
    assert figures["theta"]["min_pseudo_inertia_eigenvalue"] > 0.0
    assert all(figures["tick_us"][name] > 0 for name in ("p50", "p99", "p99.9", "max"))
    assert {path.name for path in folder.iterdir()} >= {
        *("recording.mcap", "model.json", "model.urdf", "report.html", "truth.json")
    }


def test_replay_finds_what_the_live_run_found(run, tmp_path: Path) -> None:
    folder, live = run
    again = command(
        *("replay", folder / "recording.mcap", "--quiet", "--no-report"),
        *("--out", tmp_path, "--json", tmp_path / "o.json"),
    )
    for part in ("lambda", "theta"):
        assert again[part]["values"] == live[part]["values"]  # every bit
        assert again[part]["converged_s"] == live[part]["converged_s"]
    assert again["learned"] == live["learned"] and again["refused"] == live["refused"]


def test_the_recording_holds_everything(run) -> None:
    folder, figures = run
    log = read_log(folder / "recording.mcap")
    assert len(log) == figures["samples"] and not log.truncated
    assert log.commands is not None and len(log.commands.tau) >= 0.9 * len(log)
    assert log.metadata["config"]["pipeline"]["learner"]["mode"] == "moments"
    assert {"documented.json"} <= log.attachments.keys()
    assert log.topics["/estimates"].messages > 0  # how often is up to the machine


def test_every_program_reads_every_topic_of_it(run) -> None:
    """rosbags and mcap-ros2-support, without a filter; what they find is what we find."""
    folder, _ = run
    path = folder / "recording.mcap"
    topics = {"/joint_states", "/joint_commands", "/external_torques", "/external_wrench"}
    topics |= {"/estimates", "/timing", "/tf", "/tf_static", "/robot_description"}
    found = assert_read_by_everybody(path, topics)
    for topic, messages in found.items():
        ours = list(read_messages(path, topic))
        assert len(ours) == len(messages) == read_log(path).topics[topic].messages
        for mine, (at, theirs) in zip(ours, messages, strict=True):
            assert mine.stamp_ns == at and same(mine.fields, theirs)
    frames = {x["child_frame_id"] for _, m in found["/tf"] for x in m["transforms"]}
    assert {"documented/panda_link7", "learned/panda_link7"} <= frames
    model = load_model(folder / "model.json")
    _, last = found["/estimates"][-1]
    assert [x["name"] for x in last["joints"]] == list(model.tree.joint_names)
    ticks = found["/timing"][-1][1]["ticks"]
    assert 0 < ticks <= len(found["/joint_states"])
    assert min(m["tick_us"]["p50"] for _, m in found["/timing"]) > 0.0


def test_export(run, tmp_path: Path) -> None:
    folder, _ = run
    urdf = tmp_path / "arm.urdf"
    facts = command(
        *("export", folder / "model.json", "--urdf", urdf, "--mjcf", tmp_path / "arm.xml"),
        *("--json", tmp_path / "facts.json"),
    )
    assert facts["onto"] == "panda.urdf" and facts["mjcf"] == str(tmp_path / "arm.xml")
    assert urdf.read_text().startswith(PANDA.read_text()[:500])
    assert {"lambda_filled", "theta_filled"} <= facts.keys()
    assert facts["lambda_source"] == "reproduces the documentation"
    model = load_model(folder / "model.json")
    exported = pin.buildModelFromUrdf(str(urdf))
    masses = [exported.inertias[k + 1].mass for k in range(7)]
    assert np.allclose(masses, model.theta[:, 0])


def test_samples_of_a_learned_model_are_arms_that_mujoco_loads(run, tmp_path: Path) -> None:
    folder, _ = run
    line = ("export", folder / "model.json", "--samples", 20, "--seed", 3, "--json", tmp_path / "j")
    command(*line, "--mjcf", tmp_path / "mjcf", "--urdf", tmp_path / "urdf")
    drawn = load_model(folder / "model.json").sample(20, seed=3)
    for kind, suffix in (("mjcf", "xml"), ("urdf", "urdf")):
        files = sorted((tmp_path / kind).iterdir())
        assert [x.name for x in files] == [f"{k:04d}.{suffix}" for k in range(20)]
        for file, one in zip(files, drawn, strict=True):
            arm = mujoco.MjModel.from_xml_path(str(file))
            masses = [arm.body(name).mass[0] for name in one.tree.link_names]
            assert np.allclose(masses, one.theta[:, 0], rtol=1e-9)


def test_info_recover_and_report(run, tmp_path: Path, capsys) -> None:
    folder, figures = run
    facts = command("info", folder / "recording.mcap", "--json", tmp_path / "i.json")
    assert facts["samples"] == figures["samples"]
    facts = command("info", folder / "model.json", "--json", tmp_path / "m.json")
    assert facts["lambda_source"] == "reproduces the documentation"
    told = capsys.readouterr().out
    assert "λ          reproduces the documentation" in told and "kg, link by link" in told
    assert "{" not in told and "'" not in told
    cut = tmp_path / "cut.mcap"
    whole = (folder / "recording.mcap").read_bytes()
    cut.write_bytes(whole[: len(whole) // 2])
    facts = command("recover", cut, "--json", tmp_path / "r.json")
    assert not facts["was_whole"] and len(read_log(facts["mended"])) > 1000
    page = tmp_path / "page.html"
    command("report", folder, "--html", page, "--json", tmp_path / "p.json")
    assert page.read_text().lower().startswith("<!doctype html>")


def test_resume_goes_on(run, tmp_path: Path) -> None:
    folder, first = run
    second = command(
        *("run", "--duration", 1.0, "--no-record", "--resume", folder / "c.npz"),
        *("--out", tmp_path, "--quiet", "--no-report", "--json", tmp_path / "o.json"),
    )
    assert second["learned"] > 700 + first["learned"]


def test_bench(tmp_path: Path) -> None:
    figures = command("bench", "--repeats", 5, "--json", tmp_path / "b.json")
    for what in ("our update", "autograd"):
        assert any(what in row["what"] and row["p50_us"] > 0 for row in figures["rows"])


def test_bench_on_a_log(tmp_path: Path) -> None:
    log = Path(__file__).parents[2] / "recordings" / "panda_nominal_6s.mcap"
    options = ("--validate-from", 3.5, "--json", tmp_path / "b.json", "--only")
    ways = command("bench", "--log", log, *options, "adapter replay", "least squares")["ways"]
    assert [max(way["torque_nm"]) < 0.2 for way in ways] == [True, True]
