"""Where the links of an arm are, as ROS tells it: transforms from parents to children."""

from __future__ import annotations

import numpy as np

from adapter.model.self_model import SelfModel
from adapter.model.spatial import (
    Array,
    matrix_from_zxz,
    quaternion_from_matrix,
    quaternion_product,
    rot_z,
    z_to_axis,
)
from adapter.model.tree import BASE
from adapter.physics.identifiability import frame_observability

WORLD = "world"
_HALF_TURN = (0.0, 0.0, 0.0, 1.0)  # about z


class ArmFrames:
    """One arm's frames, every name with a prefix, so that two arms stand beside each other.

    The frames are those of the robot's URDF: of a joint about another axis than z, the model's
    frame is turned back (`SelfModel.axis`).

    Args:
        model: the arm; its frames and names.
        prefix: `documented` gives the frames documented/panda_link1, ...

    Attributes:
        fixed: (parent, child) of what does not move: the base in the world, what rides on links.
        fixed_rows: (k, 7) of these: x y z in m, quaternion x y z w.
        moving: (parent, child) of every link.
    """

    def __init__(self, model: SelfModel, prefix: str) -> None:
        tree = self._tree = model.tree
        self._axes = np.array([z_to_axis(axis) for axis in model.axis])
        links = [tree.base_name, *tree.link_names]
        names = [f"{prefix}/{link}" for link in links]
        turns = dict(zip(links, (np.eye(3), *self._axes), strict=True))
        self.moving = [(names[i + 1], names[j + 1]) for j, i in enumerate(tree.parent)]
        riding = [(f"{prefix}/{f.parent}", f"{prefix}/{f.name}") for f in model.frames]
        self.fixed = [(WORLD, names[0]), *riding]
        rotations = np.array([np.eye(3), *(turns[f.parent] @ f.rotation for f in model.frames)])
        places = np.array([np.zeros(3), *(turns[f.parent] @ f.position for f in model.frames)])
        self.fixed_rows = _rows(places, quaternion_from_matrix(rotations))
        self.place(matrix_from_zxz(model.lam[:, :3]), model.lam[:, 3:])

    @property
    def last(self) -> str:
        """Name of the last link's frame."""
        return self.moving[-1][1]

    def place(self, R0: Array, p: Array) -> None:
        """Take over joint frames R0 (n, 3, 3), p (n, 3) m, in their parents' at q = 0."""
        parents = np.array(self._tree.parent)
        before = np.where((parents == BASE)[:, None, None], np.eye(3), self._axes[parents])
        self._R0 = R0
        left = quaternion_from_matrix(before @ R0)
        right = quaternion_from_matrix(np.swapaxes(self._axes, 1, 2))
        half_turn = quaternion_product(quaternion_product(left, np.array(_HALF_TURN)), right)
        self._unturned, self._half_turn = quaternion_product(left, right), half_turn
        self._p = np.einsum("jab,jb->ja", before, p)

    def rows(self, q: Array) -> Array:
        """(n, 7) of every link in its parent at joint angles q (n,) rad."""
        c, s = np.cos(0.5 * q)[:, None], np.sin(0.5 * q)[:, None]
        turned = c * self._unturned + s * self._half_turn  # a product is linear in its factors
        return _rows(self._p, turned)

    def orientation_of_last(self, q: Array) -> Array:
        """(3, 3) of the last link's frame in the base's."""
        R, turned = np.eye(3), self._R0 @ rot_z(q)
        for j in self._tree.path_to(self._tree.n - 1):
            R = R @ turned[j]
        return np.asarray(R @ self._axes[-1].T)


def _rows(p: Array, quaternions: Array) -> Array:
    """Rows of `TransformsEncoder` from places and quaternions [w x y z]."""
    return np.concatenate([p, quaternions[:, 1:], quaternions[:, :1]], axis=1)


class ShownLambda:
    """Learned joint frames as they are shown beside the documented ones.

    What no motion of the links shows (how the first joint stands about gravity, where along its
    axis the second begins) is as the learner began, anyhow. It is moved to where the
    documentation has it, by a finite motion that changes no link's motion.
    """

    def __init__(self, model: SelfModel) -> None:
        self._freedom = frame_observability(model.tree, model.lam, model.gravity).freedom
        self.documented = matrix_from_zxz(model.lam[:, :3]), model.lam[:, 3:]

    def frames(self, lam: Array) -> tuple[Array, Array]:
        """R0 (n, 3, 3) and p (n, 3) m of a learned λ (n, 6)."""
        return self._freedom.nearest(matrix_from_zxz(lam[:, :3]), lam[:, 3:], *self.documented)
