"""Ways to learn an arm from one recording: ours, and what a user would pick instead.

Each is told the documented model and the recording, and runs in a process of its own (`main`), so
that its time, its memory and its end are its own. What it learned is a self model, whatever it
works with.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import pickle
import re
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import lsq_linear
from scipy.spatial.transform import Rotation

from adapter.effects.active import active_effects
from adapter.effects.by_joint import smooth_sign
from adapter.effects.catalogue import KNOWN
from adapter.effects.robots import robot_mjcf, robot_urdf
from adapter.gap.workflow import find_gap
from adapter.judgement.priors import COULOMB_NM, MOTOR_KG_M2, OFFSET_NM, VISCOUS_NM_S, theta_prior
from adapter.model.inertia import six_from_tensor
from adapter.model.model_file import load_model
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm
from adapter.runs.library import Learner
from adapter.screening.likelihood import LOAD_STD, SMOOTHING_S, by_joint
from adapter.signals.validation import EDGE_S, GRID_S, smooth
from drivers.files.mcap import Log

FRICTION = ("viscous_friction", "coulomb_friction", "motor_inertia", "torque_offset")
# What MuJoCo's joint has of an effect: where, begin, least and most, as PACE has them but for dry
# friction, which a large arm has more of than its 0.5 N m. Its motor has a bias.
FIELDS = {
    "viscous_friction": ("damping", 0.1, 0.0, 7.0),
    "coulomb_friction": ("frictionloss", 0.1, 0.0, 5.0),
    "motor_inertia": ("armature", 0.05, 0.0, 1.0),
}
OFFSET, BIAS = "torque_offset", ("biasprm", 0.0, -5.0, 5.0)
TAKEN = {  # effects that a search may name, as what MuJoCo holds
    **dict.fromkeys(("bristle_friction", "stribeck_friction"), "coulomb_friction"),
    **{name: name for name in (*FIELDS, OFFSET)},
    **dict.fromkeys(("payload", "link_inertia"), "bodies"),
}
BIAS_RAD = 0.1  # of an encoder, at most

Signals = tuple[Array, Array, Array, Array]
Free = Mapping[str, Iterable[int]]  # effect, or "bodies" -> joints from 0


class Learned(NamedTuple):
    """What a way to learn ends with: the arm, what there is to say of it, and what it names."""

    model: SelfModel
    notes: Sequence[str] = ()
    findings: Sequence[Mapping[str, Any]] = ()

    @property
    def names(self) -> list[str]:
        """What is named, where."""
        return [f"{x['effect']} {' '.join(map(str, x['joints']))}".strip() for x in self.findings]


class Given(NamedTuple):
    """What a way is told: recording and model; how long to iterate; what a search named before."""

    log: Log
    model: SelfModel
    rounds: int
    findings: Sequence[Mapping[str, Any]] = ()


def rigid(model: SelfModel) -> SelfModel:
    """The documented bodies alone, the tool's in the last."""
    return replace(model, theta=model.theta_with_tool(), tool=None, effects=())


def with_effects(model: SelfModel, theta: Array, found: Mapping[str, Array]) -> SelfModel:
    """The model with bodies theta (n, 10) and a number (n,) of each effect in every joint."""
    joints, effects = list(range(1, model.tree.n + 1)), list[dict[str, Any]]()
    for name, x in found.items():
        numbers = {KNOWN[name].parameters[0].key: x.tolist()}
        effects.append({"effect": name, "parameters": numbers, "joints": joints})
    return replace(model, theta=theta, effects=tuple(effects))


def signals_of(log: Log) -> Signals:
    """q, dq, ddq, tau (m, n) of a recording, smoothed, 1 ms apart."""
    edge = round(EDGE_S / GRID_S)
    q, dq, ddq, tau = smooth(1e-9 * (log.stamp_ns - log.stamp_ns[0]), log.q, log.dq, log.tau)
    return q[edge:-edge], dq[edge:-edge], ddq[edge:-edge], tau[edge:-edge]


