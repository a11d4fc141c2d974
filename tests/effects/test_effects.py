"""Each effect's torque against the equation of the table, computed with Pinocchio alone."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import interp1d
from scipy.signal import butter, lsim, lti, sosfiltfilt

from adapter.effects.active import active_effects, check_effects
from adapter.effects.base import JointTorque, Motion, polar
from adapter.effects.bodies import parameters_of, theta_of
from adapter.effects.bristle_friction import bending
from adapter.effects.by_joint import WAYS_RAD, JointSignals, smooth_sign
from adapter.effects.catalogue import CATALOGUE, LEARNED
from adapter.effects.encoders import play
from adapter.effects.phrases import experiments
from adapter.effects.torque import ModelTorque, sensed_torque
from adapter.errors import ModelError
from adapter.model.robots import documented
from adapter.physics.rigid_arm import RigidArm
from sim.effects import Effect as Oracles
from sim.truth import panda
from tests.helpers.arm_data import pin_model as truth_model
from tests.helpers.arm_data import rnea
from tests.helpers.gap_effects import joint_torque, rigid, sense
from tests.helpers.robot_models import relative

N, J = 7, 3  # joints; the one that most effects sit on, from 0
PERIOD_S = 1e-3
MODEL = documented("panda")
ARM = RigidArm.of(MODEL)
ORACLE = truth_model(panda())


def motion(seconds: float = 4.0) -> Motion:
    """Sines with exact rates; every joint reverses."""
    t = np.arange(0.0, seconds, PERIOD_S)[:, None]
    rng = np.random.default_rng(5)
    w, phase = rng.uniform(2.0, 4.0, N), rng.uniform(0.0, 6.0, N)
    middle = np.array([0.3, -0.4, 0.2, -1.6, 0.3, 1.8, 0.4])
    size = 0.5
    sine, cosine = np.sin(w * t + phase), np.cos(w * t + phase)
    moved = middle + size * sine, size * w * cosine, -size * w**2 * sine
    return Motion(t[:, 0], *moved, ARM)


MOVES = motion()
Q, DQ, DDQ, T = MOVES.q, MOVES.dq, MOVES.ddq, MOVES.t
RIGID = rnea(ORACLE, Q, DQ, DDQ)
SIGN = np.tanh(DQ[:, J] / 0.01)


def entry(name: str, joints: object = (J + 1,), **parameters: object) -> dict[str, object]:
    return {"effect": name, "joints": list(joints), "parameters": parameters}  # type: ignore[call-overload]


def sensed(*entries: dict[str, object]) -> np.ndarray:
    return sensed_torque(MOVES, active_effects(entries, N))


def on_joint(torque: np.ndarray, joint: int = J) -> np.ndarray:
    out = RIGID.copy()
    out[:, joint] += torque
    return out


AT_JOINT = {
    "viscous_friction": ({"Fv": 0.4}, 0.4 * DQ[:, J]),
    "coulomb_friction": ({"Fc": 0.7}, 0.7 * SIGN),
    "asymmetric_friction": (
        {"Fc_pos": 0.9, "Fc_neg": 0.4},
        np.where(DQ[:, J] > 0, 0.9, 0.4) * SIGN,
    ),
    "stribeck_friction": (
        {"Fc": 0.5, "Fs": 1.1, "vs": 0.08},
        (0.5 + 0.6 * np.exp(-((DQ[:, J] / 0.08) ** 2))) * SIGN,
    ),
    "load_dependent_friction": ({"Fl": 0.06}, 0.06 * np.abs(RIGID[:, J]) * SIGN),
    "motor_inertia": ({"B": 0.2}, 0.2 * DDQ[:, J]),
    "torque_ripple": ({"a": 0.3, "n": 4, "phase": 0.5}, 0.3 * np.sin(4 * Q[:, J] + 0.5)),
    "joint_spring": ({"k": 1.4, "q0": -1.1}, 1.4 * (Q[:, J] + 1.1)),
    "torque_offset": ({"o": -0.6}, np.full(len(T), -0.6)),
    "torque_gain": ({"g": 0.05}, 0.05 * RIGID[:, J]),
    "friction_drift": ({"dFc": 0.05}, 0.05 * T * SIGN),
}


@pytest.mark.parametrize("name", AT_JOINT)
def test_torque_at_a_joint(name: str) -> None:
    parameters, torque = AT_JOINT[name]
    assert relative(sensed(entry(name, **parameters)), on_joint(torque)) < 1e-9


@pytest.mark.parametrize("s0", [5e-4, 5e-3, 0.05])
def test_bristle_friction_is_dahls(s0: float) -> None:
    """By an ODE solver, with all of the motion behind it."""
    of = interp1d(T, DQ[:, J], "cubic")
    grid = {"t_span": (0.0, T[-1]), "t_eval": T, "rtol": 1e-8, "atol": 1e-8, "max_step": 1e-3}
    z = solve_ivp(lambda t, z: (of(t) - abs(of(t)) * z) / s0, y0=[0.0], **grid).y[0]
    ours = bending(Q[:, J], s0)
    np.testing.assert_allclose(ours, z, atol=2e-3)
    bristles = entry("bristle_friction", Fc=0.8, s0=s0)
    assert relative(sensed(bristles), on_joint(0.8 * ours)) < 1e-9
    falls = entry("stribeck_friction", Fc=0.8, Fs=1.2, vs=0.3, s0=s0)
    level = 0.8 + 0.4 * np.exp(-((DQ[:, J] / 0.3) ** 2))
    assert relative(sensed(falls), on_joint(level * ours)) < 1e-9
    late = sensed({**bristles, "interval_s": [2.0, None]})
    assert relative(late, on_joint(0.8 * ours * (T >= 2.0))) < 1e-9


@pytest.mark.parametrize("hz", [20.0, 5.0])
def test_torque_filter_is_a_low_pass(hz: float) -> None:
    """Of second order, solved as a differential equation; friction's jumps go through it, too."""
    w, damping = 2.0 * np.pi * hz, 0.8
    d = 2.0 * damping / w
    friction = entry("coulomb_friction", Fc=2.0)
    behind = sensed(friction)[:, J]
    start = np.concatenate([np.full(1000, behind[0]), behind])
    low_pass = lti([w**2], [1.0, 2.0 * damping * w, w**2])
    theirs = lsim(low_pass, start - start[0], PERIOD_S * np.arange(len(start)))[1][1000:] + start[0]
    ours = sensed(friction, entry("torque_filter", d=d, c=d**2 - 1.0 / w**2))
    inner = slice(300, -20)
    gap = np.abs(theirs - behind)[inner].max()
    assert gap > 0.1 and np.abs(ours[:, J] - theirs)[inner].max() < 0.03 * gap
    assert relative(np.delete(ours, J, 1), np.delete(RIGID, J, 1)) < 1e-9


