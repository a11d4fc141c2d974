"""What is said and shown about the gap: right words for each outcome, a page that stands alone."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from adapter.effects.catalogue import CATALOGUE
from adapter.gap.result import GapResult, LogLoad
from adapter.gap.words import (
    as_json,
    console_summary,
    headline,
    leftover_sentence,
    noise_times,
    rivals,
    sentence,
)
from adapter.model.numbers import plain
from adapter.report.gap_page import render_gap_page
from adapter.report.gap_panels import shown_joints
from adapter.report.html import write_whole
from adapter.runs.run_folder import RunFolderError
from tests.helpers import gap_results as made_up
from tests.helpers.browser import ids_of_a_whole_page, laid_out, shown_without_complaint, text_of

KINDS = ["one_finding", "pair", "unexplained", "nothing", "problem", "two_joints", "many"]
SECTIONS = {
    "one_finding": "findings gap trust next signatures confusion correction notes provenance",
    "pair": "findings gap trust next signatures confusion correction notes provenance",
    "unexplained": "gap trust unexplained next signatures correction notes provenance",
    "nothing": "gap trust signatures provenance",
    "problem": "next provenance",
    "two_joints": "findings gap trust signatures confusion provenance",
    "many": "findings gap trust unexplained next signatures confusion correction notes provenance",
}
SAID = {
    "one_finding": "joint 4 lacks 2.000 ± 0.030 N m of Coulomb friction; "
    "torque error 1.92 -> 0.05 N m over all joints, 1.92 -> 0.02 of joint 4, the worst",
    "pair": "joint 4 lacks 2.000 ± 0.030 N m of Coulomb friction; "
    "from 12.3 s on the flange carries 1.020 ± 0.010 kg; "
    "torque error 1.92 -> 0.05 N m over all joints, 1.92 -> 0.02 of joint 4, the worst",
    "unexplained": "joint 3: 0.30 N m that follow dq3 and q1 are not explained by any effect of "
    "the catalogue",
    "nothing": "the model explains this recording down to its noise",
    "problem": "joints 1 to 7 hardly move; move each over 0.5 rad and more than 0.2 rad/s.",
    "two_joints": "the torque of all joints comes 2.10 ± 0.10 ms after the position; "
    "torque error 0.90 -> 0.04 N m over all joints, 0.90 -> 0.03 of joint 1, the worst",
    "many": "joints 1 to 7 lack Coulomb friction (0.14 to 0.45 N m); "
    "joints 1, 2 and 4 lack viscous friction (0.10, 0.20 and 0.40 N m s/rad); "
    "the torque sensor of joint 2 reads 0.310 ± 0.020 N m too little; 2 more findings; "
    "torque error 1.18 -> 0.52 N m over all joints, 0.77 -> 0.29 of joint 2, the worst; "
    "joints 3 and 6: 0.30 and 0.60 N m are not "
    "explained by any effect of the catalogue",
}


def result_of(kind: str) -> GapResult:
    make: Callable[[], GapResult] = getattr(made_up, kind)
    return make()


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    return {kind: render_gap_page(result_of(kind)) for kind in KINDS}


@pytest.mark.parametrize("kind", KINDS)
def test_page_has_its_sections_and_stands_alone(kind: str, pages: dict[str, str]) -> None:
    ids_of_a_whole_page(pages[kind], SECTIONS[kind])


@pytest.mark.parametrize(
    ("kind", "size", "dark"),
    [
        ("one_finding", (1300, 1500), False),
        ("pair", (1300, 1500), True),
        ("many", (500, 1500), True),
        ("unexplained", (390, 1500), False),
        ("nothing", (1300, 1000), False),
        ("problem", (900, 500), True),
        ("two_joints", (1300, 1000), False),
    ],
)
def test_a_browser_shows_it_without_complaint(
    kind: str, size: tuple[int, int], dark: bool, pages: dict[str, str], tmp_path: Path
) -> None:
    shown_without_complaint(pages[kind], tmp_path, 20_000, size, dark)


def test_page_tells_the_finding(pages: dict[str, str]) -> None:
    text = text_of(pages["one_finding"])
    for said in (
        "Joint 4 lacks 2.000 ± 0.030 N m of Coulomb friction. Torque error 1.92 → 0.05 N m over "
        "all joints, "
        "1.92 → 0.02 of joint 4, the worst.",
        "adapter diff nominal.json nominal+coulomb_friction.json",
        "Fc = 2.000 ± 0.030 N m", "> 99.9 %", "load-dependent friction 97 %",
        "repeat the motion with a ladder of loads", "Forward simulation", "Against velocity",
        "Against position", "Against load", "Against acceleration", "Over time",
        "Not a finding", "+0.05 kg", "12 samples are repeated", "nominal+coulomb_friction.json",
    ):  # fmt: skip
        assert said in text, said
    times = noise_times(result_of("one_finding"))  # the table, the tile and the check are of these
    assert all(f" {plain(x[3])} " in text for x in times)
    assert pages["one_finding"].count("<svg") == 2 + 4 + 2


def test_findings_of_one_effect_are_one_row_and_one_line(pages: dict[str, str]) -> None:
    text = text_of(pages["many"])
    assert text.count("Coulomb friction joints 1 to 7 throughout") == 1
    assert "Fc = 0.14 to 0.45 N m; joint by joint below" in text
    assert "panda_joint4 0.450 ± 0.011 0.400 ± 0.020" in text  # a joint a row, an effect a column
    assert "panda_joint3 0.140 ± 0.011 –" in text
    lines = console_summary(result_of("many"))
    assert sum("Coulomb friction" in line and "•" in line for line in lines) == 1
    assert any("joint 4: Fc = 0.450 ± 0.011 N m" in line for line in lines)


def test_what_is_many_times_the_noise_is_not_called_explained(pages: dict[str, str]) -> None:
    """12 times the noise on a joint is said, though nothing of it was listed as unexplained."""
    left = made_up.leaving(1.0, [0.02] * 6 + [12.0 * made_up.NOISE_NM])
    result = replace(result_of("one_finding"), curves=left)
    text = text_of(render_gap_page(result))
    assert "12 times the noise stays on joint 7" in text
    assert "nothing above the noise" not in text and "nothing unexplained" not in text
    assert any("12 times the noise stays on joint 7" in line for line in console_summary(result))
    assert "nothing above the noise left" in text_of(pages["one_finding"])


@pytest.mark.parametrize(("kind", "width"), [("many", 420), ("pair", 420), ("many", 1100)])
def test_nothing_is_lost_at_any_width(
    kind: str, width: int, pages: dict[str, str], tmp_path: Path
) -> None:
    assert laid_out(pages[kind], tmp_path, width) > 0


def test_page_tells_what_stays_unexplained(pages: dict[str, str]) -> None:
    text = text_of(pages["unexplained"])
    assert "that follow the velocity of joint 3 (dq3) and the position of joint 1 (q1)" in text
    assert "15 times its noise" in text
    assert "Left on joint 3" in text
    assert "none was written" in text


def test_signatures_are_of_the_worst_joints() -> None:
    assert shown_joints(result_of("one_finding")) == [3]
    assert shown_joints(result_of("pair")) == [3, 1]  # the payload acts most on joint 2
    assert shown_joints(result_of("unexplained")) == [2]
    assert len(shown_joints(result_of("many"))) == 3
    assert shown_joints(result_of("problem")) == []


def test_a_problem_with_curves_and_corrections_without_prior_have_a_page() -> None:
    result = replace(result_of("problem"), curves=(made_up.curves(),))
    assert "Against velocity" in render_gap_page(result)
    result = replace(result_of("one_finding"), corrections_prior=np.zeros((7, 10)))
    assert 'id="correction"' not in render_gap_page(result)


def test_unknown_rollouts_are_dashes_or_left_out(pages: dict[str, str]) -> None:
    assert "rollout" not in text_of(pages["two_joints"])
    one = result_of("one_finding")
    failed = replace(one.after, rollout_rmse_rad=np.full(7, np.nan), rollout_rmse_rad_s=None)
    text = text_of(render_gap_page(replace(one, after=failed)))
    assert "80.0 – " in text
    assert "80 → – mrad" in text


def test_every_effect_has_its_phrase() -> None:
    for name, effect in CATALOGUE.items():
        joints = (2,) if effect.scope in ("joint", "link") else ()
        less, std, more = (
            {p.key: [x] * p.count if p.count > 1 else x for p in effect.parameters}
            for x in (-0.1, 0.01, 0.1)
        )
        for values in (less, more):
            found = made_up.finding(name, joints, values, std)
            assert not re.search(r"[{}]|nan|None", sentence(found)), sentence(found)
        assert headline(replace(result_of("one_finding"), findings=(found,)))


@pytest.mark.parametrize(
    ("effect", "joints", "values", "std", "said"),
    [
        ("torque_gain", (2,), {"g": 0.05}, {"g": 0.002},
         "the torque sensor of joint 2 reads 5.00 ± 0.20 % too much"),
        ("encoder_offset", (3,), {"o": -0.0123}, {"o": 0.0002},
         "the encoder of joint 3 reads 12.30 ± 0.20 mrad too little"),
        ("joint_elasticity", (2,), {"k": 12345.0}, {"k": 340.0},
         "joint 2 is elastic, with a stiffness of 12340 ± 340 N m/rad"),
        ("torque_ripple", (5,), {"a": 0.31, "n": 3, "phase": 0.2}, {"a": 0.01, "phase": 0.03},
         "joint 5 has a torque ripple of 0.310 ± 0.010 N m, 3 per turn"),
        ("base_tilt", (), {"rx": 0.03, "ry": 0.04}, {"rx": 0.001, "ry": 0.001},
         "the base is tilted by 2.865 ± 0.057°"),
        ("payload", (), {"m": -0.4, "cx": 0.0, "cy": 0.0, "cz": 0.1}, {"m": None},
         "the flange carries 0.400 kg less than the model says"),
        ("coulomb_friction", (4,), {"Fc": -0.3}, {"Fc": 0.02},
         "joint 4 has 0.300 ± 0.020 N m less Coulomb friction than the model says"),
    ],
)  # fmt: skip
def test_sentence(effect, joints, values, std, said) -> None:
    assert sentence(made_up.finding(effect, joints, values, std)) == said


def test_when() -> None:
    wrench = result_of("many").findings[-1]
    assert sentence(wrench).startswith("from 3.1 to 4.6 s something pushes the flange with 5.20 ±")
    early = replace(made_up.COULOMB, interval_s=(0.0, 4.0), lasting=False)
    assert sentence(early).startswith("until 4 s joint 4 lacks")


def test_rivals() -> None:
    assert rivals([made_up.COULOMB]) == (
        "could also be load-dependent friction, which explains 97 % of it here; "
        "to split: repeat the motion with a ladder of loads at the flange, at the same speed: "
        "the Coulomb friction stays, the load-dependent friction grows with the load"
    )
    assert "explains all of it" in rivals([made_up.PAYLOAD])
    assert rivals([replace(made_up.COULOMB, overlaps={})]) == ""


def test_a_load_and_a_heavier_last_link_are_one_finding_with_two_readings() -> None:
    load = replace(made_up.PAYLOAD, interval_s=(0.0, made_up.LONG_S), evidence=0.9991)
    assert sentence(load) == (
        "a load of 1.020 ± 0.010 kg at the hand (or the last link heavier by that: this log cannot "
        "tell)"
    )
    assert rivals([load]) == ""
    result = replace(result_of("pair"), findings=(load,))
    assert any("that one of them is there more than 99.9 %" in x for x in console_summary(result))


def test_findings_of_one_kind_have_their_rivals_said_once() -> None:
    other = replace(made_up.COULOMB, joints=(2,), overlaps={"load_dependent_friction": 0.91})
    result = replace(result_of("one_finding"), findings=(made_up.COULOMB, other))
    said = " ".join(console_summary(result))
    assert said.count("could also be") == 1 and "explains 91 to 97 % of it" in said
    assert "Coulomb friction, joints 2 and 4" in text_of(render_gap_page(result))


def test_what_is_worse_or_in_sample_is_in_the_headline() -> None:
    one = result_of("one_finding")
    after = made_up.errors([0.02, 0.06, 0.02, 0.02, 0.031, 0.02, 0.02])
    assert "but 20 % worse on joint 2" in headline(replace(one, after=after))
    two = made_up.errors([0.02, 0.06, 0.02, 0.02, 0.06, 0.02, 0.02])
    assert "but up to 100 % worse on joints 2 and 5" in headline(replace(one, after=two))
    assert "in sample only" in headline(replace(one, in_sample=True))


def test_what_each_recording_carries() -> None:
    held = LogLoad("a.mcap", True, 2.351, 0.042, (0.001, 0.0, 0.06), (0.001, 0.002, 0.004), "hand")
    bare = LogLoad("b.mcap", False, 0.02, 0.04, None, None, "hand")
    loads = tuple(
        replace(made_up.PAYLOAD, interval_s=(0.0, made_up.LONG_S), recording=name)
        for name in ("a.mcap", "b.mcap")
    )
    clash = "b.mcap contradicts the other recordings: the friction of joint 3 differs"
    result = replace(result_of("pair"), findings=loads, loads=(held, bare), contradictions=(clash,))
    assert headline(result).startswith("payload of 1.0 to 1.0 kg in 2 recordings")
    assert clash in headline(result)
    said = " ".join(console_summary(result))
    assert "a.mcap  2.351 ± 0.042 kg  centre x 1.0 ± 1.0" in said
    assert "b.mcap  nothing shown (0.020 ± 0.040 kg)" in said
    text = text_of(render_gap_page(result))
    assert "What each recording carries" in text and clash.removeprefix("b.mcap ") in text
    assert as_json(result)["loads"][1]["mass_kg"] == 0.02


def test_what_follows_nothing_is_said_so() -> None:
    left = replace(result_of("unexplained").unexplained[0], depends_on=())
    assert "that follow no signal are not explained" in leftover_sentence(left)
    result = replace(result_of("unexplained"), unexplained=(left,))
    assert "time, s" in text_of(render_gap_page(result))


def test_nothing_found_is_not_called_noise_where_more_is_left() -> None:
    result = replace(result_of("nothing"), curves=made_up.leaving(0.1, 0.1))
    assert "to within 5 times the noise" in headline(result)
    corrected = replace(result, curves=made_up.leaving(0.1, 0.02))
    assert "once its inertias are corrected" in headline(corrected)


@pytest.mark.parametrize("kind", KINDS)
def test_headline_and_console_summary(kind: str) -> None:
    result = replace(result_of(kind), notes=("[bold] is not markup here",))
    assert headline(result) == as_json(result)["headline"] == SAID[kind]
    console = Console(width=800, record=True, file=io.StringIO())
    for line in console_summary(result):
        console.print(line, highlight=False)
    shown = console.export_text()
    assert SAID[kind] in shown
    assert "[bold] is not markup here" in shown
    if result.problem is None:
        assert "torque error before" in shown
    assert "nan" not in shown


def test_names_are_escaped() -> None:
    evil = "<b>\"&'$x_{1}$"
    result = replace(
        result_of("one_finding"), model_name=evil, joint_names=(evil,) * 7, recordings=(evil,),
        notes=(evil,), what_next=(evil,), model_out=evil,
    )  # fmt: skip
    page = render_gap_page(result)
    assert '<b>"' not in page
    assert "<b>&#34;" not in page


def test_it_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    path = write_whole(tmp_path / "new" / "gap.html", "<html></html>")
    assert path.read_text("utf-8").endswith("</html>")
    assert [p.name for p in path.parent.iterdir()] == ["gap.html"]
    (tmp_path / "file").write_text("")
    with pytest.raises(RunFolderError, match="cannot be written"):
        write_whole(tmp_path / "file" / "gap.html", "")
