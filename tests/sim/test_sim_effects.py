"""Every effect that the simulator can hold, against Pinocchio plus the effect's own equation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from sim import joint_effects
from sim.effects import SPECS, Effect
from sim.joint_effects import Row
from sim.noise import levels_of
from sim.plant import Plant
from sim.truth import panda
from tests.helpers.arm_data import pin_model, rms
from tests.helpers.gap_effects import joint_torque, rnea, torque_sensor
from tests.sim.test_plant import T_S, reference

SECONDS = 1.0
OWN = 20  # samples between two looks at the plant's own acceleration
SLOW = 0.05  # rad/s, below it tanh(dq / 0.01) bends within the samples of a difference
SETTLED = 60  # samples, before that the torque has a corner
NEAR = 5  # samples around a change in time
STIFFNESS = np.array([100, 100, 100, 100, 40, 40, 20])  # N m/rad, against friction
DAMPING = np.array([10, 10, 10, 10, 1, 1, 0.4])  # N m s/rad
FRICTION = ("friction", "backlash")


class Record:
    """A recorded motion: what the sensors read, and the true motion of the links."""

    def __init__(self, truth, seconds=SECONDS):
        plant = Plant(truth, noise=levels_of("none"))
        model = pin_model(truth)
        data = model.createData()
        rows = []
        for k in range(round(seconds / T_S)):
            sample = plant.read()
            q, dq, u = plant.link_state()
            own = plant.ddq() if k % OWN == 0 else np.full(7, np.nan)
            rows.append((sample.q, sample.dq, sample.tau, q, dq, u, own))
            want, speed, push = reference((k + 1) * T_S, truth.ready)
            push = push + 100.0 * (want - q) + 20.0 * (speed - dq)
            stiff = STIFFNESS * (want - q) + DAMPING * (speed - dq)
            plant.command(pin.rnea(model, data, q, dq, push) + stiff)
        assert plant.fault is None and not plant.saturated
        plant.close()
        columns = [np.array(column) for column in zip(*rows, strict=True)]
        self.read_q, self.read_dq, self.read_tau, self.q, self.dq, self.u, self.own_ddq = columns
        self.t = np.arange(len(rows)) * T_S
        self.ddq = np.gradient(self.dq, T_S, axis=0)

    def rigid(self):
        return rnea(panda(), self.q, self.dq, self.ddq)

    def steady(self, effect):
        """Rows to compare: settled, away from reversals of stiff joints and from changes."""
        on = np.ones(len(self.t), bool)
        on[:SETTLED] = on[-2:] = False
        if any(word in effect.name for word in FRICTION):
            columns = effect.columns(7)
            on &= (np.abs(self.dq[:, columns]) > SLOW).all(axis=1)
        for edge in effect.interval_s or ():
            if edge is not None:
                on &= np.abs(self.t - edge) > NEAR * T_S
        return on


def arm_with(*effects):
    return panda().with_changes(effects=effects)


# Sizes that show in the motion of `Record`; equations are those of `tests.helpers.gap_effects`.
ON_JOINTS = [
    Effect("viscous_friction", (2,), {"Fv": 0.8}),
    Effect("coulomb_friction", (4,), {"Fc": 1.5}),
    Effect("asymmetric_friction", (3,), {"Fc_pos": 1.2, "Fc_neg": 0.4}),
    Effect("stribeck_friction", (5,), {"Fc": 0.3, "Fs": 0.8, "vs": 0.2}),
    Effect("load_dependent_friction", (2,), {"Fl": 0.06}),
    Effect("friction_drift", (1,), {"dFc": 0.8}),
    Effect("motor_inertia", (6,), {"B": 0.2}),
    Effect("torque_ripple", (4,), {"a": 0.5, "n": 12.0, "phase": 0.7}),
    Effect("joint_spring", (3,), {"k": 1.5, "q0": -0.4}),
    Effect("x_quadratic_drag", (1,), {"c": 1.0}),
    Effect("x_cubic_spring", (2,), {"c": 1.5, "q0": 0.2}),
    Effect("x_position_friction", (4,), {"A": 0.8, "phase": 2.5}),
    Effect("x_sine_disturbance", (5,), {"a": 0.4, "f": 3.0, "phase": 0.0}),
    Effect("x_velocity_ripple", (3,), {"a": 0.5, "n": 8.0, "phase": 0.2}),
    Effect("x_cross_viscous", (2, 4), {"c": 0.8}),
]
DTHETA = [0.4, 0.02, -0.03, 0.05, 0.01, 0.002, -0.001, 0.012, 0.001, 0.009]
BALL = {"m": 1.5, "cx": 0.02, "cy": -0.03, "cz": 0.15}
INERTIA = [2e-3, 3e-4, -1e-4, 3e-3, 2e-4, 4e-3]
BODIES = [
    Effect("payload", (), {**BALL, "inertia": INERTIA}),
    Effect("payload", (7,), BALL),
    Effect("link_inertia", (4,), {"dtheta": DTHETA}),
    Effect("base_tilt", (), {"rx": 0.03, "ry": -0.05}),
]
WRENCH = Effect("external_wrench", (), {"fx": 12.0, "fy": -8.0, "fz": 5.0, "mx": 0.5, "mz": -0.3})
PASSING = ("viscous_friction", "coulomb_friction", "motor_inertia", "torque_ripple")  # switched
FOR_A_TIME = [*(e for e in ON_JOINTS if e.name in PASSING), *BODIES, WRENCH]


@pytest.mark.parametrize(
    "effect", [*ON_JOINTS, *BODIES, *(replace(e, interval_s=(0.4, 0.8)) for e in FOR_A_TIME)]
)
def test_torque_of_an_effect_is_that_of_the_table(effect):
    record = Record(arm_with(effect))
    rigid = record.rigid()
    wanted = joint_torque(panda(), [effect], record.t, record.q, record.dq, record.ddq)
    rows = record.steady(effect)
    assert rms((wanted - rigid)[rows]).max() > 0.05
    assert rms((record.read_tau - wanted)[rows]).max() < 3e-3
    rows &= np.arange(len(rows)) % OWN == 0
    assert rms((record.own_ddq - record.ddq)[rows]).max() < 0.1
    assert np.array_equal(record.read_q, record.q) and np.array_equal(record.read_dq, record.dq)


@pytest.mark.parametrize("s0", [2e-3, 0.01])
def test_bristles_follow_the_dahl_model(s0):
    Fc = 0.6
    record = Record(arm_with(Effect("bristle_friction", (4,), {"Fc": Fc, "s0": s0})))
    z, wanted = 0.0, []
    for move in np.diff(record.q[:, 3], prepend=record.q[0, 3]):
        for part in np.full(50, move / 50):
            z += part / s0 * (1 - z * np.sign(part))
        wanted.append(Fc * z)
    left = (record.read_tau - record.rigid())[:, 3] - wanted
    assert rms(np.array(wanted)) > 0.3
    assert rms(left[SETTLED:-2]) < 5e-3 * 0.01 / s0


def read_as(record):
    return {"q": record.read_q, "dq": record.read_dq, "tau": record.read_tau}


def slopes(x):
    return np.diff(x, axis=0, prepend=x[:1]) / T_S


def one(values, joint):
    """(m, 7) zero but for a joint's column."""
    out = np.zeros((len(values), 7))
    out[:, joint - 1] = values
    return out