def test_encoder_offset_is_q_measured_minus_the_links() -> None:
    there = Q.copy()
    there[:, J] -= 0.015
    ours = sensed(entry("encoder_offset", o=0.015))
    assert relative(ours, rnea(ORACLE, there, DQ, DDQ)) < 1e-9


@pytest.mark.parametrize(
    ("name", "values", "left"),
    [  # what is left of a ripple is of second order; of a gear, torque of the seen motion
        ("encoder_ripple", {"a": 0.006, "phase": 0.8}, 0.02),
        ("joint_elasticity", {"k": 4000.0}, 0.05),
    ],
)
def test_what_an_encoder_reads_is_led_back_to_the_link(name, values, left) -> None:
    """Link motion first, then what the encoder makes of it; rates by differences."""
    q, dq, _ = sense(panda(), [Oracles(name, (J + 1,), values)], T, Q, DQ, DDQ)
    seen = Motion(T, q, dq, np.gradient(dq, T, axis=0), ARM)
    ours = sensed_torque(seen, active_effects([entry(name, **values)], N))
    inner = slice(10, -10)
    gap = np.abs(rnea(ORACLE, seen.q, seen.dq, seen.ddq) - RIGID)[inner].max()
    assert gap > (0.05 if name == "encoder_ripple" else 0.1)
    assert np.abs(ours - RIGID)[inner].max() < left * gap


