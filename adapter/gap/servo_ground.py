"""What the hand of a position-controlled arm comes down on: a table, found from its servos' errors.

Where it does, several joints are held at once, each against its command, and pushed along with one
another. No servo's number explains that, and fitted as one it spoils them all. So the ground and
all joints' servos are fitted together, by output error, and the ground stays if it foretells blocks
of time that the fit has not seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from adapter.gap.servo_fit import (
    ALIKE,
    ALL_FREE,
    LEAST,
    MILLI,
    NUDGE,
    JointTask,
    blocks,
    chi2_unit,
    first_guess,
    fit_joint,
    misfit,
    robust_fit,
)
from adapter.gap.servo_kernels import DELAY, NO_GROUND, A, Ground
from adapter.gap.servo_signals import over_ground
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm

# steps of point (m), height (m), ln of the root, coefficient of friction
SIZE = np.array([0.02, 0.02, 0.02, 0.01, 0.5, 0.3])
OWN = len(SIZE)  # the ground's numbers
RUBS, RUBS_STD = 0.4, 0.3  # of plastics and metals on tables, handbooks of tribology
FAR_M, REACH_M = 0.05, 0.05  # what touches is so far beyond the link's centre, and around there
TIP_M = 0.01  # around a documented tip: a finger is twice as wide
# starts: the point; share of time that it touches; one standard deviation of its height from there
BEYOND_M, LOWEST, HEIGHT_M = (0.0, 0.05, 0.1), (0.02, 0.2), 0.1
STIFF, YIELDS = 1e3, 5.0  # N/m, table and arm together; a factor of its root, one std deviation
ROUGH, FINE, FINALISTS = 6, 30, 2  # steps of a fit from each start, and of how many of the best
# what the ground explains beside the servos, on unseen blocks, of a joint that it holds: where a
# real arm touches a table, shares of 0.68 to 0.9 on two or three joints; else on one at most
PAYS_CHI2, PAYS_SHARE = 25.0, 0.5
SETTLED = 1e-4  # of the cost: friction's kinks make the way down to it long
PLAIN = DELAY + 1  # numbers of each servo that are fitted along with it
LEAST_JOINTS = 2  # that it holds: one alone may have a servo of another kind


Tip = tuple[int, Array]  # link (from 0), point (3,) m in its frame


@dataclass(frozen=True, eq=False)
class _Together:
    """All joints of an arm on some recordings, with something under the hand.

    Attributes:
        arm: its rigid part; tasks: of all its joints, without ground; link: (from 0) that touches.
        usual, std: (6,) of the ground's numbers before the data, and one standard deviation.
    """

    arm: RigidArm
    tasks: Sequence[JointTask]
    link: int
    usual: Array
    std: Array

    @cached_property
    def middles(self) -> list[Array]:
        """(m, n) rad in the middle of each step, as measured, by recording."""
        return _middles(self.tasks)

    def ground(self, y: Array) -> Ground:
        """Of (6,) numbers in steps of `SIZE`."""
        x, up = y * SIZE, -self.arm.gravity / np.linalg.norm(self.arm.gravity)
        point = np.ascontiguousarray(x[:3])
        root = float(np.exp(np.clip(x[4], -9.0, 9.0)))
        return Ground(self.link, point, up, float(x[3]), root, float(x[5]))

    def under(self, ground: Ground) -> list[JointTask]:
        """The tasks with it."""
        tables = []
        for q in self.middles:
            lift, above, push = over_ground(self.arm, ground, q)
            tables.append((lift, above[:, None] - lift * q, push))
        found = []
        for task in self.tasks:
            at, pairs = task.joint, zip(task.loads, tables, strict=True)
            columns = [[np.ascontiguousarray(x[:, at]) for x in table] for _, table in pairs]
            loads = [
                load._replace(lift=lift, gap=gap, push=push)
                for load, (lift, gap, push) in zip(task.loads, columns, strict=True)
            ]
            found.append(replace(task, loads=loads))
        return found

    def fit(self, y: Array, x: Array, rounds: int) -> tuple[Array, Array, float]:
        """Ground (6,) and servos (n, 6) that explain the readings best, and what they leave."""
        scale = np.maximum(np.abs(x), LEAST)[:, :PLAIN]
        units = [chi2_unit(task, own) for task, own in zip(self.tasks, x, strict=True)]
        held = MILLI * float(np.sqrt(np.median(units)))  # what a prior standard deviation weighs
        edges = np.cumsum([0, *(sum(take.sum() for take in task.rows) for task in self.tasks)])

        def servos_of(z: Array) -> Array:
            return np.hstack([z[OWN:].reshape(scale.shape) * scale, x[:, PLAIN:]])

        def left(z: Array) -> Array:
            servos, tasks = servos_of(z), self.under(self.ground(z[:OWN]))
            rows = [MILLI * task.fitted(own) for task, own in zip(tasks, servos, strict=True)]
            off = (z[:OWN] * SIZE - self.usual) / self.std
            return np.concatenate([*rows, held * off])

        def slopes(z: Array, here: Array) -> Array:
            servos = servos_of(z)
            out = np.zeros((len(here), len(z)))
            for k in range(OWN):
                out[:, k] = (left(z + NUDGE * (np.arange(len(z)) == k)) - here) / NUDGE
            for j, task in enumerate(self.under(self.ground(z[:OWN]))):
                rows = slice(edges[j], edges[j + 1])
                for k in range(PLAIN):
                    step = NUDGE * scale[j, k] * (np.arange(x.shape[1]) == k)
                    moved = MILLI * task.fitted(servos[j] + step)
                    out[rows, OWN + PLAIN * j + k] = (moved - here[rows]) / NUDGE
            return out

        least, most = np.zeros_like(scale), np.full_like(scale, np.inf)
        gain = float(np.median(x[:, A]))
        least[:, A], most[:, A] = gain / ALIKE, gain * ALIKE
        ends = [
            np.concatenate([np.full(OWN - 1, outside), [rubs], (own / scale).ravel()])
            for own, outside, rubs in ((least, -np.inf, 0.0), (most, np.inf, np.inf))
        ]
        z = np.clip(np.concatenate([y, (x[:, :PLAIN] / scale).ravel()]), *ends)
        z, cost = robust_fit(left, slopes, z, ends, (rounds, SETTLED), OWN)
        return z[:OWN], servos_of(z), cost

    def errors(self, ground: Ground, x: Array) -> Array:
        """(n,) what servos leave of the readings that are fitted, rad², see `misfit`."""
        pairs = zip(self.under(ground), x, strict=True)
        return np.array([misfit(task.fitted(own)) for task, own in pairs])

    def best_of(self, y: Array, servos: Sequence[Array]) -> Array:
        """(n, 12) of several, joint by joint those that leave least."""
        errors = np.array([self.errors(self.ground(y), x) for x in servos])
        return np.array(servos)[errors.argmin(axis=0), np.arange(self.arm.n)]


def _middles(tasks: Sequence[JointTask]) -> list[Array]:
    """(m, n) rad in the middle of each step, as measured, by recording."""
    motions = (track.smooth[0] for track in tasks[0].tracks)
    return [0.5 * (q[1:] + q[:-1]) for q in motions]


def _beyond(arm: RigidArm, link: int, way_m: float) -> Array:
    """(3,) m so far beyond the centre of mass of a link, in its frame."""
    centre = arm.theta[link, 1:4] / max(float(arm.theta[link, 0]), 1e-9)
    return np.asarray(centre * (1.0 + way_m / max(float(np.linalg.norm(centre)), 1e-9)))


def find_ground(
    arm: RigidArm, tasks: Sequence[JointTask], x: Array, tips: Sequence[Tip]
) -> tuple[Ground, Array]:
    """What the hand comes down on (`NO_GROUND` if nothing pays), and the servos (n, 12) beside it.

    Args:
        tasks: of all joints, without ground; x: (n, 12) servos fitted without.
        tips: documented, beyond which there is nothing: where there are some, nothing else touches.
    """
    found: list[tuple[float, _Together, Array, Array]] = []
    # a recording in which the hand is held spoils the servos; each alone is another start
    starts = [x]
    count = len(tasks[0].tracks)
    for i in range(count if count > 1 else 0):
        each = [
            replace(t, tracks=[t.tracks[i]], loads=[t.loads[i]], rows=[t.rows[i]]) for t in tasks
        ]
        starts.append(np.array([fit_joint(t, ALL_FREE, first_guess(t)).x for t in each]))
    points = [(*tip, tip[1], TIP_M) for tip in tips]
    for link, beyond in product(() if tips else range(max(arm.n - 2, 0), arm.n), BEYOND_M):
        points.append((link, _beyond(arm, link, beyond), _beyond(arm, link, FAR_M), REACH_M))
    up, motions = -arm.gravity / np.linalg.norm(arm.gravity), _middles(tasks)
    for link, point, usual, reach_m in points:
        level = Ground(link, point, up, 0.0, 1.0)
        heights = np.concatenate([over_ground(arm, level, q)[1] for q in motions])
        std = np.array([*[reach_m] * 3, HEIGHT_M, np.log(YIELDS), RUBS_STD])
        for height in np.quantile(heights, LOWEST):
            rest = height, 0.5 * np.log(STIFF), RUBS
            one = _Together(arm, tasks, link, np.array([*usual, *rest]), std)
            y, servos = np.array([*point, *rest]) / SIZE, x
            for _ in range(2):  # a joint that got stuck starts again, beside the ground as it is
                y, servos, cost = one.fit(y, one.best_of(y, [servos, *starts]), ROUGH)
            found.append((cost, one, y, servos))
    fine = []
    for _, one, y, servos in sorted(found, key=lambda x: x[0])[:FINALISTS]:
        y, servos, _ = one.fit(y, servos, FINE)
        beside = one.under(one.ground(y))
        fits = [
            np.array([fit_joint(t, ALL_FREE, own).x for t, own in zip(beside, each, strict=True)])
            for each in (servos, *starts)
        ]
        y, servos, cost = one.fit(y, one.best_of(y, fits), FINE)
        fine.append((cost, one, y, servos))
    _, one, y, servos = min(fine, key=lambda x: x[0])
    pairs = zip(one.under(one.ground(y)), servos, strict=True)
    gain, left = np.zeros((2, arm.n))
    unit = np.array([chi2_unit(task, own) for task, own in pairs])
    for half in (0, 1):
        seen, unseen = (
            replace(one, tasks=[blocks(task, part) for task in tasks]) for part in (half, 1 - half)
        )
        with_it, own = seen.fit(y, servos, ROUGH)[:2]
        pairs = zip(seen.tasks, x, strict=True)
        without = np.array([fit_joint(task, ALL_FREE, own).x for task, own in pairs])
        left += unseen.errors(NO_GROUND, without)
        gain += unseen.errors(NO_GROUND, without) - unseen.errors(seen.ground(with_it), own)
    if np.sum((gain > PAYS_CHI2 * unit) & (gain > PAYS_SHARE * left)) < LEAST_JOINTS:
        return NO_GROUND, x
    return one.ground(y), servos