ENCODERS = [
    (
        Effect("joint_elasticity", (2,), {"k": 4000.0}),
        lambda r: {
            "q": r.q + one(r.u[:, 1] / 4000, 2),
            "dq": r.dq + one(slopes(r.u)[:, 1] / 4000, 2),
        },
    ),
    (Effect("encoder_offset", (3,), {"o": -0.01}), lambda r: {"q": r.q + one(-0.01 + 0 * r.t, 3)}),
    (
        Effect("encoder_ripple", (4,), {"a": 0.008, "phase": 0.4}),
        lambda r: {
            "q": r.q + one(0.008 * np.sin(r.q[:, 3] + 0.4), 4),
            "dq": r.dq + one(0.008 * np.cos(r.q[:, 3] + 0.4) * r.dq[:, 3], 4),
        },
    ),
]
TORQUE_SENSORS = [
    Effect("torque_gain", (2,), {"g": 0.05}),
    Effect("torque_offset", (6,), {"o": 0.4}),
    Effect("signal_delay", (), {"d": 0.0023}),
    Effect("signal_delay", (4,), {"d": 0.004}),
    Effect("x_torque_crosstalk", (2, 3), {"share": 0.04}),
    Effect("x_torque_deadband", (4,), {"w": 0.5}),
    Effect("x_torque_saturation", (2,), {"s": 60.0}),
]
SENSORS = [
    *ENCODERS,
    *((e, lambda r, e=e: {"tau": torque_sensor([e], r.t, r.u)}) for e in TORQUE_SENSORS),
]


@pytest.mark.parametrize(("effect", "wanted"), SENSORS)
def test_sensor_effects_change_what_is_read_and_nothing_else(effect, wanted):
    record = Record(arm_with(effect), 0.6)
    assert rms((record.u - record.rigid())[SETTLED:-2]).max() < 3e-3
    expected = {"q": record.q, "dq": record.dq, "tau": record.u, **wanted(record)}
    for key, values in read_as(record).items():
        assert values == pytest.approx(expected[key], abs=1e-9), key


@pytest.mark.parametrize(
    ("name", "numbers", "key"),
    [("encoder_offset", {"o": 0.01}, "q"), ("torque_offset", {"o": 0.4}, "tau")],
)
def test_sensor_effects_keep_to_their_interval(name, numbers, key):
    record = Record(arm_with(Effect(name, (4,), numbers, (0.3, 0.6))), 0.8)
    extra = read_as(record)[key] - {"q": record.q, "tau": record.u}[key]
    on = (record.t >= 0.3 - 1e-9) & (record.t < 0.6 - 1e-9)
    assert extra == pytest.approx(one(on * numbers["o"], 4), abs=1e-12)


