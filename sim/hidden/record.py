"""Makes the recording of a hidden-effect trial: the arm in PyBullet under a controller.

The controller knows the nominal arm and follows the drawn motion by computed torque with
feedback of the links' true motion, so that no sensor effect shakes the arm.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.files.mcap import Log, McapWriter
from drivers.files.mcap.joints import Commands
from drivers.interface import JointSample
from sim.dynamics import torques
from sim.hidden.trial import Trial, nominal_urdf, seal
from sim.noise import SensorNoise, levels_of
from sim.plant import PERIOD_NS, Plant
from sim.truth import Array

RATE_S = 35.0  # 1/s, the double pole of the feedback
INTEGRAL_S = 8.0  # 1/s, pole of the slow part that carries friction and payloads
PERIOD_S = 1e-3


@dataclass(frozen=True, eq=False)
class Recording:
    """What a recording holds.

    Attributes:
        joint_names: order of the columns.
        stamp_ns: (m,).
        q, dq, tau: (m, n) measured, rad, rad/s, N m.
        commands: (m, n) torque commanded upon each sample, N m; None where it isn't recorded.
    """

    joint_names: tuple[str, ...]
    stamp_ns: NDArray[np.int64]
    q: Array
    dq: Array
    tau: Array
    commands: Array | None = None

    def log(self) -> Log:
        """As a recording in memory."""
        commands = None if self.commands is None else Commands(self.stamp_ns, self.commands)
        signals = (self.stamp_ns, self.q, self.dq, self.tau)
        return Log(Path("recording.mcap"), self.joint_names, *signals, commands=commands)


class Follower:
    """Torque that makes a nominal arm follow a motion: M (ddq + feedback) + bias.

    It knows the motors' inertias, as drives do: where links weigh little it would shake without.
    """

    def __init__(self, trial: Trial) -> None:
        self._arm = trial.nominal
        self._sum = np.zeros(trial.nominal.n)
        self._effort, self._motors = trial.nominal.limits.effort, trial.motor_inertia

    def torque(self, q: Array, dq: Array, wanted: tuple[Array, Array, Array]) -> Array:
        """Torque (n,) N m at q, dq (n,) for the wanted q, dq, ddq of the next instant."""
        behind = wanted[0] - q
        self._sum += PERIOD_S * behind
        push = RATE_S**2 * (behind + INTEGRAL_S * self._sum) + 2 * RATE_S * (wanted[1] - dq)
        arm, ddq = self._arm, wanted[2] + push
        tau = torques(arm.frames, arm.theta, arm.base, q, dq, ddq) + self._motors * ddq
        return np.clip(tau, -self._effort, self._effort)


def simulate(trial: Trial) -> tuple[Array, Array, Array, Array]:
    """Noise-free readings q, dq, tau and the commands (m, n) of a trial.

    Raises:
        RuntimeError: the arm left its limits; the message says which joint.
    """
    disturbance, m = trial.disturbance(), len(trial.times)
    wanted = trial.motion.at(PERIOD_S * np.arange(m + 1, dtype=float))
    truth = trial.arm.with_changes(effects=trial.effects)
    plant, follower = Plant(truth, noise=levels_of("none")), Follower(trial)
    out, rubs = np.empty((4, m, truth.n)), np.zeros((m + 1, truth.n))
    bent = None if trial.friction is None else trial.friction.start * trial.friction.coulomb
    for k in range(m):
        sample = plant.read()
        if plant.fault is not None:
            raise RuntimeError(f"trial {trial.seed}: {plant.fault}")
        q, dq, _ = plant.link_state()
        goal = wanted[0][k + 1], wanted[1][k + 1], wanted[2][k + 1]
        tau = follower.torque(q, dq, goal)
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


def pybullet_recording(trial: Trial) -> Recording:
    """The recording of a trial, noise of the sensors added."""
    q, dq, tau, commands = simulate(trial)
    noise = SensorNoise(trial.noise, trial.arm.n, trial.seed)
    rows = enumerate(zip(q, dq, tau, strict=True))
    arrived = [noise.measure(k, JointSample(k * PERIOD_NS, *row)) for k, row in rows]
    kept = [sample for sample in arrived if sample is not None]
    return Recording(
        trial.arm.joint_names,
        np.array([sample.stamp_ns for sample in kept], np.int64),
        np.array([sample.q for sample in kept]),
        np.array([sample.dq for sample in kept]),
        np.array([sample.tau for sample in kept]),
        commands if trial.commands else None,
    )


def write_recording(recording: Recording, path: Path) -> None:
    """As an MCAP file: joint states and, where there are any, commands; nothing else."""
    rows = zip(recording.stamp_ns.tolist(), recording.q, recording.dq, recording.tau, strict=True)
    with McapWriter(path, recording.joint_names, overwrite=True) as writer:
        for k, row in enumerate(rows):
            writer.write_joint_state(*row)
            if recording.commands is not None:
                writer.write_command(row[0], recording.commands[k])


def write(
    trial: Trial,
    folder: Path | str,
    recording: Recording | None = None,
    simulator: str = "pybullet",
) -> tuple[Path, Path, Path]:
    """Write recording.mcap, nominal.urdf and the sealed truth.json; returns their paths.

    Args:
        trial: as drawn.
        folder: made where it does not exist.
        recording: made by another simulator; by PyBullet where None.
        simulator: its name, for the truth file.
    """
    recording = recording or pybullet_recording(trial)
    truth = {**trial.as_dict(), "simulator": simulator}
    return write_files(recording, nominal_urdf(trial.nominal), truth, Path(folder))


def write_files(
    recording: Recording, model: str, truth: dict[str, Any], folder: Path
) -> tuple[Path, Path, Path]:
    """The three files of a trial: recording, URDF text, contents of the truth file."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = folder / "recording.mcap", folder / "nominal.urdf", folder / "truth.json"
    write_recording(recording, paths[0])
    paths[1].write_text(model, "utf-8")
    paths[2].write_text(seal(truth), "utf-8")
    return paths
