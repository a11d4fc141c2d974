"""Friction in equations of the velocity alone, and of the load. Positive numbers oppose motion."""

from __future__ import annotations

from copy import copy

import numpy as np

from adapter.effects import base
from adapter.effects.phrases import BOTH_WAYS, LATER, LOADS, SPEEDS, STILL, TURNS, Phrase
from adapter.model.urdf_text import DAMPING, FRICTION, Additions


class ViscousFriction(base.LinearEffect):
    """tau = Fv dq: friction torque in proportion to the joint's speed."""

    name = "viscous_friction"
    title = "viscous friction"
    parameters = (base.Parameter("Fv", "N m s/rad"),)
    prior_std = 1.0  # published Panda values are 0.03 to 0.09 (Knezevic)
    place = DAMPING
    positive = ("Fv",)
    inexact = 0.02
    phrase = Phrase.lacks("Fv", "viscous friction")
    shows = ((SPEEDS, "rises in proportion to the speed"), (STILL, "is gone"))
    sudden = True
    watched = True
    bundled = True

    def column(self, at: base.JointSignals) -> base.Array:
        """dq."""
        return at.dq


class CoulombFriction(base.LinearEffect):
    """tau = Fc sign(dq), smoothed around rest: it depends on the direction of motion alone."""

    name = "coulomb_friction"
    title = "Coulomb friction"
    parameters = (base.Parameter("Fc", "N m"),)
    prior_std = 1.0  # published Panda values are 0.2 to 0.5 (Knezevic)
    place = FRICTION
    positive = ("Fc",)
    inexact = 0.02
    band = 0.3  # static friction is 1 to 1.6 times Coulomb's in what is published
    phrase = Phrase.lacks("Fc", "Coulomb friction")
    form = base.LEVEL
    shows = ((STILL, "fades or changes sign"), (TURNS, "turns over at once"))
    sudden = True
    watched = True
    bundled = True

    def column(self, at: base.JointSignals) -> base.Array:
        """tanh(dq / w) with w = 0.01 rad/s, or as far as dq goes within the smoothing time."""
        return at.direction


class AsymmetricFriction(base.JointTorque):
    """Coulomb friction of a size for either direction: Fc_pos for dq > 0, Fc_neg for dq < 0."""

    name = "asymmetric_friction"
    title = "asymmetric friction"
    parameters = (base.Parameter("Fc_pos", "N m"), base.Parameter("Fc_neg", "N m"))
    prior_std = (1.0, 1.0)
    positive = ("Fc_pos", "Fc_neg")
    log_odds = -3.0  # Coulomb friction and an offset say the same in simpler words
    inexact = 0.02
    simpler = ((base.LEVEL, 10.0), (base.LEVEL_BY_LOAD, 10.0))
    phrase = Phrase("{who} {lacks} Coulomb friction of {Fc_pos} forwards and {Fc_neg} backwards")
    form = base.TWO_LEVELS
    shows = ((STILL, "fades or changes sign"), (BOTH_WAYS, "is larger one way than the other"))

    def law(self, at: base.JointSignals, values: base.Values) -> base.Array:
        """Fc_pos where dq > 0, -Fc_neg where dq < 0, smoothed around rest."""
        sign = at.direction
        return np.asarray(np.where(sign > 0.0, values["Fc_pos"], values["Fc_neg"]) * sign)

    def export(self, more: Additions, joint: int, values: base.Values) -> str | None:
        """The mean, as dry friction."""
        mean = 0.5 * (values["Fc_pos"] + values["Fc_neg"])
        return more.at_joint(FRICTION, joint, mean, "the mean of both is there as friction")


class LoadDependentFriction(base.LinearEffect):
    """Fl |tau| sign(dq): friction in proportion to the rigid torque tau that the gear carries."""

    name = "load_dependent_friction"
    title = "load-dependent friction"
    parameters = (base.Parameter("Fl", "1"),)
    prior_std = 0.05
    positive = ("Fl",)
    log_odds = -1.0
    inexact = 0.03
    phrase = Phrase(
        "{who} {lacks} friction of {x} of its load",
        "Fl",
        "{who} {has} less friction than the model says, by {x} of its load",
    )
    form = base.LEVEL_BY_LOAD
    by_load = True
    shows = ((LOADS, "grows with the load"), (STILL, "fades or changes sign"))

    def column(self, at: base.JointSignals) -> base.Array:
        """|tau| sign(dq)."""
        return np.asarray(np.abs(at.tau) * at.direction)


SLOWEST = 0.008  # N m/s
LONG_S, RISE_NM = 60.0, 0.16  # in a longer recording: what it rises by in all, as within 20 s


class FrictionDrift(base.TorqueEffect):
    """A gear that warms up: Coulomb friction changes by dFc each second, from the start on."""

    name = "friction_drift"
    title = "friction drift"
    parameters = (base.Parameter("dFc", "N m/s"),)
    prior_std = 0.05
    log_odds = -5.0
    inexact = 0.03
    phrase = Phrase(
        "the friction of {who} rises by {x}", "dFc", "the friction of {who} falls by {x}"
    )
    shows = ((STILL, "fades or changes sign"), (LATER, "has gone on"))

    slowest = SLOWEST

    def over(self, seconds: float) -> FrictionDrift:
        """Over an hour much less shows than over a minute."""
        if seconds <= LONG_S:
            return self
        slower = copy(self)
        slower.slowest = RISE_NM / seconds
        return slower

    def possible(self, values: base.Values) -> bool:
        """What drifts more slowly is not told from a velocity signal that is not quite right."""
        return abs(float(values["dFc"])) > self.slowest

    def torque(
        self, motion: base.Motion, tau: base.Array, joint: int, values: base.Values
    ) -> base.Array:
        """dFc t sign(dq), t since the effect began, or the recording."""
        column = motion.t * motion.direction[:, joint]
        return base.on_joint(motion, joint, float(values["dFc"]) * column)