@pytest.mark.parametrize("c", [0.04**2, 0.75 * 0.04**2, 0.5 * 0.04**2])
def test_a_torque_filter_is_a_low_pass(c):
    """Of first order, with two equal poles, of second order: its differential equation."""
    d = 0.04
    record = Record(arm_with(Effect("torque_filter", (4,), {"d": d, "c": c})))
    read = record.read_tau[:, 3]
    rate = np.gradient(read, T_S)
    left = (d * d - c) * np.gradient(rate, T_S) + d * rate + read - record.u[:, 3]
    off = rms((record.u - record.read_tau)[SETTLED:, 3])
    assert off > 0.1
    assert rms(left[SETTLED:-2]) < 0.05 * off


def test_a_torque_filter_that_looks_ahead_is_refused():
    with pytest.raises(ValueError, match="no more than d"):
        Record(arm_with(Effect("torque_filter", (4,), {"d": 0.001, "c": 1e-4})), 0.01)


def test_link_lags_the_motor_by_the_play():
    effect = Effect("backlash", (4,), {"b": 0.008})
    record = Record(arm_with(effect), 2.0)
    ahead = (record.read_q - record.q)[:, 3]
    assert np.abs(ahead).max() == pytest.approx(0.004)
    far = np.abs(record.dq[:, 3]) > 0.15
    assert ahead[far] == pytest.approx(0.004 * np.sign(record.dq[far, 3]))
    assert (ahead[far] > 0).any() and (ahead[far] < 0).any()
    # The link is what the play operator makes of the motor's angle.
    link, links = record.q[0, 3], []
    for motor in record.read_q[:, 3]:
        link = min(max(link, motor - 0.004), motor + 0.004)
        links.append(link)
    assert rms(np.array(links) - record.q[:, 3])[()] < 3e-4
    assert record.read_dq[:, 3] - record.dq[:, 3] == pytest.approx(slopes(ahead[:, None])[:, 0])


def test_effects_act_together():
    effects = (
        Effect("coulomb_friction", (4,), {"Fc": 0.8}, (0.5, None)),
        Effect("joint_spring", (4,), {"k": 1.0, "q0": 0.0}),
        Effect("torque_gain", (4,), {"g": -0.04}),
        Effect("encoder_offset", (2,), {"o": 0.01}),
    )
    record = Record(arm_with(*effects))
    wanted = record.rigid()
    late = record.t >= 0.5
    wanted[:, 3] += late * 0.8 * np.tanh(record.dq[:, 3] / 0.01) + record.q[:, 3]
    wanted[:, 3] *= 0.96
    assert rms((record.read_tau - wanted)[record.steady(effects[0])]).max() < 3e-3


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (("frixion", (1,), {}), "no effect 'frixion'; have: viscous_friction"),
        (("coulomb_friction", (1,), {"Fv": 1.0}), "needs: Fc"),
        (("coulomb_friction", (1,), {"Fc": 1.0, "x": 1.0}), "no parameter 'x'; have: Fc"),
        (("coulomb_friction", (), {"Fc": 1.0}), "at least one joint"),
        (("coulomb_friction", (0,), {"Fc": 1.0}), "count from 1"),
        (("coulomb_friction", (1,), {"Fc": np.nan}), "Fc is nan"),
        (("link_inertia", (1,), {"dtheta": [1.0]}), "dtheta is"),
        (("joint_elasticity", (1,), {"k": 0.0}), "k is too small"),
        (("x_torque_crosstalk", (1,), {"share": 0.1}), "two joints"),
        (("coulomb_friction", (1,), {"Fc": 1.0}, (2.0, 1.0)), "ends before it starts"),
    ],
)
def test_effects_refuse_what_they_cannot_be(entry, message):
    with pytest.raises(ValueError, match=message):
        Effect(*entry)


def test_effects_on_joints_that_are_not_there_are_refused():
    with pytest.raises(ValueError, match="have: 1 to 7"):
        Plant(arm_with(Effect("torque_gain", (8,), {"g": 0.1})))
    with pytest.raises(ValueError, match="mass of -"):
        heavy = Effect("link_inertia", (4,), {"dtheta": [-10.0] + [0.0] * 9})
        Plant(arm_with(heavy))


def test_every_effect_of_the_catalogue_is_tested_here():
    tested = {e.name for e in (*ON_JOINTS, *BODIES, WRENCH, *TORQUE_SENSORS)}
    tested |= {e.name for e, _ in ENCODERS} | {"backlash", "bristle_friction", "torque_filter"}
    tested |= {"x_held_joint", "x_wall", "x_floor"}  # in `test_scenarios`
    assert tested == set(SPECS)


@pytest.mark.parametrize(("start_s", "level"), [(2.0, 2.4), (-np.inf, 4.0)])
def test_a_drift_grows_from_its_own_start(start_s, level):
    rows, nought = np.zeros((1, 8)), np.zeros(1)
    rows[0, [0, 3, 6, 7]] = Row.FRICTION_DRIFT, 0.8, start_s, np.inf
    parts = joint_effects.add_up(rows, 5.0, nought, nought, nought, nought)
    assert parts[2:4, 0] == pytest.approx([level, level])