def test_backlash_lags_by_half_its_width_on_either_flank() -> None:
    b = 0.02
    link = np.empty(len(T))
    play(np.ascontiguousarray(Q[:, J]), b / 2, Q[0, J] - b / 2 * np.sign(DQ[0, J]), link)
    behind = Q[:, J] - link
    assert np.abs(behind).max() <= b / 2 * (1 + 1e-12)
    far = np.abs(Q[:, J, None] - Q[np.flatnonzero(np.diff(np.sign(DQ[:, J]))), J]).min(axis=1) > b
    np.testing.assert_allclose(behind[far], (b / 2 * np.sign(DQ[:, J]))[far], atol=1e-12)
    there = [Q.copy(), DQ.copy(), DDQ.copy()]
    for table, order in zip(there, range(3), strict=True):
        rate = -behind
        for _ in range(order):
            rate = np.gradient(rate, T)
        table[:, J] += rate
    assert relative(sensed(entry("backlash", b=b)), rnea(ORACLE, *there)) < 1e-6


def test_backlash_takes_the_jump_out_of_a_motor_that_crosses_its_play() -> None:
    """A link that turns round smoothly, and a motor that is half the play ahead of it."""
    b, low = 0.006, butter(4, 10.0, fs=1.0 / PERIOD_S, output="sos")
    motor = Q.copy()  # what moved above is the link
    motor[:, J] += 0.5 * b * np.convolve(np.sign(DQ[:, J]), np.ones(10) / 10, "same")
    moves = [sosfiltfilt(low, motor, axis=0)]
    for _ in range(2):
        moves.append(np.gradient(moves[-1], T, axis=0))
    seen = Motion(T, *moves, ARM, smooth_hz=10.0, sharp_q=motor)
    off = [
        (sensed_torque(seen, active_effects(found, N)) - RIGID)[500:-500, J].std()
        for found in ([], [entry("backlash", b=b)])
    ]
    assert off[1] < 0.15 * off[0]


@pytest.mark.parametrize("d", [0.004, 0.0113])
def test_signal_delay_makes_the_torque_late(d: float) -> None:
    late = np.array([np.interp(T - d, T, column) for column in RIGID.T]).T
    inner = slice(20, -20)
    for joints, columns in (([], slice(None)), ([J + 1], [J])):
        theirs = RIGID.copy()
        theirs[:, columns] = late[:, columns]
        ours = sensed(entry("signal_delay", joints, d=d))
        gap = np.abs(theirs - RIGID)[inner].max()
        assert gap > 0.2
        assert np.abs(ours - theirs)[inner].max() < 0.01 * gap


def test_no_sensor_is_smoother_than_it_is_late() -> None:
    """One pole has c = d^2, several have less; without phase only what was filtered afterwards."""
    effect = CATALOGUE["torque_filter"]
    for poles in (1, 2, 5):
        T1 = 0.02 / poles  # a delay of 20 ms in all; delays' variances add
        d, c = 0.02, 0.5 * (poles * T1**2 + 0.02**2)
        assert effect.log_odds_of({"d": d, "c": c}) == 0.0
    assert effect.log_odds_of({"d": 0.02, "c": 0.02**2 / 2}) == 0.0  # a pure delay
    assert effect.log_odds_of({"d": 0.0, "c": 2e-4}) < -20.0
    assert effect.log_odds_of({"d": -0.002, "c": 1e-4}) < -20.0


def test_a_play_narrower_than_any_that_is_looked_for_is_rare() -> None:
    effect = CATALOGUE["backlash"]
    assert effect.log_odds_of({"b": 2e-3}) == 0.0
    assert effect.log_odds_of({"b": 5e-4}) < -20.0


