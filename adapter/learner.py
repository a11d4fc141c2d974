"""λ first, then θ: one ADAM update per filtered state, from the moments of all states so far."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from adapter.change import ChangeDetector, ChangeSettings
from adapter.effects.active import Active
from adapter.effects.catalogue import effects_by_name
from adapter.errors import SettingsError
from adapter.known_effects import KnownEffects, believed
from adapter.records import Array, StateLayout, stamp_of
from adapter.rigid_arm import RigidArm
from adapter.schema_learner import SchemaLearner, SchemaSettings
from adapter.spatial import log_rotation
from adapter.theta_learner import ThetaLearner
from adapter.theta_settings import ThetaSettings
from adapter.trace import Trace
from adapter.tree import Tree
from adapter.twist import base_motion

MODES = ("moments", "sample")
JUDGE_THETA_EVERY, ADAPT_EVERY = 100, 1000  # updates
CONVERGED_EXCESS = 1.2  # mean over joints of predicted over fitted error, squares
REBUILD_FLOOR = 1e-5  # rad and m: λ moving less changes no torque that a sensor could show


@dataclass(frozen=True)
class LearnerSettings:
    """How the self is learned.

    Attributes:
        mode: "moments" (all samples at every step) or "sample" (the paper's stochastic step).
        effects: names from the catalogue, learned beside θ.
        seed: of the random start of λ.
        wait_for_schema: whether θ waits until λ has converged.
        held_samples: newest states kept to rebuild θ's moments from when λ has moved.
        rebuild_rows: how many of them each update redoes.
        schema, theta, change: of the parts.
    """

    mode: str = "moments"
    effects: tuple[str, ...] = ()
    seed: int = 0
    wait_for_schema: bool = True
    held_samples: int = 60_000
    rebuild_rows: int = 10
    schema: SchemaSettings = field(default_factory=SchemaSettings)
    theta: ThetaSettings = field(default_factory=ThetaSettings)
    change: ChangeSettings = field(default_factory=ChangeSettings)

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise SettingsError(f"no learner mode '{self.mode}'; have: {', '.join(MODES)}")
        if self.held_samples < 1000:
            raise SettingsError(f"held_samples must be at least 1000, got {self.held_samples}")


@dataclass(frozen=True)
class Change:
    """A change at the hand: when it was seen (stamp of the filtered state, ns)."""

    stamp_ns: int


class Watch(Protocol):
    """What looks over the learner's shoulder; see `adapter.gap.monitor`."""

    @property
    def reports(self) -> list[dict[str, Any]]:
        """What it has to tell."""

    def __call__(self, learner: Learner, table: Array) -> None:
        """Take states (m, size), known effects taken off, that were just learned from."""


class Learner:
    """Takes filtered states, keeps λ, θ and the effects. Deterministic; no clock, no I/O.

    Args:
        tree: N and A of the arm; the networks are built from them alone.
        gravity: (3,) acceleration of gravity in base axes, m/s².
        settings: of the learner.
        noise_gain: of the filter (`JointFilter.noise_gain`).
        tool_theta: (10,) of a known tool on the last link, kept out of θ.
        delay_s: of the filter (`JointFilter.delay_s`).
        known: lasting effects that a model brings, none of bodies (`with_bodies`). Those that
            are learned start from the model's values; the others are taken off the states.
        arm: the model's rigid arm, needed where there are known effects. Its gravity is what
            torques and measured link motion show; where the base is tilted it is not `gravity`,
            that of the documentation, which synthesized link motion is made with.
    """

    def __init__(
        self,
        tree: Tree,
        gravity: Array,
        settings: LearnerSettings | None = None,
        *,
        noise_gain: float = 1.0,
        tool_theta: Array | None = None,
        delay_s: float = 0.0,
        known: Sequence[Active] = (),
        arm: RigidArm | None = None,
    ) -> None:
        self.settings = s = settings or LearnerSettings()
        self.tree, self.layout = tree, StateLayout(tree.n)
        level = base_motion(gravity)
        self.base = level if arm is None else base_motion(arm.gravity)
        self.schema = SchemaLearner(
            tree,
            level,
            s.schema,
            mode=s.mode,
            noise_gain=noise_gain,
            seed=s.seed,
            measured_base=self.base,
        )
        self.theta = ThetaLearner(
            tree,
            self.base,
            effects_by_name(s.effects),
            s.theta,
            mode=s.mode,
            noise_gain=noise_gain,
            tool_theta=tool_theta,
            delay_s=delay_s,
            believed=believed(known, s.effects, tree.n),
        )
        fixed = [active for active in known if active.effect.name not in s.effects]
        self.given = tuple(known)
        self.known: KnownEffects | None = None
        if fixed:
            if arm is None:
                raise SettingsError("effects of a model need the model's arm beside them")
            self.known = KnownEffects(fixed, arm, self.theta.smoothing_s)
        self.change = ChangeDetector(tree.n, s.change)
        from adapter.adam import FlatAdam  # brings torch; the loop process needs only settings

        rate = s.theta.sample_rate if s.mode == "sample" else s.theta.rate
        # one flat parameter, so that one step serves λ and θ
        self.adam = FlatAdam(6 * tree.n + self.theta.P, rate, s.theta.betas)
        self._bind(self.adam.parameters, self.adam.gradient)
        n = tree.n
        self.learned = 0
        self.stamp_ns = 0
        self.theta_started_ns: int | None = None
        self.theta_converged = False
        self.changes: list[Change] = []
        self.watch: Watch | None = None
        self.rebuilds = 0
        self._held = np.zeros((s.held_samples, 4 * n))
        self._held_from, self._held_to = 0, 0  # running numbers of the oldest and next row
        self._R0, self._p = self.schema.R0.copy(), self.schema.p.copy()
        self._alarm_ns = 0
        self._shadow: Array | None = None
        self._shadow_at = 0
        self.schema_trace = Trace(1 + 6 * n)
        self.theta_trace = Trace(1 + self.theta.P, capacity=3000)
        self.score_trace = Trace(1 + 5 * n, capacity=12_000)

    def _bind(self, parameters: Array, gradient: Array) -> None:
        """Let λ's tangent, θ's parameters and their gradients be views of the flat arrays."""
        n = self.tree.n
        parameters[6 * n :] = self.theta.x
        self.schema.tangent = parameters[: 6 * n].reshape(n, 6)
        self.schema.gradient = gradient[: 6 * n].reshape(n, 6)
        self.theta.x, self.theta.gradient = parameters[6 * n :], gradient[6 * n :]

    def step(self, state: Array) -> None:
        """Learn from one filtered state (a record of `StateLayout`): one update of λ and θ."""
        self.step_table(state[None])

    def step_table(self, table: Array) -> None:
        """Add a table (m, size) of filtered states, then make one update of λ and θ."""
        table = self.without_known(table)
        self.learned += len(table)
        self.stamp_ns = stamp_of(table[-1])
        self.schema.absorb(table)
        self.schema.compute_gradient()
        theta_too = self._theta_is_due(table) and self._take_torque(table)
        if self.settings.mode == "moments":
            s = self.settings.theta
            self.adam.rate = s.settled_rate if self.theta_converged else s.rate
        self._adam_step(theta_too)
        if self.schema_trace.wants():
            self.schema_trace.keep(stamp_of(table[-1]), self.schema.lam)
        if self.watch is not None:
            self.watch(self, table)

    @property
    def frames(self) -> tuple[Array, Array]:
        """(R0, p) that θ is learned with: λ as it was when θ's moments were last rebuilt."""
        return self._R0, self._p

    def without_known(self, table: Array) -> Array:
        """Filtered states (m, size), which follow those before, without known effects."""
        return table if self.known is None else self.known.take_off(table)

    def learn_schema(self, table: Array) -> None:
        """λ's half of `step_table` on states that `without_known` has seen.

        An empty table makes one more update on the same moments.
        """
        self.learned += len(table)
        if len(table):
            self.schema.absorb(table)
        self.schema.compute_gradient()
        self._adam_step(theta_too=False)
        if len(table) and self.schema_trace.wants():
            self.schema_trace.keep(stamp_of(table[-1]), self.schema.lam)

    def learn_theta(self, table: Array) -> None:
        """θ's half of `step_table`, λ standing still; an empty table as in `learn_schema`."""
        self.schema.gradient[:] = 0.0
        ready = self._take_torque(table) if len(table) else self.theta.compute_gradient()
        self._adam_step(ready)

    def set_rate(self, rate: float) -> None:
        """Let ADAM go on at this rate per update."""
        self.adam.rate = rate

    def _adam_step(self, theta_too: bool) -> None:
        """One ADAM step on the gradients as they stand; θ's counts only if asked for."""
        if not theta_too:
            self.theta.gradient[:] = 0.0
        self.adam.step()
        self.schema.apply_step(self.adam.rate)
        if theta_too:
            self.theta.after_step(self.theta_converged)

    def _theta_is_due(self, table: Array) -> bool:
        """Whether θ is being learned; sees to it that its moments follow λ."""
        if self.theta_started_ns is None:
            if self.settings.wait_for_schema and not self.schema.converged:
                self._hold(table[:, self.layout.q.start : self.layout.tau.stop])
                return False
            self.start_theta(stamp_of(table[0]))
        elif self.schema.updates % self.settings.schema.judge_every == 0:
            self._follow_schema()
        return True

    def start_theta(self, stamp_ns: int) -> None:
        """Begin to learn θ, with the frames as they are now; states held so far count too."""
        self.theta_started_ns = stamp_ns
        if self._held_to > self._held_from:
            self._begin_rebuild()
        else:
            self._R0[:], self._p[:] = self.schema.R0, self.schema.p

    def _take_torque(self, table: Array) -> bool:
        """Add states to θ's moments; whether there is a gradient to step on."""
        at = self.layout
        q, dq, ddq, tau = table[:, at.q], table[:, at.dq], table[:, at.ddq], table[:, at.tau]
        if self.change.waiting:
            self._look_on(table, self.theta.errors(self._R0, self._p, q, dq, ddq, tau))
            return False
        error = self.theta.absorb(self._R0, self._p, q, dq, ddq, tau)
        self._hold(table[:, at.q.start : at.tau.stop])
        if self._shadow is not None:
            self._rebuild_some(len(table))
        self._look_on(table, error)
        if self.theta.restart_due(len(table)):
            self.theta.restart_spare()
            self._forget_momentum()
        if self.theta.updates % JUDGE_THETA_EVERY == 0:
            self._judge_theta()
        return self.theta.compute_gradient()

    def _judge_theta(self) -> None:
        """θ has converged when it predicts the last seconds as well as it fits all samples."""
        if self.theta.updates % ADAPT_EVERY == 0 and self.theta.count >= ADAPT_EVERY:
            self.theta.adapt_effects()
        excess = float(np.mean(self.change.level / self.theta.variance()))
        limit = CONVERGED_EXCESS if not self.theta_converged else 2.0 * CONVERGED_EXCESS
        self.theta_converged = self.change.samples >= self.change.settings.slow and excess < limit

    def _look_on(self, table: Array, error: Array) -> None:
        """Keep the scores, and notice a change."""
        state, at = table[-1], self.layout
        if self.score_trace.wants():
            signals = state[at.q.start : at.tau.stop]
            self.score_trace.keep(stamp_of(state), signals, error[-1])
        if self.theta_trace.wants():
            self.theta_trace.keep(stamp_of(state), self.theta.th)
        alarmed_before = self.change.waiting
        if self.change.look(error):
            self._start_change(self._alarm_ns)
        elif self.change.waiting and not alarmed_before:
            self._alarm_ns = stamp_of(state)

    def _start_change(self, stamp_ns: int) -> None:
        self.changes.append(Change(stamp_ns))
        self.theta.start_change()
        self._held_from = self._held_to
        self._shadow = None
        self.theta_converged = False
        self._forget_momentum()

    def _forget_momentum(self) -> None:
        """ADAM's averages of θ's gradient are of no use after a jump."""
        self.adam.forget(slice(6 * self.tree.n, None))

    def _hold(self, rows: Array) -> None:
        size, first = len(self._held), self._held_to
        self._held_to += len(rows)
        self._held[np.arange(first, self._held_to) % size if len(rows) > 1 else first % size] = rows
        self._held_from = max(self._held_from, self._held_to - size)

    def _follow_schema(self) -> None:
        """Rebuild θ's moments when λ has left them by more than its standard deviation."""
        turned = log_rotation(np.swapaxes(self._R0, 1, 2) @ self.schema.R0)
        moved = np.concatenate([turned, self.schema.p - self._p], axis=1)
        std = np.sqrt(np.einsum("jaa->ja", self.schema.covariance()))
        if (np.abs(moved) <= np.maximum(std, REBUILD_FLOOR)).all():
            return
        self._begin_rebuild()

    def _begin_rebuild(self) -> None:
        self._R0[:], self._p[:] = self.schema.R0, self.schema.p
        self._shadow = np.zeros_like(self.theta.A)
        self._shadow_at = self._held_from

    def _rebuild_some(self, updates: int) -> None:
        """Redo some of the samples still held with the present λ; swap when all are done."""
        assert self._shadow is not None
        size, n = len(self._held), self.tree.n
        start = max(self._shadow_at, self._held_from)
        stop = min(start + self.settings.rebuild_rows * updates, self._held_to)
        rows = self._held[np.arange(start, stop) % size]
        q, dq, ddq, tau = (np.ascontiguousarray(rows[:, k * n : (k + 1) * n]) for k in range(4))
        self.theta.absorb(self._R0, self._p, q, dq, ddq, tau, into=self._shadow)
        self._shadow_at = stop
        if stop == self._held_to:
            self.theta.replace_moments(self._shadow, float(stop - self._held_from))
            self._shadow = None
            self.rebuilds += 1
