"""What a robot's file says of its links, judged at reading: what no body has, or no motion shows.

Of 106 robots' files (`example-robot-data`, PyBullet; 1648 links) none is told grams, and six have
inertias that no body has. Of the same links with masses in grams 99 % are told, 85 % where inertias
are in g m² too.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence

import numpy as np

from adapter.errors import ModelError, ModelWarning
from adapter.model.inertia import body_from_theta
from adapter.model.self_model import STANDARD_GRAVITY
from adapter.model.spatial import Array

DENSEST = 22_590.0  # kg/m³, osmium
PLACEHOLDER_KG = 10.0  # lighter links have inertias that nobody measured (a camera's, 1e-6 kg m²)
POINT_M2 = 1e-8  # inertia per mass, of what a file means as a point
LIGHT = 1e-3  # of the heaviest link: what changes nothing is not judged
ROUNDED = 0.05  # of a trace, by which digits left out may make an inertia impossible (2 % seen)
NEGATIVE, NO_SIZE = 1e-3, 1e-12  # of the largest moment, and kg m²: rounding makes less
ALIKE, MANY = 1e-6, 3  # of the largest moment; links of an arm
# What no torque sensor feels: N m to hold a link and turn it at 10 rad/s², with so many kg behind
UNFELT_NM, TURNED, UNFELT_KG = 1e-4, 10.0, 1e-3


def check_links(file: str, links: Mapping[str, Array]) -> None:
    """Warn of links, θ (10,) each by name, with a mass in grams or an inertia that no body has."""
    heaviest = max(float(theta[0]) for theta in links.values())
    grams, impossible = [], []
    for name, theta in links.items():
        mass, _, tensor = body_from_theta(theta)
        least, middle, most = np.linalg.eigvalsh(tensor)
        spread = (least + middle + most) / 2.0
        if mass < LIGHT * heaviest or spread <= POINT_M2 * mass:
            continue
        # no body of this density has its mass as near to its centre as a ball of it
        ball = 4.0 / 3.0 * math.pi * (5.0 / 3.0 * spread / mass) ** 1.5
        if mass >= PLACEHOLDER_KG and mass > DENSEST * ball:
            grams.append(f"'{name}' of {mass:.4g} kg")
        elif most - middle - least > 2.0 * ROUNDED * spread:
            told = ", ".join(f"{x:.3g}" for x in (least, middle, most))
            impossible.append(f"'{name}' ({told} kg m²)")
    _warn(file, "denser than any metal with the inertia it has is link", grams,
          "is its mass in grams? Give kg and kg m²")  # fmt: skip
    _warn(file, "no body has the principal moments of inertia of link", impossible,
          "none may be larger than the other two together, or below zero")  # fmt: skip


def made_up(theta: Array) -> list[int]:
    """Of bodies (n, 10) those that turn alike about all axes, where several do: nobody measured."""
    mass = theta[:, 0]
    moments = [
        np.linalg.eigvalsh(body_from_theta(x)[2]) if x[0] > 0.0 else np.zeros(3) for x in theta
    ]
    balls = np.ptp(moments, axis=1) < ALIKE * np.max(moments, axis=1)
    found = np.flatnonzero(balls & (mass > LIGHT * mass.max()))
    return found.tolist() if len(found) >= MANY else []


def check_moving(file: str, bodies: Sequence[tuple[str, str, int, Array]]) -> None:
    """Judge what moves, with all that is fixed to it.

    Args:
        file: what messages call it.
        bodies: link, its joint, number of the body it hangs on, and θ (10,), the joint turning
            about z through the origin; parents first. A base that floats hangs on no joint ("").

    Raises:
        ModelError: a principal moment of inertia is below zero: no motion can be computed.
    """
    behind, unfelt = np.zeros(len(bodies)), []
    for k in reversed(range(len(bodies))):
        link, joint, over, theta = bodies[k]
        moments = np.linalg.eigvalsh(body_from_theta(theta)[2])
        if moments[0] < -max(NEGATIVE * moments[2], NO_SIZE):
            raise ModelError(
                f"{file}: moving link '{link}' has a principal moment of inertia of "
                f"{moments[0]:.3g} kg m², which is below zero; correct its <inertia>"
            )
        felt = STANDARD_GRAVITY * math.hypot(theta[1], theta[2]) + TURNED * theta[9]
        if joint and felt < UNFELT_NM and behind[k] < UNFELT_KG:
            unfelt.append(f"'{joint}' (link '{link}' of {theta[0]:.3g} kg)")
        if over >= 0:
            behind[over] += behind[k] + theta[0]
    balls = made_up(np.array([theta for *_, theta in bodies]).reshape(-1, 10))
    _warn(file, "somebody made up the inertias, those of a ball, of link",
          [f"'{bodies[k][0]}'" for k in balls],
          "nothing is known of a load or of the links but what logs tell")  # fmt: skip
    _warn(file, "so little hangs on it that no torque shows it: joint", unfelt[::-1],
          "lock it, or give the link its mass and inertia")  # fmt: skip


def _warn(file: str, what: str, found: Sequence[str], do: str) -> None:
    if found:
        warnings.warn(f"{file}: {what} {', '.join(found)}; {do}", ModelWarning, stacklevel=5)
