"""What somebody says of a recording: how it tells joints and efforts, where the model does not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from adapter.errors import SettingsError
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm
from adapter.signals.matching import matching, present
from drivers.errors import choices
from drivers.files.mcap import Log


@dataclass(frozen=True)
class Told:
    """What recordings are; where nothing is said, joints are the model's and efforts in N m.

    Attributes:
        joints: told otherwise, one after the other: name in the model, -1 where it is counted the
            other way (else 1), and what is told then where the model's joint is at zero, rad.
        gain: N m per recorded unit, one per joint of the model or one for all; empty: N m.
        gear: turns of the motor per turn of the link, one per joint or one for all, where efforts
            are those of the motors; positions and velocities are those of the links anyway.
        gravity_compensated: the model's gravity is not in the efforts, and is added.
        trusted: what speaks against the recording, so understood, is a note and no refusal.
        learn: the gains; what `gain` says is not used then.
        load_kg: mass of a body that the hand carries in `loaded`, and nowhere else.
        loaded: recordings; all where empty.

    Raises:
        SettingsError: numbers that cannot be.
    """

    joints: tuple[tuple[str, float, float], ...] = ()
    gain: tuple[float, ...] = ()
    gear: tuple[float, ...] = ()
    gravity_compensated: bool = False
    trusted: bool = False
    learn: bool = False
    load_kg: float | None = None
    loaded: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        for option, values in (("--tau-gain", self.gain), ("--gear", self.gear)):
            if not all(np.isfinite(x) and x != 0.0 for x in values):
                raise SettingsError(f"{option} takes finite numbers other than zero, got {values}")
        if self.load_kg is not None and not (np.isfinite(self.load_kg) and self.load_kg > 0.0):
            raise SettingsError(f"--known-load takes a mass above zero, kg, got {self.load_kg}")
        if self.load_kg is not None and not self.learn:
            raise SettingsError("--known-load goes with --tau-gain fit: it fixes the gains' scale")

    @property
    def unit_known(self) -> bool:
        """Whether somebody said which unit efforts have, be it N m, and it is not to be learned."""
        return bool(self.gain or self.gear) and not self.learn

    def log(self, log: Log, model: SelfModel, gain: Array | float = 1.0) -> Log:
        """A recording as the model means it, which every door then takes as such.

        Args:
            log: as read; model: of the arm; gain: (n,) or one, learned, N m per unit.

        Returns:
            One with the model's joints in its order, N m at the links, and without commands where
            joints are turned; the same where nothing is said.

        Raises:
            SettingsError: not one number per joint, or a joint that the model has not.
            DriverError: the recording lacks joints. ModelError: gravity of a moving base.
        """
        if self == AS_RECORDED:
            return log
        model, _ = present(model, log.joint_names, log.path)
        own = matching(log, model)
        names = model.tree.joint_names
        way, zero = np.ones(len(names)), np.zeros(len(names))
        for name, turn, at in self.joints:
            if name not in names:
                raise SettingsError(f"{model.name} has no joint '{name}'; {choices(name, names)}")
            j = names.index(name)
            way[j], zero[j] = turn * way[j], turn * zero[j] + at
        factors = way * gain * _per_joint(self.gear, names, "--gear")
        if not self.learn:
            factors = factors * _per_joint(self.gain, names, "--tau-gain")
        arm = RigidArm.of(model) if self.gravity_compensated else None

        def understood(piece: Log) -> Log:
            q, tau = way * piece.q - zero, factors * piece.tau
            if arm is not None:
                tau = tau + arm.torque(q, np.zeros_like(q), np.zeros_like(q))
            return replace(piece, q=q, dq=way * piece.dq, tau=tau)

        own = own.changed(understood)
        own = replace(own, metadata={**own.metadata, "told": self})
        return replace(own, commands=None) if np.any(way < 0.0) else own


AS_RECORDED = Told()


def told_of(log: Log) -> Told:
    """What was said of a recording, see `Told.log`."""
    told = log.metadata.get("told")
    return told if isinstance(told, Told) else AS_RECORDED


def _per_joint(values: tuple[float, ...], names: Sequence[str], option: str) -> Array:
    if len(values) not in (0, 1, len(names)):
        each = f"one for each of {', '.join(names)} ({len(names)}), got {len(values)}"
        raise SettingsError(f"{option} takes one number for all joints or {each}")
    return np.asarray(np.broadcast_to(np.array(values or (1.0,)), len(names)), dtype=float)
