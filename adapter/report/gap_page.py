"""The gap on one self-contained page: what is missing, how sure that is, what it brings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from adapter.gap.phrases import listed
from adapter.gap.result import GapResult, Leftover
from adapter.gap.words import (
    by_kind,
    fall,
    headline_parts,
    left_above_noise,
    signal_words,
    worst_joint,
)
from adapter.model.numbers import DASH, plain
from adapter.report.gap_panels import error_panels
from adapter.report.gap_signatures import signature_panels, unexplained_panels
from adapter.report.gap_tables import (
    carried_table,
    correction_ratio,
    correction_table,
    error_table,
    finding_rows,
    joint_matrix,
    rival_rows,
    tied,
    unseen_table,
)
from adapter.report.gap_trust import gap_checks, gap_steps
from adapter.report.html import fill, write_whole
from adapter.report.tables import Tile
from adapter.report.words import NARROW, capital

TEMPLATE = "gap.html"
WORTH = "torque error"  # how the clause begins that says what findings are worth
MOST_NAMED = 3  # recordings, beside the name of the arm
OURS = (
    "joint",
    "link",
    "the ",
    "something",
    "from ",
    "until ",
    "no ",
    "a spring",
    "all joints",
    WORTH,
    "but ",
)


def render_gap_page(result: GapResult, folder: Path | None = None) -> str:
    """The page as HTML text; parts that the result does not have are left out.

    `folder`: where the page and the result's figures are, for commands that take these.
    """
    return fill(TEMPLATE, context(result, folder))


def write_gap_page(result: GapResult, path: str | Path) -> Path:
    """Write the page, whole or not at all. Returns the path.

    Raises:
        RunFolderError: the file cannot be written.
    """
    return write_whole(path, render_gap_page(result, Path(path).parent))


def context(result: GapResult, folder: Path | None = None) -> dict[str, Any]:
    """What the template shows."""
    told = result.problem is None
    shown = _tiles(result) if told else []
    correction, ratio = correction_table(result), correction_ratio(result)
    found = "what was found" if result.findings else ""
    corrected = "the small correction of the inertias" if correction else ""
    largest = 0.0 if ratio is None or not ratio.size else float(np.abs(ratio).max())
    took = f"{result.wall_s:.1f} s" if result.wall_s > 0.0 else DASH
    return {
        "robot": result.model_name,
        "headline": _headline(result),
        "problem": not told,
        "recordings": _named(result.recordings),
        "several": len(result.recordings) > 1,
        "tiles": shown,
        "columns": max(len(shown), 1),
        "findings": finding_rows(result),
        "matrix": joint_matrix(result),
        "carried": carried_table(result),
        "contradictions": [capital(text) for text in result.contradictions],
        "told": told,
        "error_table": error_table(result) if told else None,
        "after_words": "with "
        + (" and ".join(filter(None, (found, corrected))) or "nothing added"),
        "errors": error_panels(result) if told else [],
        "signatures": signature_panels(result),
        "marked": any(f.interval_s[0] > 0.0 or not f.lasting for f in result.findings),
        "rollouts": bool(result.rollouts),
        "rivals": rival_rows(result),
        "unexplained": [_leftover(item) for item in result.unexplained],
        "unexplained_panels": unexplained_panels(result),
        "unseen": unseen_table(result),
        "correction": correction if told else None,
        "correction_words": ""
        if ratio is None or not told
        else f"The largest part is {largest:.1f} times the deviation that was expected beforehand.",
        "checks": gap_checks(result),
        "steps": gap_steps(result, folder),
        "notes": result.notes,
        "provenance": [
            ("Recordings", ", ".join(result.recordings) or DASH),
            ("Model", result.model_in),
            ("New model", result.model_out or "none was written"),
            ("Time taken", took),
        ],
    }


def _headline(result: GapResult) -> list[str]:
    """Sentences on a page: capital, arrow, no break before a unit."""
    parts = headline_parts(result)
    worth = [k for k, part in enumerate(parts) if part.startswith(WORTH)]
    if worth:  # right behind the first finding
        parts.insert(1, parts.pop(worth[0]))
    if result.problem is not None:
        return parts
    said = [capital(text) if text.startswith(OURS) else text for text in parts]
    return [f"{tied(text.replace(' -> ', ' → '))}." for text in said]


def _leftover(item: Leftover) -> str:
    begin, end = item.interval_s
    signals = [f"the {signal_words(name)} ({name})" for name in item.depends_on]
    times = item.rmse_nm / item.noise_floor_nm if item.noise_floor_nm > 0.0 else np.nan
    size = f", {plain(times, 2)} times its noise," if np.isfinite(times) else ""
    follows = f"that follow {listed(signals) or 'no signal'}"
    said = f"{plain(item.rmse_nm, 2)} N m{size} {follows}, from {begin:.1f} to {end:.1f} s"
    return tied(f"Joint {item.joint}: {said}.")


def _named(recordings: Sequence[str]) -> list[str]:
    """The first few, and how many more."""
    more = len(recordings) - MOST_NAMED
    return [*recordings[:MOST_NAMED], *([f"{more} more"] if more > 0 else [])]


def _tiles(result: GapResult) -> list[Tile]:
    before, after = result.before, result.after
    noise = np.asarray(result.noise_floor_nm, dtype=float)
    tiles = [Tile("Effects found", str(len(by_kind(result.findings))), _left_words(result))]
    worst = worst_joint(result)
    if worst is not None:
        first, last = before.torque_rmse_nm[worst], after.torque_rmse_nm[worst]
        fell = f"{fall(first, last)} N m".replace("->", "→").replace(" ", NARROW)
        tiles.append(Tile("Torque error", fell, f"joint {worst + 1}, the worst; rms"))
    if worst is not None and noise[worst] > 0.0:
        tiles.append(
            Tile(
                "In units of its noise",
                _arrow(first / noise[worst], last / noise[worst], "×"),
                tied(f"joint {worst + 1}, noise {plain(noise[worst], 2)} N m"),
            )
        )
    off, off_after = before.rollout_rmse_rad, after.rollout_rmse_rad
    if off is not None and np.isfinite(off).any():
        j = int(np.nanargmax(off))
        left = np.nan if off_after is None else off_after[j]
        value, note = _arrow(1e3 * off[j], 1e3 * left, "mrad"), f"joint {j + 1}, rms within 0.5 s"
        tiles.append(Tile("Forward simulation off by", value, tied(note)))
    return tiles


def _left_words(result: GapResult) -> str:
    """What stays beside the findings: named as unexplained, or above the noise without a name."""
    left = len(result.unexplained)
    if left:
        return f"{left} thing{'' if left == 1 else 's'} unexplained"
    return left_above_noise(result) or "nothing above the noise left"


def _arrow(before: float, after: float, unit: str) -> str:
    return f"{plain(before, 2)} → {plain(after, 2)} {unit}".replace(" ", NARROW)
