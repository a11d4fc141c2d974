"""A recording in which too little moves: what it still tells is what the hand holds."""

from __future__ import annotations

from adapter.gap.findings import findings_of
from adapter.gap.fit import worth
from adapter.gap.nominal import nominal_fit
from adapter.gap.real_arm import real_arm
from adapter.gap.result import Finding
from adapter.gap.rivals import Standing
from adapter.gap.search import Found
from adapter.gap.signals import LEAST_S, Recorded
from adapter.model.self_model import SelfModel
from adapter.screening.screen import cleaned
from adapter.screening.timing import lateness
from adapter.signals.matching import present
from drivers.files.mcap import Log


def held_at_rest(log: Log, model: SelfModel, inertia_prior: float) -> Finding | None:
    """The load of an arm at rest, where it is more than static friction and offsets can hold.

    Args:
        log: as read; model: of the arm.
        inertia_prior: by which share the model's inertias may be off, one standard deviation.

    Raises:
        Refusal: another robot, too few samples.
    """
    model, _ = present(model, log.joint_names, log.path.name)
    clean, clock, _ = cleaned(log, model)
    own = Recorded.of(clean, lateness(clock))
    if own.t[-1] - own.t[0] < LEAST_S:
        return None
    arm = real_arm(nominal_fit([own], model, inertia_prior, clock.period_s), (), (0,))
    if not arm.is_there(0):
        return None
    values = [worth(arm.fit, arm.known, k) for k in range(len(arm.fit.named))]
    standings = tuple(
        Standing(e.candidate, value.log_evidence, value.chi2, ())
        for e, value in zip(arm.fit.named, values, strict=True)
    )
    others = frozenset(range(1, len(standings)))
    (load,) = findings_of(Found(arm.fit, arm.known, standings, weak=others), {own.name: own.t[-1]})
    return load
