"""Bodies that can exist: a fit's corrections may ask for others, and no simulator takes those."""

from __future__ import annotations

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from adapter.errors import ModelError
from adapter.gap.evidence import Normal
from adapter.gap.fit import Fit, place_of
from adapter.learning.batch.conic import solve_conic
from adapter.learning.batch.theta_filling import KEPT, UNSOLVED, Measure
from adapter.model.inertia import is_consistent
from adapter.model.spatial import Array


def possible(fit: Fit, known: Normal) -> Fit:
    """The fit at the most probable coefficients with which every body can exist.

    All coefficients give way together, each as far as the data and its prior let it: a link whose
    numbers are corrected alone takes the torques along.

    Args:
        fit: at coefficients that need not be possible.
        known: what is known of them.

    Raises:
        ModelError: the solver gave up without an answer.
    """
    nominal, change = _bodies(fit)
    learned = nominal + np.tensordot(fit.coefficients, change, 1)
    if not len(nominal) or is_consistent(learned):
        return fit
    measure = Measure(nominal)
    root = cholesky(known.G + np.diag(known.prior_std**-2.0), lower=True)
    # of coefficients one standard deviation away, each independent of the others
    slopes = solve_triangular(root, measure.of(change), lower=True)
    size = len(root)
    start = measure.of(learned) - KEPT * measure.own
    z, _, _ = solve_conic(np.eye(size), np.zeros(size), -slopes.T, start, measure.cones)
    found = fit.at(fit.coefficients + solve_triangular(root, z, lower=True, trans=1))
    if not is_consistent(nominal + np.tensordot(found.coefficients, change, 1)):
        raise ModelError(UNSOLVED)
    return found


def _bodies(fit: Fit) -> tuple[Array, Array]:
    """Nominal bodies (b, 10) and their change (c, b, 10) by unit coefficients.

    Each link, and each link with the bodies that were named on it and act at the same time. Left
    out is what cannot exist by the nominal model.
    """
    theta, size = fit.recordings[0].motion.arm.theta, len(fit.coefficients)
    link = {
        k: e.candidate.joint % fit.n
        for k, e in enumerate(fit.named)
        if e.candidate.columns_are_theta
    }
    parts: list[tuple[int, list[int]]] = [(j, []) for j in range(fit.n)]
    for k, j in link.items():
        begin, end = fit.named[k].interval_s
        others = [i for i in link if link[i] == j and fit.named[i].interval_s[0] < end]
        parts.append((j, [i for i in others if fit.named[i].interval_s[1] > begin]))
    parts = [part for part in parts if is_consistent(theta[part[0]])]
    change = np.zeros((size, len(parts), 10))
    for b, (j, named) in enumerate(parts):
        change[10 * j : 10 * j + 10, b] = np.eye(10)
        for k in named:
            change[place_of(fit, k), b] = fit.named[k].candidate.theta
    return theta[[j for j, _ in parts]], change
