"""The page of the paper's experiments: every figure, every number, and what was not run."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapter.experiments.falls import SETS
from adapter.experiments.page.atlas_figures import (
    arm_panels,
    epoch_panels,
    histogram_panels,
    limbs,
    not_judged,
    skeleton,
    whole_panels,
)
from adapter.experiments.page.page import beyond, logarithmic, render_experiment, turns_and_shifts
from adapter.experiments.page.words import headline, scientific, sentences
from adapter.experiments.results import AtlasResults, LearnerScores, PandaResults, Stated
from adapter.model.tree import Tree
from tests.helpers.browser import ids_of_a_whole_page, shown_without_complaint, text_of

NAMES = ("back_z", "back_x", "neck_y", "r_arm_x", "r_arm_y", "l_leg_x", "l_leg_y")
PARENT = (-1, 0, 1, 1, 3, -1, 5)
ARM = (3, 4)
KINDS = ("v", "w", "a", "dw")
PER_CENT = np.array([0.1, 0.4, 1.0, 3.0, 9.0])  # a box around its median
# Medians on train, test and control set.
MEDIANS = {
    "FOPnet": (1.1e-9, 1.2e-9, 1.3e-9),
    "FFNN": (0.021, 0.032, 0.26),
    "ELM": (0.061, 0.072, 0.43),
    "GPR": (0.00012, 0.14, 0.55),
    "Lagrangian": (0.011, 0.013, 0.052),
    "Regressor": (1.7e-12, 1.8e-12, 1.9e-12),
}
DISCOVERED = {
    "trials": 20,
    "right": 20,
    "least_confidence_right": 0.98765,
    "most_confidence_wrong": 0.0,
    "motion_s": 9.908,
    "measured": "w, a",
}
ONLINE = {
    "joints": 7,
    "lambda_rank": 41,
    "lambda_settled_s": 1.021,
    "step_p50_us": 417.3,
    "step_p99_us": 5400.9,
    "samples_per_second": 1269.1,
    "history": [
        {
            "seconds": seconds,
            "turn_rad": 1e-3 / seconds,
            "shift_m": 1e-2 / seconds,
            "over_least_squares": 1.0 + 1.0 / seconds,
            "worst_joint_over_least_squares": 1.0 + 4.0 / seconds,
        }
        for seconds in (5.0, 10.0, 15.0)
    ],
}


def learner(name: str, medians: tuple[float, ...]) -> LearnerScores:
    joints = len(NAMES) if name == "FOPnet" else len(ARM)
    by_set = dict(zip(SETS, medians, strict=True))
    size = np.linspace(0.8, 1.2, joints)
    return LearnerScores(
        name,
        f"{name} in full",
        boxes={s: np.minimum(x * np.outer(size, PER_CENT), 2.0) for s, x in by_set.items()},
        rmse={s: 10.0 * x * size for s, x in by_set.items()},
        median=by_set,
        p99={s: min(20.0 * x, 2.0) for s, x in by_set.items()},
        train_s=12.5,
        tuning=[f"{name} was tuned.", "Twice."],
    )


def atlas() -> AtlasResults:
    rng = np.random.default_rng(5)
    true = np.concatenate([rng.uniform(-1, 1, (7, 3)), rng.uniform(-0.4, 0.4, (7, 3))], axis=1)
    far = [("epoch 0", 1.0), ("epoch 50", 0.1), ("epoch 100", 0.01), ("final", 1e-9)]
    return AtlasResults(
        tree=Tree(PARENT, floating=True, joint_names=NAMES),
        true_lam=true,
        arm=ARM,
        snapshots=[(label, true + s * rng.standard_normal(true.shape)) for label, s in far],
        cost=np.exp(-np.linspace(0.0, 20.0, 900)),
        error_edges=np.linspace(-14.0, -4.0, 21),
        error_counts={kind: rng.multinomial(500, np.full(20, 0.05)) for kind in KINDS},
        learners=[learner(name, medians) for name, medians in MEDIANS.items()],
        stated=[
            Stated("trajectories", "random trajectories", "63 of 10 s", 63),
            Stated("samples", "samples", "500 000", 500_000),
            Stated("learn_s", "λ and θ learned in", "", 38.25, "s", "on 2 cores"),
            Stated("k", "largest kinematic error", "negligible", 3.14e-8, "m/s"),
            Stated("full", "full size", "", None, "s"),
        ],
        numbers={
            "learned_samples": 1234,
            "best_baseline": "FFNN",
            "control_error_ratio_to_best_baseline": 0.26 / 1.2e-9,
            "discover": DISCOVERED | {"right": 19, "most_confidence_wrong": 0.31259},
            "online": ONLINE,
        },
        moments_error_counts={kind: rng.multinomial(500, np.full(20, 0.05)) for kind in KINDS},
    )


def panda() -> PandaResults:
    rng = np.random.default_rng(6)
    t = np.arange(-0.5, 40.0, 0.02)
    left = np.exp(-np.maximum(t, 0.0))[:, None, None]
    true, start = rng.uniform(-1, 1, (2, 6)), rng.normal(0, 0.02, (2, 6))
    ratio = np.where(t > 3.0, 1.037 + np.exp(3.0 - t), np.nan)
    return PandaResults(
        tree=Tree((-1, 0)),
        time_s=t,
        lam=true + (start - true) * left,
        lam_true=true,
        lam_shown=np.array([[True, True, False, False, False, True], [True] * 6]),
        theta_time_s=t,
        theta=rng.uniform(0.1, 1.0, (2, 10)) * (1.0 - left) + 0.1,
        theta_start_s=3.0,
        torque_time_s=t,
        torque_error=ratio,
        stated=[
            Stated("lambda_converged_s", "λ converged after", "40 s", 2.87, "s"),
            Stated("rate_hz", "rate", "1 kHz", 1000.0, "Hz"),
        ],
        numbers={"discover": DISCOVERED},
    )


def few_panels() -> AtlasResults:
    """Results that are drawn quickly: where a test is about words."""
    full = atlas()
    numbers = full.numbers | {"online": ONLINE | {"history": []}}
    return replace(full, snapshots=full.snapshots[-1:], learners=full.learners[:2], numbers=numbers)


@pytest.fixture(scope="module")
def page() -> str:
    return render_experiment(atlas(), panda(), "Made by a <test>.")


def test_page_stands_alone(page: str) -> None:
    ids_of_a_whole_page(page, "stated fig4 fig5 fig6 beyond provenance")
    assert "Made by a &lt;test&gt;." in page
    assert 'id="reasons"' not in page


def test_every_figure_is_there(page: str) -> None:
    found = re.findall(r"<figcaption><b>(.*?)</b>", page)
    # Figs. 4 and 6, in the order of the paper; of Fig. 5 the learners it has not come between.
    assert found == [
        "(a) Epoch 0", "(b) Epoch 50", "(c) Epoch 100", "(d) Final", "(e) Actual 7-joint robot",
        "(f) Kinematic errors |k − k̂|",
        "λ from moments: errors |k − k̂|", "Cost of λ, eq. 18", "Error of λ in the pictures",
        "(a) FFNN", "(b) ELM", "(c) GPR", "(d) FOPnet", "Lagrangian", "Regressor",
        "(e) What the baselines learn: joints 4 to 5", "All learners on one scale",
        "(d) FOPnet, joints 1 to 7",
        "(a) λ: orientation of the joint frames", "(a) λ: position of the joint frames",
        "(b) θ: mass", "(b) θ: first moments mX mY mZ", "(b) θ: inertia XX to ZZ",
        "Torque error while learning",
        "ATLAS online: torque error", "ATLAS online: error of λ",
    ]  # fmt: skip
    assert page.count("<svg") == len(found)
    assert "θ starts" in page


def test_every_number_is_there(page: str) -> None:
    text = text_of(page)
    for said in (
        "random trajectories 63 of 10 s 63", "500 000 500 000", "38.2 s on 2 cores",
        "negligible 3.14 × 10⁻⁸ m/s", "full size not stated not run", "40 s 2.87 s",
        "1 kHz 1000 Hz", "12.5 s", "Regressor was tuned. Twice.", "back and neck", "right arm",
    ):  # fmt: skip
        assert said in text, said
    for one in atlas().learners:
        for name in SETS:
            row = [name, *(f"{scientific(100 * x[name])} %" for x in (one.median, one.p99))]
            ends = [scientific(x) for x in (one.rmse[name].min(), one.rmse[name].max())]
            said = text_of(" ".join([*row, " – ".join(ends)]))
            assert said in text, said


def test_headline_follows_the_numbers() -> None:
    assert text_of(headline(atlas(), panda())) == (
        "On control trajectories FOPnet predicts the joint torques of ATLAS (7 joints) with a "
        "median relative error of 1.3 × 10⁻⁷ %; on the arm (2 joints) it is 2.2 × 10⁸ times "
        "smaller than that of the paper's best baseline (FFNN, 26 %). "
        "The simulated Panda's λ converges 2.9 s after the first motion "
        "(the paper's real arm: 40 s), and its torque error is 1.04 times that of batch least "
        "squares."
    )
    worse, slow = atlas(), panda()
    worse.learners[0].median["control"] = 0.52
    worse.numbers["control_error_ratio_to_best_baseline"] = 0.5
    slow.stated = [replace(slow.stated[0], ours=None)]
    said = text_of(headline(worse, slow))
    assert "error of 52 %; on the arm (2 joints) it is 2.0 times larger than" in said
    assert "λ did not converge; in the end its torque error is 1.04" in said
    worse.numbers["best_baseline"] = None
    worse.learners = worse.learners[:1] + worse.learners[4:]  # those of the paper left out
    said = headline(worse, replace(slow, theta_start_s=float("nan")))
    assert "the baselines were not run." in said
    assert "did not converge; its θ was not learned." in said


@pytest.mark.parametrize(
    ("with_atlas", "with_panda", "shown", "reasons"),
    [
        (True, False, "stated fig4 fig5 beyond provenance", ["Section IV.B was not run"]),
        (False, True, "stated fig6 beyond provenance", ["Section IV.A was not run"]),
        (False, False, "provenance", ["Section IV.A was not run", "Section IV.B was not run"]),
    ],
)
def test_what_was_not_run_is_left_out_with_a_reason(
    with_atlas: bool, with_panda: bool, shown: str, reasons: list[str]
) -> None:
    found = render_experiment(atlas() if with_atlas else None, panda() if with_panda else None, "")
    assert re.findall(r'<(?:section|footer) id="(\w+)"', found) == shown.split()
    told = re.search(r'id="reasons".*?</ul>', found, flags=re.S)
    assert told.group().count("<li>") == len(reasons)
    for reason in reasons:
        assert reason in told.group()


def test_parts_that_are_missing_are_named(page: str) -> None:
    """Too few samples for epoch 100, and for all joints to converge: both are said.

    What is left keeps the paper's letter.
    """
    kept = [x for x in atlas().snapshots if x[0] != "epoch 100"]
    short = replace(few_panels(), not_converged=("r_arm_x", "neck_y"), snapshots=kept)
    short.learners = [x for x in atlas().learners if x.name in ("FOPnet", "GPR")]
    arm = replace(panda(), theta_start_s=float("nan"), torque_error=np.full(2025, np.nan))
    found = render_experiment(short, arm, "")
    told = re.findall(r"<li>(Fig. \w+)", found)
    assert told == ["Fig. 4c", "Fig. 5a", "Fig. 5b", "Fig. 6b"]
    assert "(c) GPR" in found
    assert "Torque error while learning" not in found
    titles = re.findall(r"<figcaption><b>(.*?)</b>", found)
    assert titles[:4] == ["(a) Epoch 0", "(b) Epoch 50", "(d) Final", "(e) Actual 7-joint robot"]
    assert titles[4].startswith("(f) ")
    assert "Fig. 4c: λ's training has no epoch 100, it ended before." in text_of(found)
    said = "2 joints had not converged: r_arm_x, neck_y; too few samples (1234)."
    assert said in text_of(found)
    none = replace(few_panels(), not_converged=NAMES)
    assert "None of the 7 joints had converged;" in render_experiment(none, None, "")
    assert 'id="not-converged"' not in page


def test_each_histogram_shows_its_own_errors() -> None:
    networks, moments = np.zeros(20), np.zeros(20)
    networks[14], moments[2] = 40.0, 60.0  # at 10⁻⁷ and at 10⁻¹³
    shown = replace(
        atlas(), error_counts={"v": networks}, moments_error_counts={"v": moments, "w": 0 * moments}
    )
    paper, other = histogram_panels(shown)
    assert "40 numbers of a kind" in paper.note
    assert "60 numbers of a kind" in other.note
    assert not re.search(">10⁻¹[⁰²⁴]<", paper.svg)
    assert re.search(">10⁻¹[⁰²⁴]<", other.svg)


def test_a_joint_without_boxes_is_explained() -> None:
    assert not_judged(atlas()) == []
    shown = few_panels()
    for one in shown.learners:
        for boxes in one.boxes.values():
            boxes[len(boxes) - 1 if len(boxes) == len(ARM) else ARM[-1]] = np.nan
    assert not_judged(shown) == [ARM[-1]]
    said = "Joint 5 (r_arm_y) has no box: eq. 20 is judged only where |τ| > 0.1 N m"
    assert said in text_of(render_experiment(shown, None, ""))


@pytest.mark.parametrize(
    ("full", "said"), [(False, "This run is a reduced one"), (True, "This run had them")]
)
def test_the_size_of_the_learners_is_said(full: bool, said: str) -> None:
    assert said in render_experiment(replace(few_panels(), full=full), None, "")
    alone = replace(few_panels(), full=full, learners=atlas().learners[:1])
    assert "The paper's sizes" not in render_experiment(alone, None, "")


def test_tuning_reads_as_sentences() -> None:
    pieces = [
        "1,500 tuned_on, 49 rank, 375,000 samples",
        "θ by 35% to 3e+02, noise 1.0e-09",
        "-1 to 1.",
    ]
    assert text_of(sentences(pieces)) == (
        "Tuned on 1500, rank 49, 375 000 samples. θ by 35 % to 300, noise 1.0 × 10⁻⁹. −1 to 1."
    )


def test_beyond_the_paper_is_told_with_its_confidences(page: str) -> None:
    said = text_of(page)
    for row in (
        "ATLAS Panda trees found, every edge right 19 of 20 20 of 20",
        "least confidence in a right edge 0.9876 0.9876",
        "most confidence in a wrong edge 0.3125 none was reported",
        "longest recording 9.91 s 9.91 s",
        "angular velocity and acceleration angular velocity and acceleration",
        "samples a second, on one core 1269 1/s", "99th percentile 5.40 ms", "median 417 µs",
        "θ begins after 1.02 s", "41 of 42",
    ):  # fmt: skip
        assert row in said, row
    assert beyond(None, replace(panda(), numbers={"discover": {"trials": 0}})) is None


def test_skeleton_hangs_together() -> None:
    """An elbow of two turned frames, worked out by hand."""
    quarter = np.pi / 2
    lam = np.array([[quarter, 0, 0, 1, 0, 0], [0, quarter, 0, 1, 0, 0], [0, 0, 0, 0, 0, 2.0]])
    shown = skeleton(Tree((-1, 0, 1)), lam)
    np.testing.assert_allclose(shown.p, [[1, 0, 0], [1, 1, 0], [3, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(shown.axis[0], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(shown.axis[1:], [[1, 0, 0]] * 2, atol=1e-12)


def test_limbs_are_the_chains_between_branchings() -> None:
    assert [(limb.name, limb.joints) for limb in limbs(atlas().tree)] == [
        ("back and neck", (0, 1, 2)),
        ("right arm", (3, 4)),
        ("left leg", (5, 6)),
    ]
    assert [limb.name for limb in limbs(Tree((-1, 0, 1)))] == ["joint1 to joint3"]


def test_pictures_say_how_far_off_they_are() -> None:
    shown = atlas()
    moved = shown.true_lam.copy()
    moved[0, 3:] += [0.0, 0.3, 0.4]  # the back and all that hangs on it, by half a metre
    shown.snapshots = [("epoch 0", moved)]
    assert "up to 0.50 m" in text_of(epoch_panels(shown)[0].note)


def test_boxes_stand_where_their_numbers_are() -> None:
    """Baselines share a scale in per cent; FOPnet's is its own, of the arm and of all joints."""
    paper, others = arm_panels(atlas())
    ticks = [re.findall(r">([^<>\s]+)</text>", str(panel.svg)) for panel in paper]
    assert ticks[0] == ticks[1] == ticks[2]
    assert ticks[0][:2] == ["4", "5"]
    assert {"0.001", "100"} <= set(ticks[0])  # GPR's train boxes begin at 0.001 %
    assert {"10⁻⁸", "10⁻⁶"} <= set(ticks[3])
    assert "100" not in ticks[3]
    assert len(others) == 2
    (whole,) = whole_panels(atlas())
    assert re.findall(r">(\d)</text>", str(whole.svg)) == list("1234567")


