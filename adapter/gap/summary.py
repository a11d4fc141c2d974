"""The outcome as lines for a terminal, in rich markup."""

from __future__ import annotations

import numpy as np
from rich.markup import escape

from adapter.gap.phrases import plain
from adapter.gap.result import Finding, GapResult
from adapter.gap.words import headline, leftover_sentence, percent, rivals, sentence
from adapter.records import Array

LABEL = 26  # characters


def console_summary(result: GapResult) -> list[str]:
    """Headline, findings, figures by joint, what to do next; for `rich.console.Console.print`."""
    color = "red" if result.problem is not None else "bold"
    lines = [f"[{color}]{escape(headline(result))}[/{color}]"]
    for finding in result.findings:
        lines += _finding(finding)
    lines += [f"[yellow]?[/yellow] {escape(leftover_sentence(x))}" for x in result.unexplained]
    lines += _figures(result)
    lines += [f"[cyan]next[/cyan] {escape(text)}" for text in result.what_next]
    lines += [f"[dim]note[/dim] {escape(text)}" for text in result.notes]
    if result.model_out is not None:
        lines.append(f"model {escape(result.model_out)}")
    return lines


def _finding(finding: Finding) -> list[str]:
    sure = f"evidence {percent(finding.evidence)}, z {plain(finding.detectability, 2)}"
    lines = [f"[green]•[/green] {escape(sentence(finding))} [dim]({sure})[/dim]"]
    other = rivals(finding)
    return [*lines, f"  [dim]{escape(other)}[/dim]"] if other else lines


def _figures(result: GapResult) -> list[str]:
    """One line per figure, joints in order; none where nothing is known."""
    before, after = result.before, result.after
    rows: list[tuple[str, Array | None, float]] = [
        ("torque noise, N m", result.noise_floor_nm, 1.0),
        ("torque error before, N m", before.torque_rmse_nm, 1.0),
        ("             after, N m", after.torque_rmse_nm, 1.0),
        ("rollout error before, mrad", before.rollout_rmse_rad, 1e3),
        ("              after, mrad", after.rollout_rmse_rad, 1e3),
    ]
    return [
        f"{name:<{LABEL}} " + " ".join(f"{plain(factor * x, 3):>7}" for x in values)
        for name, values, factor in rows
        if values is not None and np.isfinite(values).any()
    ]
