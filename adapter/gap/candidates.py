"""Signatures: what each effect of the catalogue would add to the torque of this recording.

A signature is the change of the predicted torque per unit of a template's coefficient, at the
model as it stands, by finite differences of the same stages that predict torque anywhere else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adapter.effects import CATALOGUE
from adapter.effects.active import Active
from adapter.effects.base import (
    ALL,
    BASE,
    FLANGE,
    LINK,
    Effect,
    Motion,
    MotionEffect,
    SensorEffect,
    Template,
    TorqueEffect,
)
from adapter.gap.signals import Signals
from adapter.records import Array
from adapter.torque import added, bodies, moved_links

THETA_EFFECTS = ("payload", "link_inertia")
STEP = 0.02  # of a coefficient's typical size, for the differences


@dataclass(frozen=True, eq=False)
class Candidate:
    """One way in which the model may be incomplete.

    Attributes:
        effect: of the catalogue; template: how its coefficients are read.
        joint: from 0; -1 where the effect has none.
        columns: places of its signatures in the table of all signatures.
    """

    effect: Effect
    template: Template
    joint: int
    columns: tuple[int, ...]

    @property
    def key(self) -> tuple[str, int]:
        """Effect and joint."""
        return self.effect.name, self.joint

    @property
    def columns_are_theta(self) -> bool:
        """Whether its coefficients are inertial parameters of a link."""
        return self.effect.name in THETA_EFFECTS

    @property
    def prior_std(self) -> Array:
        """(k,) of its coefficients."""
        return np.array(self.template.prior_std)


@dataclass(frozen=True, eq=False)
class Base:
    """The model as it stands on a recording: what it predicts, stage by stage, at 250 Hz.

    Attributes:
        links: motion of the links.
        rigid: (m, n) torque of the bodies; total: with what acts at the joints.
        regressor: (m, n, 10 n).
    """

    links: Motion
    rigid: Array
    total: Array
    regressor: Array


def base_of(signals: Signals, effects: Sequence[Active]) -> Base:
    """Evaluate the model with the effects named so far."""
    links = moved_links(signals.motion, effects)
    rigid = bodies(links, effects)
    Y = links.arm.regressor(links.q, links.dq, links.ddq)
    return Base(links, rigid, added(links, rigid, effects), Y)


def places(effect: Effect, n: int) -> tuple[int, ...]:
    """Joints (from 0) where an effect may be; -1 where it has none of its own."""
    if effect.scope in (FLANGE, BASE):
        return (-1,)
    return (-1, *range(n)) if effect.scope == ALL else tuple(range(n))


def signatures(
    signals: Signals, base: Base, joints: Sequence[int], extra: Sequence[tuple[Effect, int]] = ()
) -> tuple[Array, list[Candidate]]:
    """Every signature in the band, and what each belongs to.

    Args:
        joints: (from 0) that move; effects of others cannot be told.
        extra: further effects, each with its joint.

    Returns:
        (c, k, n) N m per unit of the coefficient; candidates. The first 10 n signatures are
        those of θ.
    """
    n = signals.motion.arm.n
    theta = np.moveaxis(signals.low(base.regressor), 2, 0)
    tables, candidates, size = [theta], [], 10 * n
    for effect in CATALOGUE.values():
        for joint in places(effect, n):
            if joint >= 0 and effect.scope != LINK and joint not in joints:
                continue
            for template in effect.templates():
                count = len(template.prior_std)
                if effect.name in THETA_EFFECTS:
                    k = 10 * (joint if joint >= 0 else n - 1)
                    columns = tuple(range(k, k + 10))
                else:
                    tables.append(_differences(signals, base, effect, template, joint))
                    columns = tuple(range(size, size + count))
                    size += count
                candidates.append(Candidate(effect, template, joint, columns))
    for effect, joint in extra:
        template = effect.templates()[0]
        tables.append(_differences(signals, base, effect, template, joint))
        columns = tuple(range(size, size + len(template.prior_std)))
        size += len(columns)
        candidates.append(Candidate(effect, template, joint, columns))
    return np.concatenate(tables), candidates


def _differences(
    signals: Signals, base: Base, effect: Effect, template: Template, joint: int
) -> Array:
    """(c, k, n) change of the torque per unit of each coefficient, at zero."""
    out = []
    for i, std in enumerate(template.prior_std):
        x = np.zeros(len(template.prior_std))
        x[i] = STEP * std
        change = _change(base, effect, joint, template.decode(x)) / x[i]
        if joint >= 0 and isinstance(effect, TorqueEffect | SensorEffect):
            table = np.zeros((*signals.tau.shape,))
            table[:, joint] = signals.low(change[:, joint])
            out.append(table)
        else:
            out.append(signals.low(change))
    return np.array(out)


def _change(base: Base, effect: Effect, joint: int, values: dict) -> Array:
    """(m, n) by how much a small effect changes the torque."""
    links = base.links
    if isinstance(effect, TorqueEffect):
        return effect.torque(links, base.rigid, joint, values)
    if isinstance(effect, SensorEffect):
        # not of the total: friction that was named would make a gain look like friction
        return effect.measured(links, base.rigid, joint, values) - base.rigid
    if isinstance(effect, MotionEffect):
        moved = effect.link_side(links, base.rigid, joint, values)
        return links.arm.torque(moved.q, moved.dq, moved.ddq) - links.arm.torque(
            links.q, links.dq, links.ddq
        )
    tilted = bodies(links, (Active(effect, joint, values),))
    return tilted - links.arm.torque(links.q, links.dq, links.ddq)
