"""λ from sensors mounted anyhow on links: what `Schema` is where link motion is measured whole.

The readings of a run are held and solved as a whole (`imu_fit`), again and again while they grow,
each time from where the last solution stood. What is no longer held stays as a paraboloid.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from adapter.errors import SettingsError
from adapter.learning.imu_fit import FRAME_STD, Estimate, Fit, ImuFit, Prior, told_apart
from adapter.learning.imu_windows import LONGEST_GAP_S, Readings
from adapter.learning.schema import RestingBase, Schema
from adapter.learning.settings import SchemaSettings
from adapter.model.spatial import Array, matrix_from_zxz
from adapter.model.tree import Tree
from adapter.signals.records import KIND, LinkMotionKind, stamps_of
from drivers.errors import choices

FIRST_S, GROWTH, MOST_S = 1.0, 1.25, 4.0  # of motion: first solution, and from one to the next
SLOWEST_HZ = 40.0
SURE = 2.0  # standard deviations that λ may move from one solution to the next
HEARD, W, A = 0, slice(3, 6), slice(6, 9)  # of the motion row of a link


class ImuSchema(Schema):
    """λ from gyroscopes and accelerometers.

    Args:
        tree, base, settings: see `Schema`; `settings.imus` names the links with a sensor.
        lam: (n, 6) documented λ, where the search starts and what no data show stays.

    Raises:
        SettingsError: a sensor on no link of the tree, or on a base that floats.
    """

    def __init__(self, tree: Tree, base: RestingBase | None, settings: SchemaSettings, lam: Array):
        super().__init__(tree, base, settings)
        for name in settings.imus:
            if name not in tree.link_names:
                have = choices(name, tree.link_names)
                raise SettingsError(f"no link '{name}' that a sensor could be on; {have}")
        sliding = [x for x, slides in zip(tree.joint_names, tree.slides, strict=True) if slides]
        if sliding:
            raise SettingsError(
                f"joint {', '.join(sliding)} slides; from sensors on links λ is learned of joints "
                "that turn: lock it, or leave --imu out"
            )
        self._tree = tree
        self._links = tuple(tree.link_names.index(name) for name in settings.imus)
        if base is None:
            raise SettingsError("sensors on links need a base that rests")
        self._gravity = -base.measured[6:9]
        self.set_lam(lam)
        self.start_lam = self.lam
        self.kind = LinkMotionKind.MEASURED
        self._tables: list[Array] = []
        self._since_ns: int | None = None
        self._last_s, self._moved_s, self._solved_s = 0.0, 0.0, 0.0
        self._waiting = 0  # updates since the last reading
        self._used: tuple[int, ...] = ()
        self._prior: Prior | None = None
        self._at: Estimate | None = None
        self._astray: list[str] = []
        self._unfit: dict[str, str] = {}
        self._covariance = np.zeros((tree.n, 6, 6))

    @property
    def notes(self) -> list[str]:
        """What is wrong with sensors, a sentence each."""
        return [*self._unfit.values(), *self._astray]

    def absorb(self, table: Array) -> None:
        """Hold a table (m, size) of filtered states with readings of sensors."""
        table = table[table[:, KIND] == LinkMotionKind.IMU]
        if not len(table):
            return
        stamps = stamps_of(table)
        if self._since_ns is None:
            self._since_ns = int(stamps[0])
        t_s = 1e-9 * (stamps - self._since_ns)
        motion = table[:, self.layout.motion].reshape(len(table), -1, 12)[:, list(self._links)]
        told = motion[..., :9].reshape(len(table), -1)
        rows = t_s[:, None], table[:, self.layout.motion_q], told
        self._tables.append(np.concatenate(rows, axis=1))
        steps = np.diff(t_s, prepend=self._last_s)
        self._last_s = float(t_s[-1])
        self._moved_s += float(steps[(steps > 0.0) & (steps <= LONGEST_GAP_S)].sum())
        self.moments.counts[0] += len(table)
        self._waiting = 0

    def compute_gradient(self) -> None:
        """Solve anew where enough has come, or no more is coming; ADAM has nothing to do."""
        self.updates += 1
        self.looked = self.updates % self.settings.judge_every == 0
        self._waiting += 1
        more_s, known_s = self._moved_s - self._solved_s, self._solved_s
        due_s = min(max(FIRST_S, (GROWTH - 1.0) * known_s), MOST_S)
        if more_s >= due_s or (more_s > 0.0 and self._waiting > 100):  # no more is coming
            self._solved_s = self._moved_s
            self._solve()

    def apply_step(self, rate: float) -> None:
        """λ is where the last solution put it."""
        self.tangent[:] = 0.0

    def covariance(self) -> Array:
        """(n, 6, 6) covariance of (phi, d) in the directions the data show, zero in others."""
        return self._covariance.copy()

    def _solve(self) -> None:
        rows = np.concatenate(self._tables)
        self._tables = [rows]
        self._choose(rows)
        if not self._used:
            return
        n = self._tree.n
        _, first = np.unique(rows[:, 0], return_index=True)  # in order of time
        ordered = rows[first]
        told = ordered[:, 1 + n :].reshape(len(ordered), -1, 9)[:, list(self._used)]
        told = np.where(told[..., HEARD, None] > 0.0, told, np.nan)
        readings = Readings(ordered[:, 0], ordered[:, 1 : 1 + n], told[..., W], told[..., A])
        fit = self._fit_of(readings)
        if not fit.count:
            return
        if self._at is None:
            self._at = fit.begin(self.R0, self.p)
        # the documented frames, and sensors of which nothing is known but what turns them
        frames = matrix_from_zxz(self.start_lam[:, :3]), self.start_lam[:, 3:]
        prior = self._prior or Prior.springs(Estimate.of(*frames, self._at.turn))
        found = fit.solve(prior, self._at)
        self._take(found)
        if readings.t_s[-1] - readings.t_s[0] > 60.0:  # the older half becomes a paraboloid
            old = len(rows) // 2
            half = self._fit_of(Readings(*(x[:old] for x in readings)))
            self._prior = half.known(prior, found.estimate)
            self._tables = [rows[old:]]

    def _fit_of(self, readings: Readings) -> ImuFit:
        links = tuple(self._links[s] for s in self._used)
        return ImuFit(self._tree, self._gravity, links, readings)

    def _choose(self, rows: Array) -> None:
        """Sensors that can be used; where they become others, the search begins anew."""
        if self._prior is not None:  # made with those of now
            return
        told = rows[:, 1 + self._tree.n :].reshape(len(rows), -1, 9)
        self._unfit = {}
        for s, name in enumerate(self.settings.imus):
            heard = told[:, s, HEARD] > 0.0
            wrong = _wrong(rows[heard, 0], told[heard, s, 3:])
            if wrong:
                self._unfit[name] = f"the sensor on {name} {wrong}; it is left out"
        good = [s for s, name in enumerate(self.settings.imus) if name not in self._unfit]
        if tuple(good) != self._used:
            self._used, self._at = tuple(good), None

    def _take(self, found: Fit) -> None:
        """Take over a solution, and judge how well λ is known."""
        before_R0, before_p = self.R0.copy(), self.p.copy()
        self._at = found.estimate
        self.R0[:], self.p[:] = found.estimate.R0, found.estimate.p
        ranks, calm = np.zeros(self._tree.n, dtype=np.int64), True
        moved = self.moved_from(before_R0, before_p)
        apart = told_apart(self._tree, self._gravity, found.estimate)
        for j, basis in enumerate(apart):
            own = slice(6 * j, 6 * j + 6)
            values, vectors = np.linalg.eigh(basis.T @ found.covariance[own, own] @ basis)
            vectors = basis @ vectors
            shown = values < FRAME_STD**2 / 10.0  # times what the springs say
            certain = shown & (values < self.settings.std_goal**2)
            self._covariance[j] = (vectors[:, shown] * values[shown]) @ vectors[:, shown].T
            self.identifiable[j] = vectors[:, shown] @ vectors[:, shown].T
            self.certain[j] = vectors[:, certain] @ vectors[:, certain].T
            self.information[j] = (vectors / values) @ vectors.T
            ranks[j] = certain.sum()
            step = np.abs(vectors[:, certain].T @ moved[j])
            std = np.sqrt(values[certain])
            calm &= bool((step < np.maximum(self.settings.distance_goal, SURE * std)).all())
        names = [self.settings.imus[s] for s in self._used]
        self._astray = [
            f"the sensor on {name} turns otherwise than {name} of the model does (off by "
            f"{100.0 * share:.0f} % of how it turns); which link is it on?"
            for name, share in zip(names, found.w_share, strict=True)
            if share > 0.2  # it is not on that link, or mad
        ]
        calm &= not self._astray and bool(ranks.any()) and bool((ranks == self.ranks).all())
        self.rank, self.ranks[:] = int(np.einsum("jaa->", self.identifiable).round()), ranks
        self.converged = calm

    def more_state(self) -> dict[str, Array]:
        """What a checkpoint holds of this beside what it holds of any `Schema`."""
        state = {
            "rows": np.concatenate(self._tables) if self._tables else np.zeros((0, 0)),
            "course": np.array([self._last_s, self._moved_s, self._solved_s, self._waiting]),
            "since": np.array([] if self._since_ns is None else [self._since_ns], dtype=np.int64),
            "used": np.array(self._used, dtype=np.int64),
            "covariance": self._covariance,
            "notes": np.array([*self._unfit.values(), *self._astray], dtype=str),
        }
        if self._at is not None:
            state |= self._at.arrays("at.")
        if self._prior is not None:
            state |= self._prior.centre.arrays("centre.")
            state |= {"gradient": self._prior.gradient, "curvature": self._prior.curvature}
        return state

    def take_state(self, state: Mapping[str, Array]) -> None:
        """Go on from what `more_state` gave."""
        self._tables = [state["rows"]] if state["rows"].size else []
        self._last_s, self._moved_s, self._solved_s, waiting = state["course"].tolist()
        self._waiting, since = int(waiting), state["since"].tolist()
        self._since_ns = since[0] if since else None
        self._used = tuple(state["used"].tolist())
        self._covariance[:] = state["covariance"]
        self._astray = state["notes"].tolist()
        self._at = Estimate.from_arrays(state, "at.")
        centre = Estimate.from_arrays(state, "centre.")
        if centre is not None:
            self._prior = Prior(centre, state["gradient"], state["curvature"])


def _wrong(t_s: Array, told: Array) -> str | None:
    """Why readings (k, 6) of a sensor cannot be used; None where they can."""
    if len(t_s) < 20:  # readings of a sensor
        return f"was heard {len(t_s)} times"
    rate = 1.0 / float(np.median(np.diff(t_s)))
    if rate < SLOWEST_HZ:
        return f"reads {rate:.3g} times a second, and {SLOWEST_HZ:.0f} are needed"
    if (np.ptp(told[:, :3], axis=0) == 0.0).all() or (np.ptp(told[:, 3:], axis=0) == 0.0).all():
        return "always reads the same"
    return None
