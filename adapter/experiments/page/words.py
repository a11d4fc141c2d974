"""Numbers and the two opening sentences of the experiments' page."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np

from adapter.experiments.results import (
    PAPER_BASELINES,
    AtlasResults,
    LearnerScores,
    PandaResults,
    Stated,
)
from adapter.model.numbers import DASH
from adapter.report.style import SUPERSCRIPTS
from adapter.report.words import NARROW, count, number

OURS = "FOPnet"
# The parts of the paper's Fig. 5 by the learner that they show.
LETTERS = dict(zip((*PAPER_BASELINES, OURS), "abcd", strict=True))
PLAIN_FROM, PLAIN_TO = 1e-3, 1e4  # between them a number needs no power of ten
ATLAS_LEFT_OUT = "Section IV.A was not run: “adapter experiment atlas” makes Figs. 4 and 5."
PANDA_LEFT_OUT = "Section IV.B was not run: “adapter experiment panda” makes Fig. 6."


def scientific(value: float | int | None, digits: int = 2) -> str:
    """A number for people over any range; a dash where there is none.

    >>> scientific(2.13e-9).split(), scientific(0.5), scientific(None), scientific(0.0)
    (['2.1', '×', '10⁻⁹'], '0.50', '–', '0')
    """
    if value is None or not math.isfinite(value):
        return DASH
    if value == 0.0 or PLAIN_FROM <= abs(value) < PLAIN_TO:
        return number(value, digits)
    mantissa, power = f"{value:.{digits - 1}e}".split("e")
    shown = f"{mantissa} × 10{str(int(power)).translate(SUPERSCRIPTS)}"
    return shown.replace("-", "−").replace(" ", NARROW)


def with_unit(value: float | int | None, unit: str, digits: int = 2) -> str:
    """A number and its unit, on one line."""
    return f"{scientific(value, digits)} {unit}".replace(" ", NARROW).rstrip(NARROW)


def percent(fraction: float | None) -> str:
    """A relative error (eq. 20) in per cent."""
    return with_unit(None if fraction is None else 100.0 * fraction, "%")


def grouped(value: int) -> str:
    """A whole number, in groups of three from five digits on.

    >>> grouped(1500), grouped(375_000).split()
    ('1500', ['375', '000'])
    """
    return str(value) if abs(value) < PLAIN_TO else count(value)


def sentences(pieces: Sequence[str]) -> str:
    """Pieces of text as sentences, their numbers in readable form.

    >>> sentences(["1,500 tuned_on, 30 inputs", "up to 3e+02.", "θ is next"])
    'Tuned on 1500, 30 inputs. Up to 300. θ is next.'
    """
    return " ".join(_sentence(piece) for piece in pieces if piece.strip())


def _sentence(piece: str) -> str:
    said = piece.strip().rstrip(".")
    said = re.sub(r"([\d,]*\d) (tuned_on|rank)\b", r"\2 \1", said).replace("_", " ")
    said = re.sub(r"\b\d{1,3}(?:,\d{3})+\b", lambda x: grouped(int(x[0].replace(",", ""))), said)
    said = re.sub(r"\b\d{5,}\b", lambda x: grouped(int(x[0])), said)
    said = re.sub(r"(\d)%", rf"\1{NARROW}%", said)
    said = re.sub(  # a number with an exponent, with as many digits
        r"\b\d+(?:\.(\d+))?e[+-]\d+\b", lambda x: scientific(float(x[0]), 1 + len(x[1] or "")), said
    )
    said = re.sub(r"(?<![\w.])-(?=\d)", "−", said)
    first = said[:1]
    return f"{first.upper() if first.isascii() else first}{said[1:]}."  # θ stays small


def ours_text(item: Stated) -> str:
    """What we measured, with its unit; words where it was not run."""
    value = item.ours
    if value is None:
        return "not run"
    if isinstance(value, str):
        return value
    if isinstance(value, int) or (value.is_integer() and abs(value) < PLAIN_TO):
        return f"{grouped(int(value))} {item.unit}".replace(" ", NARROW).rstrip(NARROW)
    return with_unit(value, item.unit, 3)


def best_baseline(atlas: AtlasResults) -> LearnerScores | None:
    """Of the paper's three the one with the smallest median error on the control set."""
    return next((x for x in atlas.learners if x.name == atlas.numbers["best_baseline"]), None)


def advantage(atlas: AtlasResults) -> float | None:
    """How many times smaller FOPnet's median control error is than the best baseline's, both of
    the joints that the baselines learn."""
    ratio = atlas.numbers["control_error_ratio_to_best_baseline"]
    return ratio if ratio is not None and math.isfinite(ratio) and ratio > 0.0 else None


def converged(panda: PandaResults) -> Stated:
    """When λ had converged, beside what the paper says."""
    return next(item for item in panda.stated if item.key == "lambda_converged_s")


def last_ratio(panda: PandaResults) -> float | None:
    """The last torque error over that of batch least squares."""
    finite = panda.torque_error[np.isfinite(panda.torque_error)]
    return float(finite[-1]) if len(finite) else None


def headline(atlas: AtlasResults | None, panda: PandaResults | None) -> str:
    """The outcome: a sentence for each experiment."""
    return f"{atlas_sentence(atlas)} {panda_sentence(panda)}"


def atlas_sentence(atlas: AtlasResults | None) -> str:
    """How FOPnet does on ATLAS, beside the best of the paper's baselines."""
    if atlas is None:
        return "ATLAS was not run."
    said = (
        f"On control trajectories {OURS} predicts the joint torques of ATLAS "
        f"({atlas.tree.n} joints) with a median relative error of "
        f"{percent(atlas.learners[0].median['control'])}"
    )
    best, times = best_baseline(atlas), advantage(atlas)
    if best is None:
        return f"{said}; the baselines were not run."
    theirs = f"{best.name}, {percent(best.median['control'])}"
    if times is None:
        return f"{said}; the best of the paper's baselines has {theirs}."
    held = f"{scientific(max(times, 1.0 / times))} times {'smaller' if times >= 1.0 else 'larger'}"
    where = f"on the arm ({len(atlas.arm)} joints)"
    return f"{said}; {where} it is {held} than that of the paper's best baseline ({theirs})."


def panda_sentence(panda: PandaResults | None) -> str:
    """How fast and how well the Panda learns itself."""
    if panda is None:
        return "The Panda was not run."
    at, joined = converged(panda), ", and"
    if at.ours is None:
        said, joined = "The simulated Panda's λ did not converge", "; in the end"
    else:
        after_s, theirs = with_unit(float(at.ours), "s"), at.paper.replace(" ", NARROW)
        said = (
            f"The simulated Panda's λ converges {after_s} after the first motion "
            f"(the paper's real arm: {theirs})"
        )
    ratio = last_ratio(panda)
    if ratio is None or not math.isfinite(panda.theta_start_s):
        return f"{said}; its θ was not learned."
    error = f"its torque error is {scientific(ratio, 3)}"
    return f"{said}{joined} {error} times that of batch least squares."
