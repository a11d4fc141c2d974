"""The run folder and its report: whole, self-contained, honest about what is missing."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from adapter.cli.main import build_parser
from adapter.control.controller import ExcitationController
from adapter.control.limits import MotionLimits
from adapter.control.settings import ExcitationSettings
from adapter.learning.settings import LearnerSettings
from adapter.model.robots import documented
from adapter.physics.rigid_arm import RigidArm
from adapter.realtime.session import run_lockstep
from adapter.report import render, write_report
from adapter.report.learned_panels import bodies_over_time, rotation_path
from adapter.report.next_steps import _again, next_steps
from adapter.report.style import thin
from adapter.report.trust import headline
from adapter.report.words import REFUSALS
from adapter.report.worth import SLOW, Worth, slow_share, torque_fall, truth_tables
from adapter.runs.config import PipelineSettings
from adapter.runs.outcome import collect
from adapter.runs.pipeline import Pipeline
from adapter.runs.run_folder import RunData, RunFolderError, load_run, run_data, save_run
from adapter.runs.score import Course, figures, reference_from
from adapter.signals.checks import Verdict
from sim.plant import SimulatedArm
from sim.scenarios import build
from tests.helpers.browser import ids_of_a_whole_page, laid_out, shown_without_complaint, text_of

PERCENTILES = {"p50": 90.0, "p99": 140.0, "p99.9": 200.0, "max": 900.0}
SECTIONS = (  # worth, trust, what to do; then details in the order in which they are of use
    "worth trust next fit joints identifiability prequential dynamics schema skeleton samples "
    "provenance"
)


def a_run(duration_s: float, **more) -> RunData:
    """A few seconds of the simulated arm, learned in lockstep."""
    robot = documented("panda")
    settings = PipelineSettings(learner=LearnerSettings(effects=("viscous_friction",)))
    pipeline = Pipeline(robot, settings)
    controller = ExcitationController(MotionLimits.of(robot), ExcitationSettings(seed=5))
    arm = SimulatedArm(build("nominal", 5).plant())
    run = run_lockstep(arm, pipeline.front_end, pipeline.learner, controller, duration_s)
    outcome, front_end = collect(pipeline.learner), pipeline.front_end
    reference = reference_from(None, robot)
    times = {"delay_s": front_end.delay_s, "first_moving_ns": front_end.first_moving_ns}
    course = Course(run.samples, front_end.refused, **times)
    told = figures(outcome, robot, reference, course, **more)
    return run_data(outcome, robot, told, reference, **times, program="0.1.0", documented="panda")


@pytest.fixture(scope="module")
def data() -> RunData:
    return a_run(5.0)


@pytest.fixture(scope="module")
def page(data: RunData) -> str:
    return render(data)


def with_figures(data: RunData, **more) -> RunData:
    return replace(data, figures={**data.figures, **more})


def test_page_has_all_sections_is_small_and_fetches_nothing(page: str, data: RunData) -> None:
    ids = ids_of_a_whole_page(page, SECTIONS)
    assert set(re.findall(r'(?:href="|url\()#([\w-]+)', page)) <= set(ids)
    # what it is worth; 4 of λ, 3 views, 7 bodies and 1 effect, 2 prequential, 7 joints
    assert page.count("<svg") == 1 + 4 + 3 + 7 + 1 + 2 + 7
    for absent in ('id="timing"', 'id="changes"', 'id="tracking"', 'id="warnings"', "eadlines"):
        assert absent not in page
    assert "36 of 42 directions" in page
    rank = data.figures["theta"]["base_parameters"]  # 43 can be told by any motion
    assert 30 <= rank <= 43 and f"{rank} combinations of 70 parameters" in page


def test_lambda_says_where_it_comes_from(data: RunData, page: str) -> None:
    assert page.count("reproduces the documentation") >= 4
    measured = with_figures(data, **{"lambda": {**data.figures["lambda"], "source": "measured"}})
    measured = replace(measured, model=replace(data.model, lambda_source="measured"))
    text = render(measured)
    assert "reproduces the documentation" not in text
    assert text_of(text).count("measured") >= 5
    assert "of the joints" in text or "where the documentation puts them" in text


def test_optional_parts_appear_when_the_run_has_them(data: RunData) -> None:
    change = {
        "stamp_s": data.start_s + 3.0,
        "payload": {"m": 0.3, "m_std": 0.002, "cx": 0.02, "cy": 0.0, "cz": 0.15},
    }
    error = {"samples": 1000, "rms_rad": [0.01] * 7, "max_rad": [0.03] * 7}
    better = {"samples": 1000, "rms_rad": [0.0002] * 7, "max_rad": [0.001] * 7}
    text = render(
        with_figures(
            data,
            theta={
                **data.figures["theta"],
                "changes": [change],
                "validation_torque_rmse_nm": [0.1] * 7,
            },
            tick_us=PERCENTILES,
            timing={
                "tick_us": PERCENTILES,
                "lateness_us": PERCENTILES,
                "loop_us": dict.fromkeys(PERCENTILES),
                "histograms": {"tick_us": {"edges_us": [80, 90, 100], "counts": [3, 900]}},
            },
            tracking={"feedback": error, "feedforward": better, "saturated": 0},
            feedforward="learned",
            warnings=["a <b>warning</b>"],
            granted=["memory locked"],
            refused={"repeated": 12, "never_heard_of": 3},
            gaps=[[0, 0.05]],
            fault="the arm went away",
        )
    )
    for shown in (
        'id="changes"', 'id="tracking"', 'id="timing"', 'id="refused"', 'id="warnings"',
        "0.3000 ± 0.0020", "Begin of the tick after its deadline", "900", "memory locked",
        "never heard of", "1 gap in", "on data held out", "deadlines missed",
        "The arm follows its path to 0.20\u202fmrad instead of 10.0\u202fmrad",
        "Path error by joint",
        "0.3000 ± 0.0020\u202fkg was noticed",
        "a &lt;b&gt;warning&lt;/b&gt;", "the arm went away", "ticks per bin",
    ):  # fmt: skip
        assert shown in text, shown
    assert "The whole tick" not in text


def test_names_are_escaped(data: RunData) -> None:
    evil = "<b>\"&'$x_{1}$"
    tree = replace(data.documented.tree, joint_names=tuple(f"{evil}{j}" for j in range(7)))
    robot = replace(data.documented, name=evil, tree=tree, frames=())
    model = replace(data.model, name=evil, tree=tree, frames=(), provenance={"command": evil})
    text = render(replace(data, documented=robot, model=model))
    assert "<b>&#34;" not in text
    assert '<b>"' not in text
    assert "&lt;b&gt;" in text


def test_an_arm_that_never_moved_has_a_report(data: RunData) -> None:
    n = data.n
    schema = {**data.figures["lambda"], "converged_s": None}
    theta = {**data.figures["theta"], "started_s": None, "converged_s": None, "torque_rmse_nm": []}
    still = replace(
        with_figures(data, **{"lambda": schema, "theta": theta, "learned": 0}),
        schema_trace=data.schema_trace[:0],
        schema_errors=data.schema_errors[:, :0],
        theta_trace=data.theta_trace[:0],
        score_trace=data.score_trace[:0],
        fit=np.zeros((0, n)),
        batch=np.zeros((0, n)),
        first_moving_ns=None,
    )
    text = render(still)
    assert "θ was not learned" in text
    assert "Torque was not learned" in text and "to teach most" not in text
    assert "adapter info" in text  # what to do next
    assert 'id="fit"' not in text


def test_without_a_reference_no_errors_are_drawn(data: RunData) -> None:
    text = render(replace(data, reference=None))
    assert "Orientation of the joint frames" in text
    assert "Orientation error" not in text


def said_of(data: RunData, **more) -> str:
    """The headline of a run, in one line and with plain spaces."""
    changed = with_figures(data, **more)
    return " ".join(headline(changed, Worth.of(changed))).replace("\u202f", " ")


def test_headline_says_what_changed_and_what_it_is_worth(data: RunData) -> None:
    """The simulated arm is as documented: there is nothing to gain, and nothing is claimed."""
    said = said_of(data)
    assert said.startswith("The learned model predicts torque as the documentation does: to 0.1")
    assert "e-1" not in said and "mrad" not in said
    worse = replace(data.documented, theta=1.3 * data.documented.theta)
    heavy = replace(data, documented=worse)
    said = said_of(heavy)
    number = r"([\d.]+) ± [\d.]+ N m"
    assert said.startswith("This arm is not as documented: links weigh otherwise, by up to ")
    found = re.search(
        rf"The torque error of all joints fell from {number} with the docu.* to {number}", said
    )
    q, dq, ddq, tau, error = data.score_signals()
    rows = data.times(data.score_trace) >= data.converged_s("theta")
    expected = RigidArm.of(worse).torque(q, dq, ddq) - tau
    for text, table in zip(found.groups(), (expected, error), strict=True):
        size = np.sqrt(np.mean(table[rows] ** 2, axis=0).sum())
        assert float(text) == pytest.approx(size, rel=0.05)


def test_what_the_documentation_lacks_comes_first_and_the_truth_last(data: RunData) -> None:
    """Sure effects that tell more than what is left, and no other; the truth as `sim` has it."""
    entries = [
        {"effect": "coulomb_friction", "joints": [j], "parameters": {"Fc": Fc}, "std": {"Fc": std}}
        for j, Fc, std in ((2, 1e-3, 1e-4), (3, 0.5, 0.4), (4, 0.5, 0.01))
    ]
    world = build("as_built", 5)
    truth = {"effect": "coulomb_friction", "joints": [4], "parameters": {"Fc": 0.5}}
    told = with_figures(data, truth={**world.as_dict(), "effects": [truth]})
    told = replace(told, model=replace(data.model, effects=tuple(entries)))
    lacks = "This arm is not as documented: joint 4 lacks 0.500 ± 0.010 N m of Coulomb friction. "
    assert said_of(told).startswith(lacks)
    q, dq, ddq, _, _ = data.score_signals()
    arm = RigidArm.of(data.documented)
    true = [world.truth.torques(*row) for row in zip(q, dq, ddq, strict=True)]
    off = arm.torque(q, dq, ddq) - true
    off[:, 3] -= 0.5 * np.tanh(dq[:, 3] / 0.01)
    torques, friction = truth_tables(told)
    shown = [float(row[1]) for row in torques.rows]
    np.testing.assert_allclose(shown, np.sqrt(np.mean(off**2, axis=0)), rtol=0.06, atol=2e-3)
    assert friction.rows[3][1:] == ("0.500 ± 0.010", "0.500")
    assert 'id="truth"' in render(told) and 'id="truth"' not in render(data)


def test_headline_names_the_joint_that_changed_most(data: RunData) -> None:
    """Not the one whose error was the largest before."""
    before, after = np.full(7, 0.4), np.full(7, 0.4)
    before[2:4], after[2:4] = (1.5, 0.005), (1.4, 12.75)
    for first, last, words in ((before, after, "rose"), (after, before, "fell")):
        judged = {"documented_validation_torque_rmse_nm": first.tolist()}
        judged["validation_torque_rmse_nm"] = last.tolist()
        said = said_of(data, theta={**data.figures["theta"], **judged})
        assert f" {words} from " in said and "; joint 4 " in said, said


def test_a_body_that_waits_for_a_load_is_not_drawn(data: RunData) -> None:
    """It stands for the last link after a change at the hand, and not before."""
    own, spare = (data.theta_trace[:, 1 + 10 * k : 11 + 10 * k] for k in (6, 7))
    assert (bodies_over_time(data, data.theta_trace)[:, -1] == own).all()
    change = {"stamp_s": data.start_s + 2.0}
    late = data.times(data.theta_trace) >= 2.0
    told = with_figures(data, theta={**data.figures["theta"], "changes": [change]})
    drawn = bodies_over_time(told, data.theta_trace)[:, -1]
    assert (drawn[late] == spare[late]).all() and (drawn[~late] == own[~late]).all()


def test_a_documented_low_pass_goes_by_the_stamps_of_the_rows(data: RunData) -> None:
    """Rows of the score are 10 ms apart and more: taken as 1 ms, second rates are 100-fold."""
    values = {"d": 0.0, "c": 1.5e-4}
    lag = {"effect": "torque_filter", "joints": [], "parameters": values}
    late = replace(data, documented=replace(data.documented, effects=(lag,)))
    before, without = (torque_fall(x).before for x in (late, data))
    assert (np.abs(before - without) > 1e-6).all()
    assert (before < 1.2 * without + 0.02).all()


def test_every_reason_has_its_words():
    assert {verdict.name.lower() for verdict in Verdict} == {"good", *REFUSALS}


def test_late_ticks_of_our_own_are_told_from_the_machine_s(data: RunData) -> None:
    live = {"timing": {"missed_own": 3, "loop_us": PERCENTILES}, "missed_deadlines": 250}
    said = said_of(data, **live)
    assert "250 of " in said
    assert "3 because our own work took too long, 247 because the machine ran something" in said
    text = text_of(render(with_figures(data, **live))).replace("\u202f", " ")
    assert "our work takes 90.0 µs a tick, p99 140 µs" in text


def test_what_lasts_is_not_called_noise(data: RunData) -> None:
    share = slow_share(data)
    assert share is not None and share.max() < SLOW
    assert "like noise: at most" in text_of(render(data))
    t = data.times(data.score_trace)
    pushed = np.zeros_like(data.fit)
    pushed[:, 3] = 0.3 * np.sin(2.0 * t)  # what no effect explains, slower than noise
    left = replace(data, fit=data.fit + pushed)
    share = slow_share(left)
    assert share is not None and list(np.flatnonzero(share > SLOW)) == [3]
    text = text_of(render(left))
    assert "not noise on joint 4" in text and "like noise" not in text


def test_next_steps_are_commands_of_this_program(data: RunData) -> None:
    """Each one is taken by the parser, as typed."""
    folder = "runs/it's here"
    given = with_figures(
        data, model=f"{folder}/model.json", recordings=[f"{folder}/recording.mcap"],
        driver="pybullet:panda", timing={"missed_own": 0},
        tracking={"feedback": {"samples": 9, "rms_rad": [0.01] * 7}}, feedforward="none",
    )  # fmt: skip
    lost = {**data.figures["theta"], "converged_s": None}
    seen = set()
    failed = with_figures(given, theta=lost)
    how = "--turn panda_joint2 --tau-gain -1 --tau-gain=2 --topic /a"
    told = {"command": f"adapter replay it.mcap {how.replace(' -1', ' -1 --out x')}"}
    turned = replace(given.model, provenance=told)
    odd = replace(with_figures(given, recordings=["it.mcap"]), model=turned)
    read = [x.command for x in next_steps(odd, Worth.of(odd)) if "it.mcap" in x.command]
    assert read and all(line.endswith(how) for line in read)
    for run in (given, failed, with_figures(failed, timing=None)):
        steps = next_steps(run, Worth.of(run))
        assert 2 <= len(steps) <= 4
        for step in steps:
            program, *words = shlex.split(step.command)
            assert program == "adapter"
            assert build_parser().parse_args(words) is not None
            seen.add(words[0])
    assert seen >= {"run", "replay", "diff", "export", "info"}


@pytest.mark.parametrize(
    ("command", "kept"),
    [
        (
            "adapter run --driver my.py:Arm --robot a.urdf --config c.toml --out x --duration 5",
            "run --driver my.py:Arm --robot a.urdf --config c.toml",
        ),
        (
            "adapter run --scenario payload_at_20s --set mass=0.3 --set t_s=0 --seed 2 --view 0",
            "run --scenario payload_at_20s --set mass=0.3 --set t_s=0 --seed 2",
        ),
        (
            "adapter run --gravity 9.81 0 -1e-3 --out=x --allow-motion --yes --excitation designed",
            "run --gravity 9.81 0 -1e-3",
        ),
        ("-q tests", "run --driver fci://10.0.0.2 --scenario nominal"),
    ],
)
def test_words_of_the_arm_stay(command: str, kept: str) -> None:
    """The next run is of the same arm: it repeats what this one was told of it."""
    figures = {"driver": "fci://10.0.0.2", "scenario": "nominal"}
    data = SimpleNamespace(figures=figures, model=SimpleNamespace(provenance={"command": command}))
    assert " ".join(_again(data)) == kept


def test_run_folder_round_trip(data: RunData, page: str, tmp_path: Path) -> None:
    folder = save_run(tmp_path / "runs" / "a", data)
    names = {path.name for path in folder.iterdir()}
    assert names == {"model.json", "documented.json", "figures.json", "traces.npz"}
    back = load_run(folder)
    for key in ("schema_trace", "score_trace", "fit", "batch", "lam_shown", "reference"):
        np.testing.assert_array_equal(getattr(back, key), getattr(data, key))
    assert back.figures == json.loads(json.dumps(data.figures))
    assert (back.delay_s, back.first_moving_ns) == (data.delay_s, data.first_moving_ns)
    assert back.model.provenance["program"] == "0.1.0"
    np.testing.assert_array_equal(back.model.theta, data.model.theta)
    written = write_report(folder / "report.html", back).read_text("utf-8")
    assert without_ids(written) == without_ids(page)


def without_ids(text: str) -> str:
    return re.sub(r"f\d+-\w+", "", text)


def test_what_is_not_finite_is_saved_as_unknown(data: RunData, tmp_path: Path) -> None:
    folder = save_run(tmp_path, with_figures(data, odd=[np.float64("nan"), np.int64(3)]))
    assert load_run(folder).figures["odd"] == [None, 3]


def test_folder_errors_name_the_file(data: RunData, tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match="no such run folder"):
        load_run(tmp_path / "nowhere")
    folder = save_run(tmp_path / "a", data)
    traces, figures = folder / "traces.npz", folder / "figures.json"
    cut = traces.read_bytes()[:1000]
    for spoil, said in (
        (lambda: traces.write_bytes(cut), r"traces\.npz: cannot be read"),
        (lambda: np.savez(traces, version=99), "version 99 of the traces; have: 2"),
        (lambda: np.savez(traces, version=[{}]), r"traces\.npz: cannot be read"),
        (lambda: figures.write_text("{"), r"figures\.json: cannot be read"),
        (lambda: figures.write_text("{}"), "the figures lack 'samples'"),
        (lambda: (folder / "model.json").unlink(), r"lacks model\.json; a run has"),
    ):
        save_run(folder, data)
        spoil()
        with pytest.raises(RunFolderError, match=said):
            load_run(folder)
    (tmp_path / "file").write_text("")
    with pytest.raises(RunFolderError, match="cannot be written"):
        save_run(tmp_path / "file", data)


def test_thin_keeps_peaks() -> None:
    t = np.arange(10_000.0)
    y = np.zeros_like(t)
    y[[1234, 7777]] = 5.0, -3.0
    few, values = thin(t, y, 100)
    assert len(few) <= 102
    assert values.max() == 5.0
    assert values.min() == -3.0
    assert (np.diff(few) > 0).all()


def test_rotation_path_has_no_jump_at_half_a_turn() -> None:
    lam = np.zeros((50, 1, 6))
    lam[:, 0, 1] = np.linspace(2.5, 3.8, 50)  # about x, through π
    path = rotation_path(lam)
    assert np.abs(np.diff(path[:, 0, 0])).max() < 0.05
    assert path[-1, 0, 0] == pytest.approx(3.8)


@pytest.mark.parametrize("width", [420, 1100, 1500])
def test_nothing_is_lost_at_any_width(width: int, page: str, tmp_path: Path) -> None:
    """Everything unfolded, every cell of every table is inside the page's pixels."""
    assert laid_out(page, tmp_path, width) > 7 * (6 + 10)  # the matrices' alone


def test_a_browser_shows_it_without_complaint(page: str, tmp_path: Path) -> None:
    shown_without_complaint(page, tmp_path, 50_000)