def test_exact_and_missing_errors_can_be_drawn() -> None:
    shown = atlas()
    shown.learners[0].boxes["train"][:] = 0.0
    shown.learners[1].boxes["control"][0] = np.nan
    paper, _ = arm_panels(shown)
    assert len(paper) == 4
    assert "nan" not in "".join(str(panel.svg) for panel in paper)


def test_true_turn_is_the_one_beside_the_learned() -> None:
    """Near half a turn two rotation vectors mean almost the same turn; both lines use one."""
    lam = np.zeros((3, 1, 6))
    lam[:, 0, 0] = [2.5, 3.0, 3.2]  # grows past π
    path, true = turns_and_shifts(lam, np.array([[3.21, 0, 0, 0.1, 0, 0]]))
    np.testing.assert_allclose(path[:, 0, 2], [2.5, 3.0, 3.2], atol=1e-9)
    assert true[0, 2] == pytest.approx(3.21)
    assert true[0, 3] == pytest.approx(0.1)


def test_time_is_logarithmic_where_most_happens_at_first() -> None:
    assert logarithmic(panda())
    assert not logarithmic(replace(panda(), theta_start_s=20.0))


def test_names_are_escaped() -> None:
    evil = "<b>$x_{1}$"
    shown = atlas()
    shown.tree = replace(shown.tree, joint_names=(evil, *NAMES[1:]))
    shown.learners[1].name = evil
    shown.snapshots[0] = (evil, shown.snapshots[0][1])
    found = render_experiment(shown, None, evil)
    assert "<b>$" not in found
    said = re.escape("&lt;b&gt;$x_{1}$")
    assert re.search(rf"<text[^>]*>{said}</text>", found)  # an epoch on an axis, no formula
    assert re.search(rf"<p>{said}</p>", found)


@pytest.mark.parametrize(("size", "dark"), [((1300, 3000), False), ((390, 3000), True)])
def test_a_browser_shows_it_without_complaint(
    size: tuple[int, int], dark: bool, page: str, tmp_path: Path
) -> None:
    shown_without_complaint(page, tmp_path, 100_000, size, dark)
