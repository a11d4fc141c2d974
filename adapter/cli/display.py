"""The live line during a run; lives in a process of its own."""

from __future__ import annotations

from collections.abc import Callable

from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from adapter.realtime.showing import View
from adapter.runs.terminal import console


def make_display(duration_s: float) -> Callable[[View], None]:
    """A progress bar with the state of λ and θ beside it."""
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[state]}"),
        console=console,
        transient=True,
    )
    task = bar.add_task("live", total=duration_s, state="")
    bar.start()

    def show(view: View) -> None:
        state = ""
        if view.snapshot is not None:
            lam = "settled" if view.snapshot.lam_converged else "moving"
            theta = "settled" if view.snapshot.theta_converged else "moving"
            state = f"λ {lam}, θ {theta}, {view.snapshot.learned} learned"
        bar.update(task, completed=min(view.elapsed_s, duration_s), state=state)
        if view.done:
            bar.stop()

    return show
