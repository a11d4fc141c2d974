"""Whether a recording's efforts are motor currents, joint by joint.

Every joint's drive has a gain of its own (8 to 15 N m/A at the link of a UR), so that no common
factor shows. What shows is the share of the model's torque that each joint's effort holds once
its friction and offset, which have unknown sizes in an unknown unit, are left out: no arm of the
model has a quarter of it on most joints, in the model's shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adapter.model.spatial import Array
from adapter.screening.torque_units import EFFECTIVE, SEEN_NM, TorqueComparison

IMPOSSIBLE = 0.25  # share of the model's torque, two standard deviations up; 40 % wrong: 0.6
MIDDLE = 0.2  # of the joints' shares: gains of drives seen are 8 to 15
ALIKE = 0.7  # correlation with the model; torques without gravity of such a share stay below 0.5
CLEAR = 4.0  # standard deviations of the share, from which on a joint tells anything
CHOICES = (
    "convert them with --tau-gain G1,G2,... (N m per recorded unit, one per joint or one for "
    "all), learn the gains with --tau-gain fit, or give --gear G1,G2,... where they are torques "
    "of the motors; --tau-gain 1 takes them as N m."
)


@dataclass(frozen=True, eq=False)
class TorqueShares:
    """How much of the model's torque each joint's effort holds.

    Attributes:
        share: (n,) recorded units per N m of the model; std: (n,) of it.
        tells: (n,) whether a joint's motion shows its share.
        alike: correlation of efforts and model, friction left out, over the joints that tell.
    """

    share: Array
    std: Array
    tells: NDArray[np.bool_]
    alike: float

    @property
    def times(self) -> Array:
        """(n,) N m per recorded unit; of a joint that tells nothing that of the middle one."""
        if not self.tells.any():
            return np.ones(len(self.share))
        own = np.where(self.tells, np.abs(self.share), 1.0)
        middle = float(np.median(own[self.tells]))
        return np.asarray(1.0 / np.where(self.tells, own, middle))

    @property
    def are_currents(self) -> bool:
        """Whether no arm of the model has such torques, and the model has them in another size."""
        if not self.tells.any() or self.alike < ALIKE:
            return False
        share = np.abs(self.share[self.tells])
        impossible = share + 2.0 * self.std[self.tells] < IMPOSSIBLE
        return bool(2 * impossible.sum() > len(share) and np.median(share) < MIDDLE)


def torque_shares(comparison: TorqueComparison, tau: Array) -> TorqueShares:
    """Of efforts tau (m, n) in any unit, joint by joint."""
    n = tau.shape[1]
    share, std, seen = np.zeros(n), np.full(n, np.inf), np.zeros(n, dtype=bool)
    with_model, with_both, with_tau = np.zeros(n), np.zeros(n), np.zeros(n)
    for j in range(n):
        columns = comparison.friction[:, :, j].T
        both = np.column_stack([comparison.model[:, j], tau[:, j]])
        model, read = (both - columns @ np.linalg.lstsq(columns, both, rcond=None)[0]).T
        size = float(model @ model)
        if size <= len(model) * SEEN_NM**2:
            continue
        share[j] = float(model @ read) / size
        left = read - share[j] * model
        std[j] = np.sqrt(left @ left / size / min(EFFECTIVE, len(left)))
        seen[j] = std[j] * CLEAR < abs(share[j])
        weight = comparison.sigma[j] ** -2
        with_model[j], with_both[j] = weight * size, weight * float(model @ read) / abs(share[j])
        with_tau[j] = weight * float(read @ read) / share[j] ** 2
    parts = (float(x[seen].sum()) for x in (with_model, with_both, with_tau))
    model_size, product, tau_size = parts
    alike = abs(product) / np.sqrt(model_size * tau_size) if seen.any() else 0.0
    return TorqueShares(share, std, seen, float(alike))


def in_words(shares: TorqueShares, names: Sequence[str]) -> str:
    """What such efforts are, and what to do."""
    telling = np.flatnonzero(shares.tells).tolist()
    which = ", ".join(names[j] for j in telling)
    times = ", ".join(f"{x:.3g}" for x in shares.times[telling])
    silent = [name for j, name in enumerate(names) if not shares.tells[j]]
    rest = f" ({', '.join(silent)}: not shown)" if silent else ""
    return (
        f"effort of {which} looks like motor current: {times} times too small for any arm of this "
        f"model{rest}; {CHOICES}"
    )
