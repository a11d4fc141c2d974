"""Where a load is: at the face that a tool is bolted to, its centre a little beyond."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from adapter.effects.base import Template
from adapter.effects.bodies import parameters_of
from adapter.errors import ModelError
from adapter.model.inertia import theta_from_body
from adapter.model.self_model import FixedFrame, SelfModel
from adapter.model.spatial import Array
from drivers.errors import choices

LOAD_KG = 4.0  # one standard deviation
MASSES_KG = (0.5, 1.5, 4.5)  # that are tried: how far off a load's moments may be grows with it
BEYOND_M, REACH_M = 0.08, 0.08  # of a load's centre from the face, and how far it may be elsewhere
UNKNOWN_REACH_M = 0.12  # where nobody says which way the hand points
FACES = ("tool0", "flange", "link8")  # how names of frames end that a tool is bolted to
CLOSE_M = 0.01  # a face so near to the last link's centre does not say it either


@dataclass(frozen=True, eq=False)
class Hand:
    """What is known of a load before the data.

    Attributes:
        centre: (3,) where its centre is likely to be, m, axes of the last link.
        reach_m: how far from there it may be along each axis, one standard deviation.
    """

    centre: Array = field(default_factory=lambda: np.zeros(3))
    reach_m: float = 2 * UNKNOWN_REACH_M

    def templates(self) -> tuple[Template, ...]:
        """Ways to look for a load: light, middling and heavy.

        Its coefficients are its mass at the likely centre, and by how much its first and second
        moments differ from those.
        """
        turn = np.eye(10)
        turn[0] = theta_from_body(1.0, self.centre, np.zeros((3, 3)))
        spread = self.reach_m * (2.0 * float(np.linalg.norm(self.centre)) + self.reach_m)
        return tuple(
            Template(
                (LOAD_KG, *[self.reach_m * m] * 3, *[spread * m] * 6),
                lambda x: parameters_of(x @ turn),
                f"about {m:g} kg",
                turn,
            )
            for m in MASSES_KG
        )


ANYWHERE = Hand()  # of an arm of which nothing is known


def hand_of(model: SelfModel) -> Hand:
    """The hand of a model's last link, its tool's included."""
    body, riding = model.theta_with_tool()[-1], hand_frame(model)
    com = body[1:4] / body[0] if body[0] > 0.0 else np.zeros(3)
    if riding.name != riding.parent:
        out = riding.position - com
        size = float(np.linalg.norm(out))
        if size > CLOSE_M:
            return Hand(riding.position + BEYOND_M * out / size, REACH_M)
        return Hand(riding.position, UNKNOWN_REACH_M)
    size = float(np.linalg.norm(com))
    return Hand(com * (1.0 + BEYOND_M / size) if size > CLOSE_M else com, UNKNOWN_REACH_M)


def hand_frame(model: SelfModel, name: str | None = None) -> FixedFrame:
    """The frame in which the load is told: the flange of the last link, where it has one.

    Args:
        name: of the frame or of the last link; where None, the one called as makers call it, else
            the first that rides on the last link, else the link itself.

    Raises:
        ModelError: nothing of that name rides on the last link; names what does.
    """
    last = model.tree.link_names[-1]
    own = FixedFrame(last, "", last, np.eye(3), np.zeros(3))
    riding = [frame for frame in model.frames if frame.parent == last]
    if name is not None:
        for frame in (own, *riding):
            if frame.name == name:
                return frame
        have = choices(name, [frame.name for frame in (own, *riding)])
        raise ModelError(f"no frame '{name}' rides on the last link; {have}")
    called = [frame for key in ("tool0", "flange") for frame in riding if frame.name.endswith(key)]
    return (*called, *riding, own)[0]
