"""How far a joint frame may go and its link still moves the same: finite, not linearised.

Link motion (eqs. 8a-8d) shows frame j by what its parent does. Where the parent always turns about
one line fixed in it (the first link of most arms, upright), frame j may be turned about that line,
by any angle, and shifted along it; where the parent rests, it may stand anywhere and turn about
gravity. Such changes act from the left, R <- Q R, p <- c + Q (p - c) + t, with the line and the
shifts t a matter of the parent's motion alone: the same for all frames that move alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.model.spatial import Array, exp_rotation, rot_z, skew
from adapter.model.tree import BASE, Tree

# Share of turns below which a hidden direction is a shift alone; noise tilts directions a little,
# and a lever of 20 m would be needed for a turn with as little.
PURE_SHIFT = 0.05


@dataclass(frozen=True)
class Freedom:
    """What of joint frames (n of them) cannot be told, in the axes of each parent.

    Attributes:
        shifts: (n, 3, 3) projectors on the shifts that may be anything.
        axis: (n, 3) unit, of the line about which a frame may turn; zero where there is none.
        point: (n, 3) on that line, m.
        any_turn: (n,) bool, where a frame may stand in any way.
    """

    shifts: Array
    axis: Array
    point: Array
    any_turn: np.ndarray

    @classmethod
    def of(cls, hidden: Array, p: Array) -> Freedom:
        """From what small turns and shifts show.

        Args:
            hidden: (n, 6, 6) projectors on the [turn; shift] of frame j, in the parent's axes,
                that change nothing; p: (n, 3) where the frames are, m.
        """
        n = len(p)
        found = cls(np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n, bool))
        for j in range(n):
            found._read(j, hidden[j], p[j])
        return found

    def _read(self, j: int, hidden: Array, p: Array) -> None:
        values, vectors = np.linalg.eigh(hidden)
        basis = vectors[:, values > 0.5]
        if not basis.shape[1]:
            return
        _, turning, mix = np.linalg.svd(basis[:3])
        turns = int((turning > PURE_SHIFT).sum())
        basis = basis @ mix.T
        still, _ = np.linalg.qr(basis[3:, turns:])
        self.shifts[j] = still @ still.T
        self.any_turn[j] = turns > 1
        if turns == 1:
            size = float(np.linalg.norm(basis[:3, 0]))
            axis, shift = basis[:3, 0] / size, basis[3:, 0] / size
            self.axis[j] = axis
            self.point[j] = p - np.cross(shift - self.shifts[j] @ shift, axis)

    @classmethod
    def none(cls, n: int) -> Freedom:
        """That of n frames of which everything shows."""
        return cls.of(np.zeros((n, 6, 6)), np.zeros((n, 3)))

    def joint(self, j: int) -> Freedom:
        """That of one frame, n = 1."""
        one = slice(j, j + 1)
        return Freedom(self.shifts[one], self.axis[one], self.point[one], self.any_turn[one])

    def hidden(self, p: Array) -> Array:
        """(n, 6, 6) projectors on the turns and shifts that change nothing, of frames at p."""
        out = np.zeros((len(p), 6, 6))
        for j, lever in enumerate(p - self.point):
            turns = np.eye(3) if self.any_turn[j] else self.axis[j][None]
            directions = np.zeros((len(turns) + 3, 6))
            directions[: len(turns), :3] = turns
            directions[: len(turns), 3:] = np.cross(turns, lever) @ (np.eye(3) - self.shifts[j])
            directions[len(turns) :, 3:] = self.shifts[j]
            _, values, rows = np.linalg.svd(directions)
            kept = rows[: int((values > 0.5).sum())]
            out[j] = kept.T @ kept
        return out

    def words(self, tree: Tree) -> list[str]:
        """What cannot be told of each frame that has a freedom, for people."""
        found = []
        for j, joint in enumerate(tree.joint_names):
            parts = ["its orientation"] if self.any_turn[j] else []
            if self.axis[j].any():
                parts.append(f"its turn about {_numbers(self.axis[j])}")
            size = round(float(np.trace(self.shifts[j])))
            if size:
                _, _, rows = np.linalg.svd(self.shifts[j])
                parts.append("its place" + ("" if size == 3 else " along " + _numbers(rows[0])))
            if parts:
                i = tree.parent[j]
                parent = tree.base_name if i == BASE else tree.link_names[i]
                found.append(f"{joint}: {' and '.join(parts)} in {parent}")
        return found

    def nearest(self, R: Array, p: Array, to_R: Array, to_p: Array) -> tuple[Array, Array]:
        """Of all frames that move as (R, p) do, those nearest to others.

        Near is by |turn|² + |shift|², rad and m, for small turns; for large ones the chord stands
        for the angle, which leaves one nearest turn and gives it in closed form.

        Args:
            R (..., n, 3, 3), p (..., n, 3): frames; to_R, to_p: where they shall be.
        """
        u, c = self.axis, self.point
        seen = np.eye(3) - self.shifts
        x, y = (np.einsum("jab,...jb->...ja", seen, at - c) for at in (p, to_p))
        turn = R @ np.swapaxes(to_R, -1, -2)
        along = np.einsum("ja,...ja->...j", u, x) * np.einsum("ja,...ja->...j", u, y)
        level = np.einsum("...jaa->...j", turn) - np.einsum("ja,...jab,jb->...j", u, turn, u)
        level = level + 2.0 * (np.einsum("...ja,...ja->...j", x, y) - along)
        across = np.einsum("jab,...jba->...j", skew(u), turn)
        across = across + 2.0 * np.einsum("...ja,...ja->...j", y, np.cross(u, x))
        Q = exp_rotation(np.arctan2(across, level)[..., None] * u)
        moved = np.where(self.any_turn[:, None, None], to_R, Q @ R)
        placed = c + np.einsum("...jab,...jb->...ja", Q, p - c)
        return moved, placed + np.einsum("jab,...jb->...ja", self.shifts, to_p - placed)


def slid_to(
    tree: Tree, gravity: Array, frames: tuple[Array, Array], to: tuple[Array, Array]
) -> tuple[Array, Array]:
    """The same axes, with each link's frame slid along its own and turned about it.

    Sensors mounted anyhow on the links tell no two such arms apart, nor where a link stands on the
    base and how it is turned about gravity: there its first child says what is close.

    Args:
        gravity: (3,) in axes of the base; frames: R (n, 3, 3) and p (n, 3) m; to: those that the
            frames shall come close to.
    """
    R, p = frames[0].copy(), frames[1].copy()
    turn, slide = np.zeros(tree.n), np.zeros(tree.n)
    z = np.array([0.0, 0.0, 1.0])
    for j, i in enumerate(tree.parent):
        if i != BASE:
            back = rot_z(-turn[i])
            R[j], p[j] = back @ R[j], back @ (p[j] - slide[i] * z)
        near = to[0][j].T @ R[j]
        turn[j] = np.arctan2(near[0, 1] - near[1, 0], near[0, 0] + near[1, 1])
        slide[j] = (to[1][j] - p[j]) @ R[j, :, 2]
        if i == BASE and tree.children[j]:
            k = tree.children[j][0]
            turn[j], slide[j] = _about_parent((R[k], p[k]), (to[0][k], to[1][k]))
        R[j] = R[j] @ rot_z(turn[j])
        p[j] += slide[j] * R[j, :, 2]
        if i == BASE:
            up = gravity / np.linalg.norm(gravity)
            off = R[j] @ to[0][j].T
            yaw = np.arctan2(np.sum(skew(up) * off), np.trace(off) - up @ off @ up)
            R[j], p[j] = exp_rotation(-yaw * up) @ R[j], to[1][j]
    return R, p


def _about_parent(frame: tuple[Array, Array], to: tuple[Array, Array]) -> tuple[float, float]:
    """By how much a frame is ahead of another about and along its parent's z, its own z apart."""
    (R, p), (to_R, to_p) = frame, to
    off = R @ to_R.T
    if np.hypot(*to_R[:2, 2]) > PURE_SHIFT:
        turn = np.arctan2(R[1, 2], R[0, 2]) - np.arctan2(to_R[1, 2], to_R[0, 2])
    else:
        turn = np.arctan2(off[1, 0] - off[0, 1], off[0, 0] + off[1, 1])
    across = np.array([0.0, 0.0, 1.0]) - to_R[2, 2] * to_R[:, 2]
    ahead = (rot_z(-turn) @ p - to_p) @ across
    return float(turn), float(ahead / max(across @ across, PURE_SHIFT**2))


def _numbers(axis: Array) -> str:
    """An axis, its largest number positive."""
    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
    return "[" + " ".join(f"{x:.3g}" for x in np.round(axis, 3) + 0.0) + "]"
