"""What a run that moves sets in the robot first: collision thresholds and the load at its hand.

Both outlast a connection, so that a robot otherwise goes by what its last client left.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np

from drivers.fci import codec, tables
from drivers.fci.codec import WireError
from drivers.fci.connect import REPLY_LIMIT_S, Channel
from drivers.interface import Array, DriverError, NotReady

# Beyond these the robot stops; N m by joint, then N and N m at the hand. Those with which Franka's
# examples (libfranka, generate_*_motion) move freely, for both of its phases.
TORQUES: Final = (20.0, 20.0, 18.0, 18.0, 16.0, 14.0, 12.0)
FORCES: Final = (20.0, 20.0, 20.0, 25.0, 25.0, 25.0)
# What Franka's examples call the default (setDefaultBehavior): while it accelerates, else.
DEFAULT_PHASES: Final = (20.0, 10.0)
KEEP: Final = "keep"
LEAST, MOST = 0.1, 5.0  # of `?collision`
HEAVIEST_KG: Final = 10.0  # no robot here carries half of it


class Load(NamedTuple):
    """A load at the hand: mass (kg), centre (3,) from the flange (m), inertia (9,) about it."""

    mass: float
    com: Array
    inertia: Array

    def payload(self) -> bytes:
        """Of SetLoad."""
        return struct.pack("<13d", self.mass, *self.com, *self.inertia)


def parse(address: str, options: Mapping[str, str]) -> tuple[float | None, Load | None]:
    """What the options of an address ask for: a factor of `TORQUES` and `FORCES`, and the load.

    None leaves the robot's thresholds, or its load, alone. Raises DriverError with the choices.
    """
    text, load = options.get("collision", "1"), options.get("load", "0")
    try:
        collision = None if text == KEEP else float(text)
        if collision is not None and not LEAST <= collision <= MOST:
            raise ValueError
    except ValueError as error:
        raise DriverError(
            f"'{address}': collision is a factor from {LEAST:g} to {MOST:g}, or {KEEP}"
        ) from error
    try:
        if load == KEEP:
            return collision, None
        mass, *com = map(float, load.split(","))  # a solid ball of hand size, m from the flange
        com = com or [0.0, 0.0, 0.0]
        if len(com) != 3 or not 0.0 <= mass <= HEAVIEST_KG or not all(abs(x) <= 1.0 for x in com):
            raise ValueError
        ball = 0.4 * mass * 0.04**2 * np.eye(3)  # m
        return collision, Load(mass, np.array(com), ball.ravel())
    except ValueError as error:
        raise DriverError(
            f"'{address}': load is KG or KG,X,Y,Z (m from the flange) up to {HEAVIEST_KG:g} kg, "
            f"or {KEEP}"
        ) from error


class RobotSettings:
    """Sets and gives back over one connection.

    Args:
        version: of the protocol.
        channel: connected.
        wanted: by the address, see `parse`.
    """

    def __init__(
        self, version: int, channel: Channel, wanted: tuple[float | None, Load | None]
    ) -> None:
        self._version, self._channel, self._wanted = version, channel, wanted
        self._thresholds_set = False
        self._former: Load | None = None

    def apply(self, former: Load) -> str:
        """Set what is wanted; a sentence with the values.

        Args:
            former: the load that the robot has by now.

        Raises:
            NotReady: the robot refuses.
            DriverError: it does not answer.
        """
        said = []
        factor, load = self._wanted
        if factor is None:
            said.append("collision thresholds are as the last client left them")
        else:
            torques, forces = factor * np.array(TORQUES), factor * np.array(FORCES)
            self._set("SetCollisionBehavior", _thresholds((torques, torques), (forces, forces)))
            self._thresholds_set = True
            said.append(
                f"collision thresholds are {_row(torques)} N m, {_row(forces[:3])} N and "
                f"{_row(forces[3:])} N m until the end (?collision={factor:g})"
            )
        if load is None:
            said.append(f"the robot takes the load at its hand for {former.mass:g} kg, as before")
        else:
            self._set("SetLoad", load.payload())
            self._former = former
            changed = "" if former.mass == load.mass else f", {former.mass:g} kg before and after"
            said.append(f"the load at its hand is {load.mass:g} kg{changed} (?load=)")
        return "; ".join(said)

    def restore(self) -> None:
        """Put back the load that was there and the default thresholds. Raises DriverError."""
        former, self._former = self._former, None
        thresholds, self._thresholds_set = self._thresholds_set, False
        if former is not None:
            self._set("SetLoad", former.payload())
        if thresholds:
            both = tuple(np.full(7, x) for x in DEFAULT_PHASES)
            forces = tuple(np.full(6, x) for x in DEFAULT_PHASES)
            self._set("SetCollisionBehavior", _thresholds(both, forces))

    def _set(self, name: str, payload: bytes) -> None:
        asked = self._channel.send(tables.SETTINGS[name][self._version], payload)
        try:
            reply = self._channel.wait(asked, REPLY_LIMIT_S)
            status = None if reply is None else codec.status_reply(reply)
        except WireError as error:
            raise DriverError(f"the robot answers {name} with {error}: connect again") from error
        if status is None:
            raise DriverError(
                f"the robot does not answer {name}: connect again, or leave what it has "
                f"(?collision={KEEP}&load={KEEP})"
            )
        said = tables.status_name(tables.SET_STATUS, status)
        if said != "success":
            raise NotReady(
                f"the robot does not take {name}: {tables.meaning(said)}; or leave what it has "
                f"(?collision={KEEP}&load={KEEP})"
            )


def _thresholds(torques: tuple[Array, ...], forces: tuple[Array, ...]) -> bytes:
    """Payload of SetCollisionBehavior: contact and collision alike, in each of the two phases."""
    rows = [row for pair in (torques, forces) for row in np.repeat(pair, 2, axis=0)]
    return struct.pack("<52d", *np.concatenate(rows))


def _row(values: Array) -> str:
    return " ".join(f"{x:g}" for x in values)