def gap(given: Given) -> Learned:
    """`adapter gap`, told nothing else."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.json"
        found = find_gap([given.log], given.model, model_out=path)
        model = load_model(path) if path.exists() else given.model
    left = [f"something unexplained on joint {x.joint}" for x in found.unexplained]
    said = [found.problem] if found.problem else left
    return Learned(model, [*said, *found.notes], [f.as_dict() for f in found.findings])


def online(given: Given) -> Learned:
    """`adapter replay`, the learner of a live arm: every sample once."""
    learner, log = Learner(given.model), given.log
    for at_s, *row in zip(1e-9 * log.stamp_ns, log.q, log.dq, log.tau, strict=True):
        learner.step(at_s, *row)
    return Learned(learner.model)


def least_squares(given: Given) -> Learned:
    """Weighted least squares of all inertial numbers, friction, motor inertia and offset.

    Each with a prior of a physical size that nothing widens: 5 % of the documented bodies, a load
    of some kg in the last one. Weights are those of what is left, joint by joint.
    """
    model, every = rigid(given.model), round(0.01 / GRID_S)
    q, dq, ddq, tau = (x[::every] for x in signals_of(given.log))
    arm, n = RigidArm.of(model), model.tree.n
    Y = arm.regressor(q, dq, ddq)
    joint = by_joint((dq, smooth_sign(dq, ddq, SMOOTHING_S), ddq, np.ones_like(q)))
    X, more = np.concatenate([Y, joint], axis=2), tau - arm.torque(q, dq, ddq)
    bodies = theta_prior(arm.theta, 0.05)
    bodies[-1] = np.hypot(bodies[-1], LOAD_STD)
    rest = np.repeat([VISCOUS_NM_S, COULOMB_NM, MOTOR_KG_M2, OFFSET_NM], n)
    std = np.concatenate([bodies.ravel(), rest])
    low = np.where((np.arange(len(std)) >= 10 * n) & (np.arange(len(std)) < 13 * n), 0.0, -np.inf)
    level, x = more.std(axis=0), np.zeros(len(std))
    alike = np.sqrt(0.3 / GRID_S / every)  # rows within 0.3 s say the same
    for _ in range(3):  # of weights after fit
        weighed = np.concatenate([X, more[:, :, None]], axis=2) / (alike * level)[:, None]
        table = np.asarray(np.linalg.qr(weighed.reshape(-1, len(std) + 1), mode="r"))
        A = np.concatenate([table[:, :-1], np.diag(1.0 / std)])
        x = lsq_linear(A, np.r_[table[:, -1], np.zeros(len(std))], (low, np.inf)).x
        level = np.sqrt(np.mean((more - X @ x) ** 2, axis=0))
    found = dict(zip(FRICTION, x[10 * n :].reshape(-1, n), strict=True))
    return Learned(with_effects(model, arm.theta + x[: 10 * n].reshape(n, 10), found))


def figaroh(given: Given) -> Learned:
    """figaroh (Apache-2.0, https://github.com/thanhndv212/figaroh-plus): base parameters.

    By weighted least squares, set up as its users would: viscous and Coulomb friction, an offset
    and a motor inertia in every joint. Its base parameters stand in the places that it gives them,
    all others are nothing: the torque is the same, the bodies are none.
    """
    from figaroh.identification.base_identification import BaseIdentification
    from figaroh.tools.load_robot import load_robot

    model, learned = rigid(given.model), signals_of(given.log)

    class Identification(BaseIdentification):
        """Its workflow on signals that are filtered already."""

        def load_trajectory_data(self, data_source: str | None = None) -> dict[str, Array]:
            names = ("positions", "velocities", "accelerations", "torques")
            times: Array = GRID_S * np.arange(len(learned[0]), dtype=np.float64)
            return {"timestamps": times, **dict(zip(names, learned, strict=True))}

        def process_kinematics_data(self, filter_config: object = None) -> None:
            self.processed_data = dict(self.raw_data)

    # Its settings: every joint with friction, offset and motor inertia, as from zero.
    n, parts = model.tree.n, ("friction", "actuator_inertia", "joint_offset")
    zeros, joints = [0] * n, {"active_joints": list(model.tree.joint_names)}
    mechanics = {
        "friction_coefficients": {"viscous": zeros, "static": zeros},
        "actuator_inertias": zeros,
        "joint_offsets": zeros,
    }
    problem = {"model_components": dict.fromkeys(parts, True)}
    task = {"type": "identification", "problem": problem, "mechanics": mechanics}
    own = {"name": "arm", "properties": {"joints": joints}}
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        urdf, settings = Path(folder) / "arm.urdf", Path(folder) / "settings.yaml"
        urdf.write_text(robot_urdf(model, alone=True).text)
        settings.write_text(json.dumps({"robot": own, "tasks": {"identification": task}}))
        arm = load_robot(os.fspath(urdf), load_by_urdf=True)
        work = Identification(arm, os.fspath(settings))
        work.identif_config.update(act_idxq=list(range(n)), act_idxv=list(range(n)))
        work.initialize()
        found = work.solve(decimate=False, plotting=False, wls=True)
    x = np.zeros(14 * n)
    x[np.delete(np.arange(14 * n), work._idx_eliminated)[work._base_indices]] = found
    theta = x[: 10 * n].reshape(n, 10)[:, [0, 1, 2, 3, 4, 5, 7, 6, 8, 9]]  # XX XY YY XZ YZ ZZ
    effects = dict(zip(FRICTION, x[10 * n :].reshape(-1, n), strict=True))
    return Learned(with_effects(model, theta, effects))


def spec_of(model: SelfModel) -> Any:
    """The arm for MuJoCo: a motor and sensors of position and speed in every joint, 1 ms steps."""
    import mujoco

    spec = mujoco.MjSpec.from_string(robot_mjcf(model).text)
    spec.option.timestep = GRID_S
    for joint in spec.joints:
        joint.range[:], joint.limited = (0.0, 0.0), False
    for name in model.tree.joint_names:
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        for kind in (mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtSensor.mjSENS_JOINTVEL):
            sensor = f"{name}_{kind.name}"
            spec.add_sensor(name=sensor, type=kind, objname=name, objtype=mujoco.mjtObj.mjOBJ_JOINT)
    return spec


def sysid(
    model: SelfModel, logs: Sequence[tuple[Array, Array, Array]], free: Free, rounds: int
) -> tuple[SelfModel, tuple[float, float]]:
    """What `mujoco.sysid` learns, and its residual before and after.

    Args:
        logs: q, dq, tau (m, n) each, 1 ms apart.
        free: joints by what of them is searched: `FIELDS`, `OFFSET`, "bodies".
    """
    from mujoco import sysid

    spec, names, theta = spec_of(model), model.tree.joint_names, RigidArm.of(model).theta.copy()
    compiled, parameters, values = spec.compile(), sysid.ParameterDict(), dict[str, Array]()
    bodies = {j: compiled.body(compiled.joint(names[j]).bodyid[0]).name for j in range(len(names))}
    for j in free.get("bodies", ()):
        change, kind = partial(_set_of_body, bodies[j]), sysid.InertiaType.Pseudo
        parameters.add(sysid.body_inertia_param(spec, compiled, bodies[j], kind, modifier=change))
    for effect, (place, begin, least, most) in {**FIELDS, OFFSET: BIAS}.items():
        for j in free.get(effect, ()):
            change = partial(_set_of_joint, names[j], place)
            key = f"{names[j]}_{place}"
            parameters.add(sysid.Parameter(key, begin, least, most, modifier=change))
    told = [np.stack([q, dq], axis=2).reshape(len(q), -1) for q, dq, _ in logs]
    step, parts = round(0.1 / GRID_S), list[tuple[Any, ...]]()  # longer ones run away
    seconds: Array = GRID_S * np.arange(step, dtype=np.float64)
    for k, (q, dq, tau) in enumerate(logs):
        for start in range(0, len(q) - step, step):  # name, first state, control, measurement
            part = slice(start, start + step)
            state = sysid.create_initial_state(compiled, q[start], dq[start], None)
            sensors = sysid.TimeSeries.from_names(seconds, told[k][part], compiled)
            parts.append((f"{k}:{start}", state, sysid.TimeSeries(seconds, tau[part]), sensors))
    whole = sysid.ModelSequences("arm", spec, *map(list, zip(*parts, strict=True)))
    sizes = np.concatenate(told).std(axis=0)

    def difference(_: Any, predicted: Any, measured: Any, *__: Any, **___: Any) -> Any:
        """Errors in standard deviations of each signal in all of the recording.

        Its own are in those of a tenth of a second: a joint that rests so long is all that counts.
        """
        predicted = predicted.resample(measured.times)
        return (measured.data - predicted.data) / sizes, predicted, measured

    own = {"modify_residual": difference, "n_threads": 1}
    residual = sysid.build_residual_fn(models_sequences=[whole], **own)
    first, _, _ = residual(parameters.as_vector(), parameters)
    best, _ = sysid.optimize(parameters, residual, verbose=False, max_iters=rounds)
    last, _, _ = residual(best.as_vector(), best)
    for j in free.get("bodies", ()):
        pi = sysid.model_modifier.pi_from_theta(best[f"{bodies[j]}_inertia"].value)
        theta[j] = np.r_[pi[:4], six_from_tensor(pi[4:].reshape(3, 3))]
    for effect, (place, *_) in {**FIELDS, OFFSET: BIAS}.items():
        values[effect] = np.zeros(len(names))
        for j in free.get(effect, ()):
            values[effect][j] = best[f"{names[j]}_{place}"].value[0]
    before, after = (float(np.sqrt(np.mean(np.concatenate(x) ** 2))) for x in (first, last))
    return with_effects(model, theta, values), (before, after)


def _set_of_body(name: str, spec: Any, parameter: Any) -> None:
    """Its own function for this takes bodies without geometries for empty."""
    from mujoco import sysid

    pi = sysid.model_modifier.pi_from_theta(parameter.value)
    body, centre = spec.body(name), pi[1:4] / pi[0]
    about = pi[4:].reshape(3, 3) - pi[0] * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    sizes, axes = np.linalg.eigh(about)
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    body.mass, body.ipos, body.inertia = float(pi[0]), centre, sizes
    body.iquat = np.roll(Rotation.from_matrix(axes).as_quat(), 1)
    body.explicitinertial = True


def _set_of_joint(name: str, place: str, spec: Any, parameter: Any) -> None:
    joint, value = spec.joint(name), float(parameter.value[0])
    if place == BIAS[0]:  # sensors read so much more than drives
        spec.actuator(name).biasprm[0] = -value
        return
    as_now = np.atleast_1d(getattr(joint, place))  # damping is a polynomial in the speed
    setattr(joint, place, np.r_[value, 0.0 * as_now[1:]] if len(as_now) > 1 else value)


def by_sysid(told: bool, given: Given) -> Learned:
    """`mujoco.sysid` with friction, damping and armature of all joints and the last body free.

    Told, it is what our gap named and nothing else, as far as MuJoCo's joint has it.
    """
    n, notes = given.model.tree.n, list[str]()
    free: dict[str, set[int]] = {**{key: set(range(n)) for key in FIELDS}, "bodies": {n - 1}}
    if told:
        named = active_effects([{**f, "interval_s": None} for f in given.findings], n)
        free, cannot = {}, {x.effect.name for x in named} - set(TAKEN)
        for x in named:
            if x.effect.name in TAKEN:
                free.setdefault(TAKEN[x.effect.name], set()).add(x.joint % n)
        notes = [f"not in it: {', '.join(sorted(cannot))}"] if cannot else []
        if not free:
            return Learned(rigid(given.model), [*notes, "nothing was named that it could fit"])
    q, dq, _, tau = signals_of(given.log)
    searched = {key: sorted(x) for key, x in free.items()}
    model, (before, after) = sysid(rigid(given.model), [(q, dq, tau)], searched, given.rounds)
    count = sum((10 if key == "bodies" else 1) * len(x) for key, x in searched.items())
    fell = f"{count} numbers; its residual {before:.3g} -> {after:.3g}"
    return Learned(model, [fell, *notes])


def evolution(given: Given) -> Learned:
    """CMA-ES on rollouts, as PACE: armature, damping, dry friction and a bias of every encoder.

    A candidate's cost is the mean square of its positions' error in rollouts of half a second.
    """
    import cma
    import mujoco
    from mujoco import rollout

    q, dq, _, tau = signals_of(given.log)
    model, n, length = rigid(given.model), given.model.tree.n, round(0.5 / GRID_S)
    compiled = spec_of(model).compile()
    data, scratch = mujoco.MjData(compiled), mujoco.MjData(compiled)
    starts = np.arange(0, len(q) - length, length)
    rows = starts[:, None] + np.arange(length)
    state = np.concatenate([np.zeros((len(starts), 1)), q[starts], dq[starts]], axis=1)
    most = np.array([most for *_, most in FIELDS.values()] + [2.0 * BIAS_RAD])[:, None]

    def decoded(x: Array) -> Array:
        return most * np.reshape(x, (4, n)) - np.array([0.0, 0.0, 0.0, BIAS_RAD])[:, None]

    def cost(x: Array) -> float:
        *values, bias = decoded(x)
        for (place, *_), value in zip(FIELDS.values(), values, strict=True):
            field = getattr(compiled, f"dof_{place}")
            field[(slice(None), 0) if field.ndim > 1 else slice(None)] = value
        mujoco.mj_setConst(compiled, scratch)
        shifted = state - np.r_[0.0, bias, np.zeros(n)]
        found, _ = rollout.rollout(compiled, data, shifted, tau[rows])
        off = found[:, :-1, 1 : 1 + n] + bias - q[rows[:, 1:]]
        return float(np.mean(off**2)) if np.isfinite(off).all() else 1e9

    begin = np.repeat([*(x / m for _, x, _, m in FIELDS.values()), 0.5], n)
    limits = {"bounds": [0, 1], "seed": 1, "verbose": -9, "maxiter": 10 * given.rounds}
    search = cma.CMAEvolutionStrategy(begin, 0.1, limits)
    while not search.stop():
        tried = search.ask()
        search.tell(tried, [cost(x) for x in tried])
    *values, bias = decoded(search.result.xbest)
    found = {**dict(zip(FIELDS, values, strict=True)), "encoder_offset": bias}
    ended = ", ".join(search.stop())
    said = f"{4 * n} numbers, {search.result.evaluations} candidates; ended by {ended}"
    return Learned(with_effects(model, RigidArm.of(model).theta, found), [said])


class Way(NamedTuple):
    """A way to learn: how, and the module that need not be there, of extra [peers]."""

    learn: Callable[[Given], Learned]
    module: str | None = None


# "absl" alone is missing where MuJoCo is there without its sysid.
WAYS = {
    "as documented": Way(lambda given: Learned(given.model)),
    "adapter gap": Way(gap),
    "adapter replay": Way(online),
    "least squares": Way(least_squares),
    "figaroh": Way(figaroh, "figaroh"),
    "mujoco.sysid, all free": Way(partial(by_sysid, False), "absl"),
    "mujoco.sysid, gap's list": Way(partial(by_sysid, True), "absl"),
    "CMA-ES, as PACE": Way(evolution, "cma"),
}


def of_this_process() -> dict[str, float]:
    """Processor time, s, and most memory, MB, so far."""
    peak = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return {"cpu_s": time.process_time(), "peak_mb": int(peak[1]) / 1024 if peak else math.nan}


def main(file: str) -> None:
    """Do what a file asks for (a way's name, what it is told); then it holds the answer."""
    path = Path(file)
    name, given = pickle.loads(path.read_bytes())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        learned = WAYS[name].learn(given)
    said = dict.fromkeys(str(x.message) for x in caught if issubclass(x.category, UserWarning))
    learned = learned._replace(notes=[*learned.notes, *said])
    path.write_bytes(pickle.dumps((learned, of_this_process())))
