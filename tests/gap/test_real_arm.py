"""The load first: on twins of real logs, and the starting point that it leaves to the search."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from adapter.effects.catalogue import HELD
from adapter.gap.hand import Hand, hand_of
from adapter.gap.real_arm import RealArm, nominal_fit, real_arm, start
from adapter.gap.signals import Recorded
from adapter.gap.workflow import beside_plain, find_gap
from adapter.judgement.priors import DOCUMENTED_SHARE, theta_prior
from adapter.model.self_model import SelfModel
from adapter.model.urdf import model_from_urdf
from adapter.physics.rigid_arm import RigidArm
from adapter.screening.screen import refuse
from adapter.screening.timing import lateness
from tests.helpers.arm_data import panda_model
from tests.helpers.twin_makers import by_mujoco, by_pinocchio
from tests.hidden.trial import nominal_urdf
from tests.hidden.twins import Twin, draw_twin

DRY = ("coulomb_friction", "bristle_friction", "stribeck_friction", "asymmetric_friction")
TWINS = (700, 701, 702, 703, 704, 705, 706, 707, 708, 709)


@cache
def documented() -> SelfModel:
    """The nominal arm of every twin, as its URDF says it."""
    return model_from_urdf(nominal_urdf(draw_twin(TWINS[0]).nominal))


def fitted(twin: Twin) -> tuple[RealArm, list[int]]:
    """All that the arm of a twin may have, and the joints that move."""
    model = documented()
    log = (by_mujoco if twin.seed % 2 else by_pinocchio)(twin)
    screened = refuse(log, model)
    own = Recorded.of(screened.log, lateness(screened.timing))
    fit = nominal_fit([own], model, DOCUMENTED_SHARE, screened.timing.period_s)
    return real_arm(fit, screened.moving, (0,)), list(screened.moving)


def test_loads_of_twins_are_weighed_and_bare_hands_are_bare() -> None:
    """Two or three standard deviations off happens once in a while; six never."""
    off = []
    for seed in TWINS:
        twin = draw_twin(seed)
        arm, _ = fitted(twin)
        off.append((arm.fit.named[0].x[0] - twin.load_kg) / arm.mass_std[0])
        if twin.load_kg > 1.0:
            assert arm.is_there(0), seed
        if twin.load_kg == 0.0:
            assert not arm.is_there(0), seed
    assert np.max(np.abs(off)) < 6.0 and np.sqrt(np.mean(np.square(off))) < 2.5


def test_priors_are_held_and_what_any_arm_has_is_there_from_the_start() -> None:
    """Of another unit as well; a bare hand holds nothing, and nothing assumed has a name yet."""
    twin = next(t for t in map(draw_twin, TWINS) if t.load_kg == 0.0)
    arm, moving = fitted(twin)
    np.testing.assert_array_equal(
        arm.fit.prior, theta_prior(RigidArm.of(documented()).theta, DOCUMENTED_SHARE)
    )
    begun = start(arm.fit.with_named(()), moving)
    assert begun.named and all(e.assumed and e.possible for e in begun.named)
    assert HELD not in {e.candidate.effect for e in begun.named}
    np.testing.assert_array_equal(begun.prior, arm.fit.prior)


def test_a_heavy_load_is_named_and_told_twice_where_plain_least_squares_weighs_otherwise() -> None:
    twin = next(t for t in map(draw_twin, TWINS) if t.load_kg > 2.0)
    screened = refuse((by_mujoco if twin.seed % 2 else by_pinocchio)(twin), documented())
    found = find_gap([screened.log], documented())
    (held,) = (f for f in found.findings if f.effect == HELD.name)
    assert abs(held.parameters["m"] - twin.load_kg) < max(0.1, 4.0 * held.std["m"])
    assert "external_wrench" not in {f.effect for f in found.findings}
    other = replace(held, parameters=dict(held.parameters, m=held.parameters["m"] + 1.0))
    said = [
        beside_plain(replace(found, findings=(x,)), screened, documented(), DOCUMENTED_SHARE).notes
        for x in (held, other)
    ]
    assert said[0] == found.notes and "by least squares" in said[1][0]


def test_friction_of_large_joints_is_told_once() -> None:
    """Twenty times a Panda's: its size is no reason to split it into two effects."""
    twin = draw_twin(704)
    large = {key: 20.0 * getattr(twin.friction, key) for key in ("coulomb", "viscous")}
    log = by_pinocchio(replace(twin, friction=replace(twin.friction, **large)))
    found = find_gap([log], documented())
    dry = [f for f in found.findings if f.effect in DRY]
    assert dry and len({f.joints for f in dry}) == len(dry)
    assert max(f.parameters["Fc"] for f in dry) > 5.0


def test_an_arm_at_rest_says_what_it_holds() -> None:
    """And that nothing else can be told of it; a bare one says no more than that."""
    for seed, kg in ((707, 3.0), (708, 0.0)):
        twin = draw_twin(seed)
        theta = twin.nominal.theta.copy()
        theta[-1] += kg * np.array([1.0, 0.0, 0.0, 0.17, 0.03, 0.0, 0.0, 0.03, 0.0, 0.002])
        still = np.repeat(twin.q[:1], 3000, axis=0)
        log = by_pinocchio(replace(twin, arm=replace(twin.arm, theta=theta), q=still))
        found = find_gap([log], documented())
        assert found.problem is not None and "too little motion" in found.problem
        assert [f.effect for f in found.findings] == [HELD.name] * (kg > 0.0)
        for load in found.findings:
            assert abs(load.parameters["m"] - kg) < 4.0 * load.std["m"] < kg
            assert "holds" in found.problem


def test_where_a_load_is_likely_to_be() -> None:
    """Beyond the face that a tool is bolted to, as the last link's own centre points."""
    model = panda_model()
    hand = hand_of(model)
    body = model.theta_with_tool()[-1]
    assert hand.centre[2] > body[3] / body[0] + 0.05
    assert Hand().reach_m > hand.reach_m
    x = np.zeros(10)
    x[0] = 2.0
    values = hand.templates()[0].decode(x)
    assert values["m"] == 2.0
    assert np.allclose([values[key] for key in ("cx", "cy", "cz")], hand.centre)


@pytest.mark.timeout(300)
def test_names_that_were_exchanged_in_vain_are_given_up() -> None:
    """The search of this log went to and fro between two fits with the same names, without end."""
    twin = draw_twin(5097)
    found = find_gap([by_mujoco(twin)], documented())
    assert not any(f.effect in ("payload", "external_wrench") for f in found.findings)
