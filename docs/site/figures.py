"""Pictures of the site as SVG: what can be identified (of the Panda), and the project's rooms.

    python docs/site/figures.py FOLDER

draws all of them.
"""

from __future__ import annotations

import io
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import grimp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from adapter.model.robots import documented
from adapter.model.spatial import Array
from adapter.physics.identifiability import (
    base_parameters,
    frame_observability,
    random_regressor,
)

TURNS_AND_SHIFTS = ("turn x", "turn y", "turn z", "shift x", "shift y", "shift z")
PARAMETERS = ("m", "mX", "mY", "mZ", "XX", "XY", "XZ", "YY", "YZ", "ZZ")
NEVER, TOGETHER, ALONE = 0, 1, 2
COLORS = ListedColormap(["#d9dde0", "#f0b27a", "#0a7a86"])
WORDS = ("never shown", "shown in a sum with others", "shown by itself")


def lambda_shown() -> str:
    """Which turns and shifts of the Panda's joint frames the motion of its links shows."""
    panda = documented("panda")
    seen = frame_observability(panda.tree, panda.lam, panda.gravity)
    share = np.diagonal(seen.projectors, axis1=1, axis2=2)
    kinds = np.where(seen.flags, ALONE, np.where(share > 1e-6, TOGETHER, NEVER))
    title = f"λ of an upright Panda: {seen.rank} of {kinds.size} numbers show"
    return _matrix(kinds, [f"joint {j + 1}" for j in range(panda.tree.n)], TURNS_AND_SHIFTS, title)


def theta_shown() -> str:
    """Which inertial parameters of the Panda's links its joint torques show."""
    panda = documented("panda")
    base = base_parameters(panda.tree, panda.lam, panda.gravity)
    share = np.sum(base.basis**2, axis=1).reshape(panda.theta.shape)
    kinds = np.where(share > 1.0 - 1e-6, ALONE, np.where(share > 1e-6, TOGETHER, NEVER))
    title = f"θ of an upright Panda: {base.rank} combinations of {kinds.size} numbers show"
    return _matrix(kinds, [f"link {j + 1}" for j in range(panda.tree.n)], PARAMETERS, title)


def same_torque() -> str:
    """Two different sets of bodies that need the same torques: masses move along the chain."""
    panda = documented("panda")
    base = base_parameters(panda.tree, panda.lam, panda.gravity)
    unseen = np.zeros_like(panda.theta)
    unseen[3, 0] = 1.0  # the part of link 4's mass that no torque shows
    flat = unseen.ravel() - base.basis @ (base.basis.T @ unseen.ravel())
    other = panda.theta + (flat / np.abs(flat.reshape(-1, 10)[:, 0]).max()).reshape(-1, 10)
    _, Y = random_regressor(panda.tree, panda.lam, panda.gravity, samples=1000, seed=1)
    apart = float(np.abs(Y @ (other - panda.theta).ravel()).max())
    figure, (ax,) = _figure(6.2, 2.6)
    at = np.arange(panda.tree.n) + 1.0
    ax.bar(at - 0.2, panda.theta[:, 0], 0.38, color="#0a7a86", label="as documented")
    ax.bar(at + 0.2, other[:, 0], 0.38, color="#f0b27a", label="other bodies")
    ax.set(xlabel="link", ylabel="mass, kg", xticks=at)
    ax.legend(frameon=False, ncols=2, loc="upper right")
    ax.set_ylim(0.0, 6.2)
    ax.set_title(
        f"Torques of both on 1000 random instants differ by at most {apart:.0e} N m", loc="left"
    )
    return _svg(figure)


def speeds_tell() -> str:
    """Why friction needs several speeds: two laws that agree at one speed."""
    speeds = np.linspace(-1.0, 1.0, 401)
    coulomb, viscous = 0.4 * np.tanh(speeds / 0.02), 0.8 * speeds
    figure, axes = _figure(7.4, 2.7, 2)
    for ax, at, words in (
        (axes[0], np.array([-0.5, 0.5]), "one speed, both ways: they cannot be told apart"),
        (axes[1], np.array([-0.9, -0.5, -0.2, 0.2, 0.5, 0.9]), "three speeds: the law is named"),
    ):
        ax.plot(speeds, coulomb, color="#0a7a86", label="Coulomb, 0.4 N m")
        ax.plot(speeds, viscous, color="#c2671b", label="viscous, 0.8 N m s/rad")
        ax.plot(at, np.sign(at) * 0.4, "o", color="#223", label="measured")
        ax.set(xlabel="joint speed, rad/s", title=words)
    axes[0].set_ylabel("torque not explained, N m")
    axes[0].legend(frameon=False, loc="upper left")
    return _svg(figure)


