"""What is in an arm's way: something that holds joints, a wall before the hand, or a floor.

All are stiff springs with dampers that appear at an instant: joints are held at the angles they
have then (or next to them, which pushes), a wall stands across the way that the hand goes, so far
ahead. A floor is level, at a height; what touches it does not slide before it is pushed sideways by
half of what it is pressed.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from sim.dynamics import Frames, end_effector
from sim.effects import OBSTACLE, Effect
from sim.truth import FLANGE, Array

# Our choice: a joint gives 0.02 rad to 100 N m, a wall 5 mm to 100 N.
HOLD_STIFFNESS, HOLD_DAMPING = 5000.0, 50.0  # N m/rad, N m s/rad
WALL_STIFFNESS, WALL_DAMPING = 20000.0, 200.0  # N/m, N s/m
GRIP = 0.5  # friction of the floor


class Obstacles:
    """All that is in the way of one arm.

    Attributes:
        torque: (n,) N m that they put on the joints at present.
        force: N, of walls and floors on the hand.
    """

    def __init__(self, effects: Iterable[Effect], n: int) -> None:
        self._effects = [effect for effect in effects if effect.place == OBSTACLE]
        self._n = n
        self._places: dict[int, tuple[Array, float]] = {}
        self.torque, self.force = np.zeros(n), 0.0

    def __len__(self) -> int:
        return len(self._effects)

    def act(self, t: float, q: Array, dq: Array, frames: Frames) -> tuple[Array, Array]:
        """What they add to the motion at t (s): torque (n,) N m against the drives, and damping
        (n,) N m s/rad, at q, dq (n,) rad, rad/s.
        """
        against, damping = np.zeros(self._n), np.zeros(self._n)
        self.force = 0.0
        for number, effect in enumerate(self._effects):
            if not effect.acts(t):
                self._places.pop(number, None)
            elif effect.name in ("x_wall", "x_floor"):
                pose, J = end_effector(frames, q, FLANGE)
                touch = self._wall if effect.name == "x_wall" else self._floor
                push = touch(number, effect, pose[:3, 3], J[:3] @ dq)
                self.force += float(np.linalg.norm(push))
                against -= J[:3].T @ push
            else:
                joints = effect.columns(self._n)
                k = effect.number("k", HOLD_STIFFNESS)
                at, _ = self._places.setdefault(number, (q + effect.number("push") / k, 0.0))
                against[joints] += k * (q - at)[joints]
                damping[joints] += HOLD_DAMPING
        self.torque = -against - damping * dq
        return against, damping

    def _wall(self, k: int, effect: Effect, hand: Array, speed: Array) -> Array:
        """Force (3,) N of a wall upon the hand, which is there (m) at that speed (m/s)."""
        if k not in self._places:
            fast = float(np.linalg.norm(speed))
            if fast < 1e-3:
                return np.zeros(3)  # there is no way to stand across yet
            way = speed / fast
            self._places[k] = way, float(way @ hand) + effect.number("gap")
        way, at = self._places[k]
        depth = float(way @ hand) - at
        push = max(WALL_STIFFNESS * depth + WALL_DAMPING * float(way @ speed), 0.0)
        return np.asarray(-push * way if depth > 0.0 else np.zeros(3))

    def _floor(self, k: int, effect: Effect, hand: Array, speed: Array) -> Array:
        """Force (3,) N of a level plane upon the hand."""
        depth = effect.number("height") - hand[2]
        if depth <= 0.0:
            self._places.pop(k, None)
            return np.zeros(3)
        touched, _ = self._places.setdefault(k, (hand.copy(), 0.0))
        push = WALL_STIFFNESS * (touched - hand) - WALL_DAMPING * speed
        push[2] = max(WALL_STIFFNESS * depth - WALL_DAMPING * speed[2], 0.0)
        side, most = float(np.hypot(*push[:2])), GRIP * push[2]
        if side > most:  # it slides, and what it holds on to comes along
            push[:2] *= most / side
            touched[:2] = hand[:2] + push[:2] / WALL_STIFFNESS
        return push