LOAD = {"m": 1.3, "cx": 0.02, "cy": -0.03, "cz": 0.09}
SIX = [4e-3, 1e-4, -2e-4, 5e-3, 3e-4, 6e-3]
DTHETA = [0.4, 0.02, -0.01, 0.03, 0.01, 1e-3, 2e-3, 0.012, -1e-3, 0.008]
WRENCH = {"fx": 10.0, "fy": -6.0, "fz": 15.0, "mx": 0.4, "my": 0.7, "mz": -0.2}


@pytest.mark.parametrize(
    ("name", "joints", "parameters"),
    [
        ("payload", (), LOAD),
        ("payload", (), {**LOAD, "inertia": SIX}),
        ("link_inertia", (J + 1,), {"dtheta": DTHETA}),
        ("base_tilt", (), {"rx": 0.03, "ry": -0.02}),
        ("external_wrench", (), WRENCH),
    ],
)
def test_bodies_gravity_and_a_wrench_are_pinocchios(name, joints, parameters) -> None:
    theirs = joint_torque(panda(), [Oracles(name, joints, parameters)], T, Q, DQ, DDQ)
    assert relative(sensed(entry(name, joints, **parameters)), theirs) < 1e-9


MOVING = {
    "encoder_offset": ((J + 1,), {"o": 0.02}),
    "base_tilt": ((), {"rx": 0.02, "ry": 0.03}),
    "payload": ((), LOAD),
    "coulomb_friction": ((J + 1,), {"Fc": 0.5}),
    "torque_gain": ((J + 1,), {"g": 0.1}),
}