def shapes_of_gaps() -> str:
    """What a residual looks like by its cause, against the signal that it follows."""
    speed, turn = np.linspace(-1.0, 1.0, 301), np.linspace(-np.pi, np.pi, 301)
    steps = np.tanh(speed / 0.02)
    pictures: tuple[tuple[str, str, Array, Array], ...] = (
        ("Coulomb friction", "speed, rad/s", speed, 0.4 * steps),
        (
            "Stribeck friction",
            "speed, rad/s",
            speed,
            (0.3 + 0.3 * np.exp(-((speed / 0.2) ** 2))) * steps,
        ),
        ("viscous friction", "speed, rad/s", speed, 0.5 * speed),
        ("motor inertia", "acceleration, rad/s²", speed, 0.5 * speed),
        ("load at the hand", "position, rad", turn, 0.5 * np.cos(turn)),
        ("torque ripple", "position, rad", turn, 0.3 * np.sin(5 * turn)),
        ("offset of the sensor", "anything", speed, np.full_like(speed, 0.3)),
        ("gain of the sensor", "torque, N m", speed, 0.4 * speed),
    )
    figure, axes = _figure(7.8, 3.8, 4, 2)
    for ax, (title, label, x, y) in zip(axes, pictures, strict=True):
        ax.axhline(0.0, color="#bbb", linewidth=0.7)
        ax.plot(x, y, color="#0a7a86")
        ax.set(title=title, xlabel=label, xticks=[], yticks=[], ylim=(-0.7, 0.7))
    axes[0].set_ylabel("residual, N m")
    axes[4].set_ylabel("residual, N m")
    return _svg(figure)


def rooms() -> str:
    """How many imports lead from each room to each other, in the order that pyproject.toml sets."""
    text = (Path(__file__).parents[2] / "pyproject.toml").read_text("utf-8")
    (contract,) = (
        x for x in tomllib.loads(text)["tool"]["importlinter"]["contracts"] if "layers" in x
    )
    layers = [x.strip() for layer in contract["layers"] for x in layer.split("|")]
    graph = grimp.build_graph("adapter", "drivers", "sim", cache_dir=None)
    names = [x for x in layers if graph.find_children(x)] + ["sim", "drivers"]
    within = {m: k for k, x in enumerate(names) for m in (x, *graph.find_descendants(x))}
    counts = np.zeros((len(names), len(names)), dtype=int)
    for module, row in within.items():
        for other in graph.find_modules_directly_imported_by(module):
            counts[row, within.get(other, row)] += 1
    np.fill_diagonal(counts, 0)
    figure, (ax,) = _figure(8.2, 6.4)
    ax.imshow(np.sqrt(counts), cmap="GnBu", vmax=9.0)
    for row, column in np.argwhere(counts):
        ax.text(column, row, counts[row, column], ha="center", va="center", fontsize=7.5)
    ax.plot([-0.5, len(names) - 0.5], [-0.5, len(names) - 0.5], color="#889", linewidth=0.8)
    short = [x.removeprefix("adapter.") for x in names]
    ax.set_xticks(range(len(names)), short, rotation=45, ha="right")
    ax.set_yticks(range(len(names)), short)
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)
    ax.set(ylabel="imports", xlabel="is imported")
    ax.set_title(
        "Imports between rooms: none stands below the line, so there is no circle", loc="left"
    )
    return _svg(figure)


def _matrix(kinds: Array, rows: list[str], columns: tuple[str, ...], title: str) -> str:
    figure, (ax,) = _figure(7.0, 0.36 * len(rows) + 1.3)
    ax.imshow(kinds, cmap=COLORS, vmin=NEVER, vmax=ALONE, aspect="auto")
    ax.set_xticks(range(len(columns)), columns)
    ax.set_yticks(range(len(rows)), rows)
    ax.set_xticks(np.arange(len(columns) - 1) + 0.5, minor=True)
    ax.set_yticks(np.arange(len(rows) - 1) + 0.5, minor=True)
    ax.grid(which="minor", color="white", linewidth=2.0)
    ax.tick_params(which="both", length=0)
    ax.spines[:].set_visible(False)
    for kind, words in enumerate(WORDS):
        if not (kinds == kind).any():
            continue
        ax.plot([], [], "s", color=COLORS(kind), markersize=9, label=words)
    ax.legend(frameon=False, ncols=3, loc="upper center", bbox_to_anchor=(0.45, -0.1))
    ax.set_title(title, loc="left")
    return _svg(figure)


def _figure(
    width: float, height: float, columns: int = 1, rows: int = 1
) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasSVG(figure)
    axes = list(np.ravel(figure.subplots(rows, columns)))
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.title.set_fontsize(9.0)
        ax.xaxis.label.set_fontsize(8.5)
        ax.yaxis.label.set_fontsize(8.5)
        ax.tick_params(labelsize=8.0)
    return figure, axes


def _svg(figure: Figure) -> str:
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    return text.getvalue()


FIGURES: dict[str, Callable[[], str]] = {
    "lambda-shown": lambda_shown,
    "theta-shown": theta_shown,
    "same-torque": same_torque,
    "speeds-tell": speeds_tell,
    "shapes-of-gaps": shapes_of_gaps,
    "rooms": rooms,
}

if __name__ == "__main__":
    for name, draw in FIGURES.items():
        Path(sys.argv[1], f"{name}.svg").write_text(draw())
