"""Makes the recording of a hidden-effect trial: the arm in PyBullet under a controller.

The controller knows the nominal arm and follows the drawn motion by computed torque with
feedback of the links' true motion, so that no sensor effect shakes the arm.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.files.mcap import Commands, Log, write_log
from drivers.interface import JointSample
from sim.noise import SensorNoise, levels_of
from sim.plant import PERIOD_NS, Plant
from sim.truth import Array
from tests.hidden.trial import Trial, nominal_urdf

RATE_S = 35.0  # 1/s, the double pole of the feedback
INTEGRAL_S = 8.0  # 1/s, pole of the slow part that carries friction and payloads
PERIOD_S = 1e-3


def simulate(trial: Trial) -> tuple[Array, Array, Array, Array]:
    """Noise-free readings q, dq, tau and the commands (m, n) of a trial.

    Raises:
        RuntimeError: the arm left its limits; the message says which joint.
    """
    disturbance, m = trial.disturbance(), len(trial.times)
    wanted = trial.motion.at(PERIOD_S * np.arange(m + 1, dtype=float))
    truth, arm = trial.arm.with_changes(effects=trial.effects), trial.nominal
    plant, motors = Plant(truth, noise=levels_of("none")), truth.motor_inertia
    total = np.zeros(arm.n)
    out, rubs = np.empty((4, m, truth.n)), np.zeros((m + 1, truth.n))
    bent = None if trial.friction is None else trial.friction.start * trial.friction.coulomb
    for k in range(m):
        sample = plant.read()
        if plant.fault is not None:
            raise RuntimeError(f"trial {trial.seed}: {plant.fault}")
        q, dq, _ = plant.link_state()
        goal, speed, acceleration = (x[k + 1] for x in wanted)
        # The torque that makes the nominal arm follow: M (ddq + feedback) + bias. It knows the
        # motors' inertias, as drives do: where links weigh little it would shake without.
        behind = goal - q
        total += PERIOD_S * behind
        push = RATE_S**2 * (behind + INTEGRAL_S * total) + 2 * RATE_S * (speed - dq)
        ddq = acceleration + push
        tau = arm.torques(q, dq, ddq) + motors * ddq
        tau = np.clip(tau, -arm.limits.effort, arm.limits.effort)
        out[0, k], out[1, k], out[2, k] = sample.q, sample.dq, sample.tau
        out[3, k] = tau
        if trial.friction is not None and bent is not None:
            bent = trial.friction.after(bent, dq, PERIOD_S)
            rubs[k + 1] = bent + trial.friction.viscous * dq
        # What disturbs the arm is part of what the drive gives and of what its sensor reads.
        plant.command(tau - disturbance[min(k + 1, m - 1)] - rubs[k + 1])
    plant.close()
    out[2] += disturbance + rubs[:-1]
    return out[0], out[1], out[2], out[3]


def pybullet_recording(trial: Trial) -> Log:
    """The recording of a trial, noise of the sensors added."""
    q, dq, tau, commands = simulate(trial)
    noise = SensorNoise(trial.noise, trial.arm.n, trial.seed)
    rows = enumerate(zip(q, dq, tau, strict=True))
    arrived = [noise.measure(k, JointSample(k * PERIOD_NS, *row)) for k, row in rows]
    kept = [sample for sample in arrived if sample is not None]
    return log_of(
        trial.arm.joint_names,
        np.array([sample.stamp_ns for sample in kept], np.int64),
        np.array([sample.q for sample in kept]),
        np.array([sample.dq for sample in kept]),
        np.array([sample.tau for sample in kept]),
        commands if trial.commands else None,
    )


def log_of(
    joint_names: tuple[str, ...],
    stamp_ns: NDArray[np.int64],
    q: Array,
    dq: Array,
    tau: Array,
    commands: Array | None = None,
) -> Log:
    """A recording of what was measured (m, n), and commanded (m, n) upon each sample."""
    told = None if commands is None else Commands(stamp_ns, commands)
    return Log(Path("recording.mcap"), joint_names, stamp_ns, q, dq, tau, commands=told)


def write(
    trial: Trial, folder: Path | str, recording: Log | None = None, simulator: str = "pybullet"
) -> tuple[Path, Path, Path]:
    """Write recording.mcap, nominal.urdf and truth.json; returns their paths.

    Args:
        trial: as drawn.
        folder: made where it does not exist.
        recording: made by another simulator; by PyBullet where None.
        simulator: its name, for the truth file.
    """
    recording = pybullet_recording(trial) if recording is None else recording
    truth = {**trial.as_dict(), "simulator": simulator}
    return write_files(recording, nominal_urdf(trial.nominal), truth, Path(folder))


def write_files(
    recording: Log, model: str, truth: dict[str, Any], folder: Path
) -> tuple[Path, Path, Path]:
    """The three files of a trial: recording, URDF text, contents of the truth file."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = folder / "recording.mcap", folder / "nominal.urdf", folder / "truth.json"
    write_log(recording, paths[0], {})
    paths[1].write_text(model, "utf-8")
    paths[2].write_text(json.dumps(truth), "utf-8")
    return paths