@pytest.mark.parametrize("name", MOVING)
def test_effects_act_in_their_interval_alone(name: str) -> None:
    joints, parameters = MOVING[name]
    whole = sensed(entry(name, joints, **parameters))
    for interval in ([1.0, 2.5], [1.0, None], [None, 2.5]):
        part = sensed({**entry(name, joints, **parameters), "interval_s": interval})
        begin = -np.inf if interval[0] is None else interval[0]
        end = np.inf if interval[1] is None else interval[1]
        on = (begin <= T) & (end > T)
        assert on.any() and not on.all()
        np.testing.assert_allclose(part[on], whole[on], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(part[~on], RIGID[~on], atol=1e-9)


def test_stages_work_on_each_other() -> None:
    """A gain reads friction too; friction by load knows the payload; the payload feels the tilt."""
    bodies = Oracles("payload", (), LOAD), Oracles("base_tilt", (), {"rx": 0.02, "ry": 0.01})
    theirs = rigid(panda(), bodies, T, Q, DQ, DDQ)
    theirs[:, J] += 0.05 * np.abs(theirs[:, J]) * SIGN + 0.5 * SIGN
    theirs[:, J] *= 1.08
    ours = sensed(
        entry("torque_gain", g=0.08),
        entry("coulomb_friction", Fc=0.5),
        entry("load_dependent_friction", Fl=0.05),
        entry("payload", (), **LOAD),
        entry("base_tilt", (), rx=0.02, ry=0.01),
    )
    assert relative(ours, theirs) < 1e-9


def test_model_torque_takes_what_has_no_end_but_in_its_own_recording() -> None:
    friction = {**entry("coulomb_friction", Fc=0.5), "interval_s": [2.0, None]}
    contact = {**entry("torque_offset", o=3.0), "interval_s": [1.0, 2.0]}
    model = replace(MODEL, effects=(friction, contact))
    for stamps in ((), (T,)):
        assert relative(ModelTorque(model)(Q, DQ, DDQ, *stamps), on_joint(0.5 * SIGN)) < 1e-9
    timed = 0.5 * SIGN * (T >= 2.0) + 3.0 * ((T >= 1.0) & (T < 2.0))
    own = ModelTorque(model, own_log=True)
    assert relative(own(Q, DQ, DDQ, T), on_joint(timed)) < 1e-9


@pytest.mark.parametrize("name", CATALOGUE)
def test_templates_are_linear_for_small_sizes(name: str) -> None:
    """decode(x) is absent at zero and its torque all but linear in x."""
    effect = CATALOGUE[name]
    joints = () if effect.scope in ("flange", "base", "all") else (J + 1,)
    rng = np.random.default_rng(1)
    for template in effect.templates():
        x = np.array(template.prior_std) * np.sign(rng.normal(size=len(template.prior_std)))
        if name == "payload":
            x = theta_of({"m": 1.0, "cx": 0.02, "cy": 0.0, "cz": 0.05, "inertia": SIX})
        sizes = []
        # when a play is crossed hangs on its width: its signature is that of a width
        for scale in (0.9, 1.0) if template.chord else (1e-4, 1e-3):
            values = template.decode(x * scale)
            found = active_effects([entry(name, joints, **_checked(name, values))], N)
            moves = replace(MOVES, smooth_hz=10.0) if template.chord else MOVES
            sizes.append((sensed_torque(moves, found) - RIGID) / scale)
        inner = slice(5, -5)
        size = np.sqrt(np.mean(sizes[1][inner] ** 2))
        assert size > 1e-4
        error = np.sqrt(np.mean((sizes[0] - sizes[1])[inner] ** 2))
        assert error < (0.3 if template.chord else 0.05) * size, template.label


def _checked(name: str, values: dict[str, object]) -> dict[str, object]:
    """Signs that the catalogue does not allow mean the same size the other way."""
    if name == "backlash":
        return {"b": abs(float(values["b"]))}  # type: ignore[arg-type]
    return values


def test_payload_parameters_are_there_and_back() -> None:
    theta = theta_of({**LOAD, "inertia": SIX})
    back = parameters_of(theta)
    np.testing.assert_allclose(theta_of(back), theta, rtol=1e-12)
    assert back["m"] == pytest.approx(1.3)
    assert back["inertia"] == pytest.approx(SIX)


@pytest.mark.parametrize("name", LEARNED)
def test_columns_are_the_laws_derivative(name: str) -> None:
    effect = LEARNED[name]
    rng = np.random.default_rng(5)
    bent, rates = rng.uniform(-1.0, 1.0, (len(WAYS_RAD), *Q.shape)), rng.normal(size=(2, *Q.shape))
    at = JointSignals(Q, DQ, DDQ, Q, 0.0, bent, rates)
    shape = np.full(N, effect.shapes[2] if effect.shapes else np.nan)
    column = effect.torque_per_unit(at, shape)
    np.testing.assert_allclose(column, effect.basis(at)[2 if effect.shapes else 0])
    if isinstance(effect, JointTorque):
        values = {**effect.absent(N), effect.key: np.full(N, 2.0), effect.shape_key: shape}
        np.testing.assert_allclose(effect.law(at, values), 2.0 * column)


def test_an_experiment_tells_each_pair_apart() -> None:
    """And it says what either shows in it, which is not the same."""
    for one, other in permutations(CATALOGUE.values(), 2):
        (said,) = experiments(one, [other])
        first, second = said.partition(": ")[2].split(", the ")
        assert first.startswith(f"the {one.title} ") and second.startswith(f"{other.title} ")
        assert first.removeprefix(f"the {one.title}") != second.removeprefix(other.title)


EXPERIMENTS = {
    ("coulomb_friction", "load_dependent_friction"): "ladder of loads",
    ("coulomb_friction", "stribeck_friction"): "constant speeds",
    ("coulomb_friction", "asymmetric_friction"): "forwards and backwards",
    ("coulomb_friction", "friction_drift"): "ten minutes",
    ("coulomb_friction", "bristle_friction"): "reverse the joint slowly",
    ("bristle_friction", "stribeck_friction"): "constant speeds",
    ("torque_filter", "signal_delay"): "1 to 10 Hz",
    ("asymmetric_friction", "torque_offset"): "hold the joint still",
    ("torque_offset", "torque_ripple"): "much of a turn",
    ("joint_spring", "torque_ripple"): "much of a turn",
    ("base_tilt", "external_wrench"): "nothing near",
    ("payload", "link_inertia"): "take off",
    ("motor_inertia", "link_inertia"): "weigh the link",
    ("viscous_friction", "signal_delay"): "ladder of loads",
    ("torque_gain", "link_inertia"): "ladder of loads",
}


@pytest.mark.parametrize("pair", EXPERIMENTS)
def test_the_experiment_of_a_pair_is_the_right_one(pair: tuple[str, str]) -> None:
    """The pairs that the same data are known to confuse."""
    one, other = (CATALOGUE[name] for name in pair)
    assert EXPERIMENTS[pair] in experiments(one, [other])[0].partition(":")[0]


def test_rivals_of_one_experiment_are_in_one_sentence() -> None:
    names = ("load_dependent_friction", "stribeck_friction", "torque_gain")
    said = experiments(CATALOGUE["coulomb_friction"], [CATALOGUE[name] for name in names])
    assert len(said) == 2 and "load-dependent friction" in said[0] and "gain" in said[0]


POSSIBLE = {
    "viscous_friction": ({"Fv": 0.1}, {"Fv": -0.1}),
    "coulomb_friction": ({"Fc": 0.1}, {"Fc": -0.1}),
    "asymmetric_friction": ({"Fc_pos": 0.1, "Fc_neg": 0.4}, {"Fc_pos": 0.1, "Fc_neg": -0.4}),
    "stribeck_friction": ({"Fc": 0.1, "Fs": 0.4, "vs": 0.1}, {"Fc": 0.4, "Fs": 0.1, "vs": 0.1}),
    "bristle_friction": ({"Fc": 0.1, "s0": 1e-3}, {"Fc": -0.1, "s0": 1e-3}),
    "torque_filter": ({"d": -0.001, "c": 1e-5}, {"d": 0.002, "c": -1e-5}),
    "load_dependent_friction": ({"Fl": 0.1}, {"Fl": -0.1}),
    "motor_inertia": ({"B": 0.1}, {"B": -0.1}),
    "joint_elasticity": ({"k": 1e4}, {"k": -1e4}),
    "backlash": ({"b": 0.01}, {"b": -0.01}),
    "signal_delay": ({"d": 0.011}, {"d": 0.013}),
    "joint_spring": ({"k": 0.1, "q0": 2.0}, {"k": -0.02, "q0": 20.0}),
    "payload": ({"m": 0.1}, {"m": -0.1}),
    "friction_drift": ({"dFc": -0.009}, {"dFc": 0.007}),
    "torque_gain": ({"g": -0.1}, None),
    "torque_offset": ({"o": -0.1}, None),
}


@pytest.mark.parametrize("name", POSSIBLE)
def test_what_physics_allows(name: str) -> None:
    allowed, refused = POSSIBLE[name]
    assert CATALOGUE[name].possible(allowed)
    assert refused is None or not CATALOGUE[name].possible(refused)


def test_a_jump_is_as_smooth_as_the_filter_makes_it() -> None:
    """Friction turns over as far as dq goes while the filter takes a step, never faster."""
    dq, ddq = np.array([0.02, -0.02, 0.02]), np.array([0.0, -2.0, 2.0])
    np.testing.assert_allclose(
        smooth_sign(dq, ddq, 0.03), np.tanh(dq / np.sqrt(0.01**2 + (0.03 * ddq) ** 2))
    )
    np.testing.assert_allclose(smooth_sign(dq, ddq), np.tanh(dq / 0.01))


BAD = {
    "no such effect": (
        [entry("stiction", Fc=1.0)],
        r"'stiction'; have: .*coulomb_fric.*; did you mean ",
    ),
    "joint 0": ([entry("coulomb_friction", (0,), Fc=1.0)], r"no joint 0; have: 1 to 7"),
    "another joint": ([entry("law: dq9", c=1.0)], r"no joint 9; have: 1 to 7"),
    "joint 8": ([entry("coulomb_friction", (8,), Fc=1.0)], r"no joint 8; have: 1 to 7"),
    "half a joint": ([entry("coulomb_friction", (1.5,), Fc=1.0)], r"no joint 1.5"),
    "no joints": ([entry("coulomb_friction", (), Fc=1.0)], r"needs 'joints'; have: 1 to 7"),
    "no key": ([entry("stribeck_friction", Fc=1.0, vs=0.1)], r"needs 'Fs' \(N m\)"),
    "other key": ([entry("coulomb_friction", Fx=1.0)], r"no parameter 'Fx'; have: Fc"),
    "nan": ([entry("coulomb_friction", Fc=float("nan"))], r"'Fc' must hold a finite number"),
    "null": ([entry("coulomb_friction", Fc=None)], r"'Fc' must hold a finite number"),
    "words": ([entry("coulomb_friction", Fc="much")], r"must hold a finite number.*'much'"),
    "range": ([entry("backlash", b=-0.1)], r"'b' is -0.1, outside 0 to inf"),
    "nine": ([entry("link_inertia", dtheta=[0.0] * 9)], r"10 finite numbers"),
    "two of three": ([entry("coulomb_friction", (1, 2, 3), Fc=[1.0, 2.0])], r"not one value.* 3"),
    "backwards": (
        [{**entry("coulomb_friction", Fc=1.0), "interval_s": [3.0, 2.0]}],
        r"does not end after it begins",
    ),
    "not an interval": ([{**entry("coulomb_friction", Fc=1.0), "interval_s": 3}], r"\[from, to\]"),
    "not an entry": (["coulomb_friction"], r"needs effect and parameters"),
    "no parameters": ([{"effect": "coulomb_friction"}], r"needs effect and parameters"),
    "values": ([{"effect": "coulomb_friction", "joints": [1], "parameters": 3}], r"hold 'Fc'"),
}


@pytest.mark.parametrize("fault", BAD)
def test_bad_entries_are_refused_with_the_choices(fault: str) -> None:
    entries, message = BAD[fault]
    with pytest.raises(ModelError, match=message):
        active_effects(entries, N)  # type: ignore[arg-type]
    with pytest.raises(ModelError, match=r"arm\.json: .*" + message):
        check_effects(replace(MODEL, effects=tuple(entries)), "arm.json")  # type: ignore[arg-type]


def test_both_forms_of_an_entry() -> None:
    """The learner's, with a value for each joint, and a finding's, with what goes along."""
    values = [0.1, 0.2, 0.3]
    learned = active_effects([entry("viscous_friction", (1, 2, 4), Fv=values)], N)
    assert [(a.joint, a.values["Fv"]) for a in learned] == [(0, 0.1), (1, 0.2), (3, 0.3)]
    (same,) = {a.values["Fv"] for a in active_effects([entry("viscous_friction", (1, 2), Fv=1)], N)}
    assert same == 1
    finding = {
        **entry("stribeck_friction", (2,), Fc=0.1, Fs=0.2, vs=0.1),
        "interval_s": [4.0, None],
        "std": {"Fc": 0.01, "Fs": None},
        "units": {"Fc": "N m", "Fs": "N m", "vs": "rad/s"},
        "evidence": 0.98,
        "ambiguous_with": ["coulomb_friction"],
    }
    (one,) = active_effects([finding], N)
    assert (one.joint, one.interval_s, one.std["Fc"]) == (1, (4.0, np.inf), 0.01)
    ten = [float(k) for k in range(10)]
    two = active_effects([entry("link_inertia", (1, 2), dtheta=[ten, ten])], N)
    assert [list(a.values["dtheta"]) for a in two] == [ten, ten]


@pytest.mark.parametrize("x", [(0.3, 0.1), (-0.2, 0.5), (0.0, -0.4), (-0.1, 0.0)])
def test_size_and_phase_are_those_of_the_wave(x: tuple[float, float]) -> None:
    size, phase = polar(np.array(x))
    angle = np.linspace(-4.0, 4.0, 50)
    wave = x[0] * np.sin(angle) + x[1] * np.cos(angle)
    assert size > 0.0
    np.testing.assert_allclose(size * np.sin(angle + phase), wave, atol=1e-12)
