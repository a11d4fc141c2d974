"""What the hand of a position-controlled arm comes down on: a table, found from its servos' errors.

Where it does, several joints are held at once, each against its command, and pushed along with one
another. No servo's number explains that, and fitted as one it spoils them all. So the ground and
all joints' servos are fitted together, by output error, and the ground stays if it foretells blocks
of time that the fit has not seen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
    OUTLIER_RAD,
    JointTask,
    blocks,
    chi2_unit,
    first_guess,
    fit_joint,
    misfit,
)
from adapter.gap.servo_kernels import DELAY, NO_GROUND, A, Ground
from adapter.gap.servo_signals import over_ground
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm

SIZE = np.array([0.02, 0.02, 0.02, 0.01, 0.5])  # steps of point (m), height (m), ln of the root
FAR_M, REACH_M = 0.05, 0.05  # what touches is so far beyond the link's centre, and around there
BEYOND_M, LOWEST = (0.0, 0.05, 0.1), 0.02  # starts: the point; share of time that it touches
STIFF, YIELDS = 1e3, 5.0  # N/m, table and arm together; a factor of its root, one std deviation
ROUGH, FINE = 6, 30  # steps of a fit from each start, and of the best
# what the ground explains beside the servos, on unseen blocks, of a joint that it holds: where a
# real arm touches a table, shares of 0.68 to 0.9 on two or three joints; else on one at most
PAYS_CHI2, PAYS_SHARE = 25.0, 0.5
PLAIN = DELAY + 1  # numbers of each servo that are fitted along with it
LEAST_JOINTS = 2  # that it holds: one alone may have a servo of another kind


@dataclass(frozen=True, eq=False)
class _Together:
    """All joints of an arm on some recordings, with something under the hand.

    Attributes:
        arm: its rigid part; tasks: of all its joints, without ground; link: (from 0) that touches.
    """

    arm: RigidArm
    tasks: Sequence[JointTask]
    link: int

    @cached_property
    def middles(self) -> list[Array]:
        """(m, n) rad in the middle of each step, as measured, by recording."""
        motions = (track.smooth[0] for track in self.tasks[0].tracks)
        return [0.5 * (q[1:] + q[:-1]) for q in motions]

    def beyond(self, way_m: float) -> Array:
        """(3,) m so far beyond the centre of mass of the link that touches, in its frame."""
        mass = max(float(self.arm.theta[self.link, 0]), 1e-9)
        centre = self.arm.theta[self.link, 1:4] / mass
        return np.asarray(centre * (1.0 + way_m / max(float(np.linalg.norm(centre)), 1e-9)))

    def ground(self, y: Array) -> Ground:
        """Of (5,) numbers in steps of `SIZE`."""
        x, up = y * SIZE, -self.arm.gravity / np.linalg.norm(self.arm.gravity)
        point = np.ascontiguousarray(x[:3])
        return Ground(self.link, point, up, float(x[3]), float(np.exp(np.clip(x[4], -9.0, 9.0))))

    def under(self, ground: Ground) -> list[JointTask]:
        """The tasks with it."""
        tables = []
        for q in self.middles:
            lift, above = over_ground(self.arm, ground, q)
            tables.append((lift, above[:, None] - lift * q))
        found = []
        for task in self.tasks:
            at, pairs = task.joint, zip(task.loads, tables, strict=True)
            columns = [[np.ascontiguousarray(x[:, at]) for x in table] for _, table in pairs]
            loads = [
                load._replace(lift=lift, gap=gap)
                for load, (lift, gap) in zip(task.loads, columns, strict=True)
            ]
            found.append(replace(task, loads=loads))
        return found

    def fit(self, y: Array, x: Array, rounds: int) -> tuple[Array, Array, float]:
        """Ground (5,) and servos (n, 6) that explain the readings best, and what they leave."""
        scale, usual = np.maximum(np.abs(x), LEAST)[:, :PLAIN], self.beyond(FAR_M)
        units = [chi2_unit(task, own) for task, own in zip(self.tasks, x, strict=True)]
        held = MILLI * float(np.sqrt(np.median(units)))  # what a prior standard deviation weighs
        edges = np.cumsum([0, *(sum(take.sum() for take in task.rows) for task in self.tasks)])

        def servos_of(z: Array) -> Array:
            return np.hstack([z[5:].reshape(scale.shape) * scale, x[:, PLAIN:]])

        def left(z: Array) -> Array:
            servos, tasks = servos_of(z), self.under(self.ground(z[:5]))
            rows = [MILLI * task.fitted(own) for task, own in zip(tasks, servos, strict=True)]
            where = (z[:3] * SIZE[:3] - usual) / REACH_M
            stiff = (z[4] * SIZE[4] - 0.5 * np.log(STIFF)) / np.log(YIELDS)
            return np.concatenate([*rows, held * where, [held * stiff]])

        def slopes(z: Array, here: Array) -> Array:
            servos = servos_of(z)
            out = np.zeros((len(here), len(z)))
            for k in range(5):
                out[:, k] = (left(z + NUDGE * (np.arange(len(z)) == k)) - here) / NUDGE
            for j, task in enumerate(self.under(self.ground(z[:5]))):
                rows = slice(edges[j], edges[j + 1])
                for k in range(PLAIN):
                    step = NUDGE * scale[j, k] * (np.arange(x.shape[1]) == k)
                    moved = MILLI * task.fitted(servos[j] + step)
                    out[rows, 5 + PLAIN * j + k] = (moved - here[rows]) / NUDGE
            return out

        least, most = np.zeros_like(scale), np.full_like(scale, np.inf)
        gain = float(np.median(x[:, A]))
        least[:, A], most[:, A] = gain / ALIKE, gain * ALIKE
        ends = [
            np.concatenate([np.full(5, outside), (own / scale).ravel()])
            for own, outside in ((least, -np.inf), (most, np.inf))
        ]
        z = np.clip(np.concatenate([y, (x[:, :PLAIN] / scale).ravel()]), *ends)
        z, cost = robust_fit(left, slopes, z, ends, rounds)
        return z[:5], servos_of(z), cost

    def errors(self, ground: Ground, x: Array) -> Array:
        """(n,) what servos leave of the readings that are fitted, rad², see `misfit`."""
        pairs = zip(self.under(ground), x, strict=True)
        return np.array([misfit(task.fitted(own)) for task, own in pairs])

    def best_of(self, y: Array, servos: Sequence[Array]) -> Array:
        """(n, 10) of several, joint by joint those that leave least."""
        errors = np.array([self.errors(self.ground(y), x) for x in servos])
        return np.array(servos)[errors.argmin(axis=0), np.arange(self.arm.n)]


def robust_fit(
    left: Callable[[Array], Array],
    slopes: Callable[[Array, Array], Array],
    z: Array,
    ends: Sequence[Array],
    rounds: int,
) -> tuple[Array, float]:
    """Levenberg's and Marquardt's steps from z (k,), within both `ends`; also the cost.

    By products of the slopes' columns: scipy decomposes the whole of them at each step, which takes
    ten times as long where there are 50 000 readings and 50 numbers.
    """
    rows, damping = left(z), 1e-3
    cost = misfit(rows / MILLI)
    for _ in range(rounds):
        J, weight = slopes(z, rows), 1.0 / np.sqrt(1.0 + (rows / MILLI / OUTLIER_RAD) ** 2)
        G, g = J.T @ (weight[:, None] * J), J.T @ (weight * rows)
        before = cost
        while damping < 1e6:
            free = ~(((z <= ends[0]) & (g > 0.0)) | ((z >= ends[1]) & (g < 0.0)))
            H = G[np.ix_(free, free)]
            step = np.zeros_like(z)
            step[free] = np.linalg.solve(H + np.diag(damping * np.diagonal(H) + 1e-9), -g[free])
            trial = np.clip(z + step, *ends)
            moved = left(trial)
            if (after := misfit(moved / MILLI)) < cost:
                z, rows, cost, damping = trial, moved, after, damping / 5.0
                break
            damping *= 5.0
        if before - cost < 1e-3 * before:  # settled
            break
    return z, cost


def find_ground(arm: RigidArm, tasks: Sequence[JointTask], x: Array) -> tuple[Ground, Array]:
    """What the hand comes down on (`NO_GROUND` if nothing pays), and the servos (n, 10) beside it.

    Args:
        tasks: of all joints, without ground; x: (n, 10) servos fitted without.
    """
    best, least = None, np.inf
    # a recording in which the hand is held spoils the servos; each alone is another start
    starts = [x]
    count = len(tasks[0].tracks)
    for i in range(count if count > 1 else 0):
        each = [
            replace(t, tracks=[t.tracks[i]], loads=[t.loads[i]], rows=[t.rows[i]]) for t in tasks
        ]
        starts.append(np.array([fit_joint(t, ALL_FREE, first_guess(t)).x for t in each]))
    for link, beyond in product(range(max(arm.n - 2, 0), arm.n), BEYOND_M):
        one = _Together(arm, tasks, link)
        point = one.beyond(beyond)  # which touches at its lowest
        level = one.ground(np.array([*point / SIZE[:3], 0.0, 0.0]))
        heights = np.concatenate([over_ground(arm, level, q)[1] for q in one.middles])
        y = np.array([*point, np.quantile(heights, LOWEST), 0.5 * np.log(STIFF)]) / SIZE
        servos, cost = x, np.inf
        for _ in range(2):  # a joint that got stuck starts again, beside the ground as it is now
            y, servos, cost = one.fit(y, one.best_of(y, [servos, *starts]), ROUGH)
        if cost < least:
            best, least = (one, y, servos), cost
    assert best is not None
    one, y, servos = best
    beside = one.under(one.ground(y))
    fits = [
        np.array([fit_joint(t, ALL_FREE, own).x for t, own in zip(beside, each, strict=True)])
        for each in (servos, *starts)
    ]
    y, servos, _ = one.fit(y, one.best_of(y, fits), FINE)
    none = np.array([0.0, 0.0, 0.0, -1e3, 0.0])  # far below
    pairs = zip(one.under(one.ground(y)), servos, strict=True)
    gain, left = np.zeros((2, arm.n))
    unit = np.array([chi2_unit(task, own) for task, own in pairs])
    for half in (0, 1):
        seen, unseen = (
            replace(one, tasks=[blocks(task, part) for task in tasks]) for part in (half, 1 - half)
        )
        with_it, own = seen.fit(y, servos, ROUGH)[:2]
        without = seen.fit(none, x, ROUGH)[1]
        left += unseen.errors(NO_GROUND, without)
        gain += unseen.errors(NO_GROUND, without) - unseen.errors(seen.ground(with_it), own)
    if np.sum((gain > PAYS_CHI2 * unit) & (gain > PAYS_SHARE * left)) < LEAST_JOINTS:
        return NO_GROUND, x
    return one.ground(y), servos
