"""λ first, then θ: one ADAM update per filtered state, from the moments of all states so far.

One learner for every tree: the Panda on the bench, whose base rests, and ATLAS in free fall,
whose base's motion comes with each state.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from adapter.errors import ModelError, SettingsError
from adapter.judgement.noise import memory_s
from adapter.learning.adam import FlatAdam, same_bits
from adapter.learning.change import ChangeDetector, explained_share, is_new
from adapter.learning.imu_schema import ImuSchema
from adapter.learning.known_effects import KnownEffects
from adapter.learning.posterior import LearnedPosterior, learned_posterior
from adapter.learning.schema import RestingBase, Schema
from adapter.learning.settings import LearnerSettings, Mode
from adapter.learning.steps import Done, steps
from adapter.learning.theta import Filtered, KnownArm, Theta
from adapter.learning.theta_kernels import Moments
from adapter.learning.torque_rates import TorqueRates
from adapter.learning.trace import Trace
from adapter.model.spatial import Array
from adapter.model.tree import Tree
from adapter.physics.kernels import JointMotion, base_at_rest, jit, placed, regressors
from adapter.signals.records import StateLayout, stamp_of, stamps_of

JUDGE_THETA_EVERY, ADAPT_EVERY = 100, 1000  # updates
AHEAD = 100  # states that are looked at for one call of `steps`
CONVERGED_EXCESS = 1.2  # mean over joints of predicted over fitted error, squares
# No joint of a robot shows more; a state beyond is refused as a NaN is.
MOST_Q, MOST_DQ, MOST_DDQ, MOST_TAU = 1e4, 60.0, 2e4, 1e5  # rad, rad/s, rad/s², N m and N
MOST_MOTION = np.repeat([1e3, 60.0, 2e3, 2e4], 3)  # [v w a dw], m/s (a fall is fast), rad/s, ...


class Watch(Protocol):
    """What looks over the learner's shoulder; see `adapter.gap.monitor`."""

    @property
    def reports(self) -> list[dict[str, Any]]:
        """What it has to tell."""

    def __call__(self, learner: OnlineLearner, table: Array) -> None:
        """Take states (m, size), known effects taken off, that were just learned from."""


class TorqueVerdict(NamedTuple):
    """Whether torques are those of the arm that is learned; see `adapter.screening.screen`.

    Attributes:
        judged: there was motion enough to tell.
        refusal: why they are not, a sentence; None where nothing says so.
        notes: what was said of them so far, a sentence each.
    """

    judged: bool = True
    refusal: str | None = None
    notes: tuple[str, ...] = ()

    @property
    def good(self) -> bool:
        """Whether what is learned from them may be called converged."""
        return self.judged and self.refusal is None


NOT_ASKED = TorqueVerdict()  # whoever gives the states has judged them


class OnlineLearner:
    """Takes filtered states, keeps λ, θ and the effects. Deterministic; no clock, no I/O.

    Args:
        tree: N and A; the networks are built from them alone.
        gravity: (3,) acceleration of gravity in base axes, m/s²; not needed where the base
            floats, since its measured acceleration tells.
        settings: of the learner.
        filtered: what the filter did to the states.
        known: what is known of the robot.

    Attributes:
        schema, theta: λ and θ, with what is known of them.
        base: (12,) motion of a base that rests, as sensors feel it; empty where it floats.
        documented: (n, 10) θ of the links that the posterior tells loads by; None where unknown.
        learned, refused: states taken, and states refused for numbers that are not finite or
            that no robot shows.
        theta_started_ns: stamp at which θ began; None before.
        rebuilds: times that θ's moments were rebuilt for a better λ.
        changes: stamps, ns, of the filtered states at which a change at the hand was seen.
        screen: judges the states that `step` is given, see `adapter.runs.live`; verdict:
            what it said last.

    Raises:
        SettingsError: no gravity for a base that rests, or effects without the model's arm.
    """

    def __init__(
        self,
        tree: Tree,
        gravity: Array | None = None,
        settings: LearnerSettings | None = None,
        filtered: Filtered | None = None,
        known: KnownArm | None = None,
    ) -> None:
        self.settings = s = settings or LearnerSettings()
        filtered, known = filtered or Filtered(), known or KnownArm()
        self.tree, self.layout = tree, StateLayout(tree.n, tree.floating)
        each_sample = s.mode == Mode.SAMPLE
        rest = None
        if not tree.floating:
            if gravity is None:
                raise SettingsError("a robot whose base rests needs the gravity it stands in")
            documented = base_at_rest(gravity)
            measured = documented if known.arm is None else base_at_rest(known.arm.gravity)
            rest = RestingBase(documented, measured)
        self.base = np.empty(0) if rest is None else rest.measured
        if not s.schema.imus:
            self.schema = Schema(tree, rest, s.schema, each_sample, s.seed)
        elif known.lam is None:
            raise SettingsError("sensors on links need a documented λ to start from")
        else:
            self.schema = ImuSchema(tree, rest, s.schema, known.lam)
        self.theta = Theta(tree, self.base, s, filtered, known)
        by_rates = any(effect.by_rates for effect in self.theta.effects)
        self._rates = TorqueRates(tree, self.theta.smoothing_s, filtered.delay_s)
        self.rates = self._rates if by_rates else None
        places = [
            (own.start, self.layout.rates.start + effect.rate * tree.n)
            for effect, own in zip(self.theta.effects, self.theta.own, strict=True)
            if effect.rate is not None
        ]
        self._which = np.array(places, dtype=np.int64).reshape(-1, 2)
        self._rates_known = False
        self.given, self.documented = tuple(known.effects), known.theta
        self._filtered = filtered
        self.known = _taken_off(known, s.effects, self.theta.smoothing_s, tree.floating)
        self.change = ChangeDetector(tree.n, s.change)
        rate = s.theta.sample_rate if each_sample else s.theta.rate
        # one flat parameter, so that one step serves λ and θ
        self.adam = FlatAdam(6 * tree.n + self.theta.P, rate, s.theta.betas)
        # λ's tangent, θ's parameters and their gradients are views of the flat arrays
        tangent, x = np.split(self.adam.parameters, [6 * tree.n])
        x[:] = self.theta.x
        self.schema.tangent, self.theta.x = tangent.reshape(-1, 6), x
        slope, self.theta.gradient = np.split(self.adam.gradient, [6 * tree.n])
        self.schema.gradient = slope.reshape(-1, 6)
        self._cap, at = np.full(self.layout.size, np.inf), self.layout  # stamps may be anything
        joint = (at.q, MOST_Q), (at.dq, MOST_DQ), (at.ddq, MOST_DDQ), (at.tau, MOST_TAU)
        for part, most in (*joint, (at.motion_q, MOST_Q), (at.motion_dq, MOST_DQ)):
            self._cap[part] = most
        self._cap[at.motion] = np.tile(MOST_MOTION, at.n)
        if at.floating:
            self._cap[at.base] = MOST_MOTION
        self.learned = self.refused = self.rebuilds = 0
        self.stamp_ns = 0
        self.theta_started_ns: int | None = None
        self.theta_converged = False
        self.changes: list[int] = []
        self.watch: Watch | None = None
        self.screen: Callable[[Array], TorqueVerdict] | None = None
        self.verdict = NOT_ASKED
        self._since_update, self._states_per_update = 0, float(s.update_every)
        self._held = np.zeros((s.held_samples, self.layout.before_links.stop))
        self._held_from, self._held_to = 0, 0  # running numbers of the oldest and next row
        self._R0, self._p = self.schema.R0.copy(), self.schema.p.copy()
        self._alarm_ns = 0
        self._doubted: list[tuple[Array, Array]] = []  # states and errors since an alarm
        self._judged = 0
        self._shadow: Moments | None = None
        self._shadow_at = 0
        self.schema_trace = Trace(2 + 13 * tree.n)
        self.theta_trace = Trace(1 + self.theta.P, capacity=3000)
        moving = 12 if tree.floating else 0  # numbers of the base's motion
        memory = self.layout.memory.stop - self.layout.memory.start
        self.score_trace = Trace(1 + 5 * tree.n + moving + memory, capacity=12_000)
        self._torque_states = np.zeros((0, self.layout.before_links.stop))

    def step(self, state: Array) -> bool:
        """Learn from one filtered state (a record of `StateLayout`): one update of λ and θ.

        Returns:
            False where it was refused, and nothing is changed.

        Raises:
            ModelError: a record of another size.
        """
        if self.screen is not None:
            self.verdict = self.screen(state)
        return self.step_table(state[None]) == 1

    def step_table(self, table: Array) -> int:
        """Add a table (m, size) of filtered states, then make one update of λ and θ.

        Returns:
            How many of them were learned from; the others are counted in `refused`.

        Raises:
            ModelError: records of another size.
        """
        table = self.without_known(self.sound(table))
        return self._learn(table) if len(table) else 0

    def step_each(self, table: Array) -> int:
        """`step` with each of the states (m, size), in order, to the same bits.

        Returns:
            How many of them were learned from; the others are counted in `refused`.

        Raises:
            ModelError: records of another size.
        """
        table, at = self.without_known(self.sound(table)), 0
        while at < len(table):
            at += self._learn_each(table[at : at + AHEAD]) or self._learn(table[at : at + 1])
        return len(table)

    def _learn(self, table: Array) -> int:
        """`step_table` on states, at least one, that can be learned from; how many there were."""
        self.stamp_ns = stamp_of(table[-1])
        self.schema.absorb(table)
        self._since_update += len(table)
        updating = self._since_update >= self.settings.update_every
        if updating:
            self._since_update = 0
            self._schema_gradient()
        return self._learn_theta_too(table, updating)

    def _learn_theta_too(self, table: Array, updating: bool) -> int:
        """The rest of `_learn`, λ having seen the states and, if it is updating, its gradient."""
        due = self._theta_is_due(table)
        theta_too = due and self._take_torque(table)
        if updating:
            theta_too = theta_too and self.theta.compute_gradient()
            self.follow_convergence()
            self._adam_step(theta_too)
        self.learned += len(table)
        self._trace_schema(table)
        if self.watch is not None:
            self.watch(self, self._torque_states if due else table)
        return len(table)

    def _learn_each(self, table: Array) -> int:
        """Take the first states of a table in one call; how many, none where it cannot be."""
        steady = table[: self._steady(table)]
        if self.rates is None:
            rows = np.ascontiguousarray(steady[:, self.layout.before_links])
            ends = np.arange(1, len(steady) + 1)
        else:
            rows, ends = self.rates.coming(steady)
        if not len(ends):
            return 0
        self.schema.absorb(table[:1])
        self._schema_gradient()
        table = table[: self.schema.until_look(table[: len(ends)])]
        ends = ends[: len(table)]
        if not ends[-1] or (self.schema.looked and self._strayed()):
            return self._learn_theta_too(table[:1], True)
        if self.schema.looked:
            self._judge_theta()
        self.follow_convergence()
        rows, m, n = rows[: ends[-1]], len(ends), self.tree.n
        done = Done(
            rows,
            self.theta.effect_columns(rows),
            np.empty((len(rows), n)),
            ends,
            np.empty((m, 2)),
            np.empty((m, self.theta.P)),
            np.empty((m, n, 3, 3)),
            np.empty((m, n, 3)),
        )
        count = int(steps(table, self._parts(int(ends[-1])), tuple(done)))
        self.schema.updates += count - 1
        self.adam.steps += count
        self.theta.count += self.theta.weight * int(ends[count - 1])
        self.theta.updates += count
        self._look_back(table[:count], done)
        return count

    def _steady(self, table: Array) -> int:
        """How many states (m, size) from here on need nothing that `steps` does not do."""
        s = self.settings
        if s.mode != Mode.MOMENTS or s.update_every > 1 or self.tree.floating or s.schema.imus:
            return 0
        begun = self.theta_started_ns is not None and self._shadow is None
        if not begun or self.change.waiting or self.change.each > 1 or not self.theta.steady():
            return 0
        if (self.rates is not None and not self._rates_known) or not same_bits():
            return 0
        return self.schema.steady(table)

    def _look_back(self, table: Array, done: Done) -> None:
        """Count, trace and look at what `steps` has done with states (m, size)."""
        ends = done.ends[: len(table)]
        rows = self._torque_states = done.rows[: ends[-1]]
        self.stamp_ns = stamp_of(table[-1])
        self.learned += len(table)
        self._hold(rows)
        self._keep_scores(rows, done.errors[: ends[-1]])
        for k in self.theta_trace.due(len(rows)):
            step = int(np.searchsorted(ends, k, side="right"))
            self.theta_trace.keep(stamp_of(rows[k]), done.th[step])
        self.change.weigh_all(np.diff(ends, prepend=0), done.ratios)
        if self.change.waiting:
            self._alarm_ns = stamp_of(rows[-1])
            self._doubted.clear()
        for k in self.schema_trace.due(len(table)):
            known = self.schema.ranks.astype(float), float(self.schema.converged)
            self.schema_trace.keep(stamp_of(table[k]), done.R0[k], done.p[k], *known)
        if self.watch is not None:
            self.watch(self, rows)

    def _parts(self, ahead: int) -> tuple[Any, ...]:
        """What `steps` needs, with so many states ahead for θ."""
        adam = self.adam
        moved = adam.parameters, adam.gradient, adam.first, adam.second, adam.steps
        span_ns, *rates = self._rates.parts
        span_ns = 0 if self.rates is None else span_ns
        return (
            self.schema.parts(),
            self.theta.parts(self.frames, self.theta_converged),
            (span_ns, *rates, np.empty_like(self.theta.theta), self._which),
            self.change.parts(ahead),
            (*moved, (adam.rate, *adam.betas)),
        )

    def sound(self, table: Array) -> Array:
        """The states of a table that can be learned from."""
        if table.shape[1] != self.layout.size:
            said = f"{self.layout.size} numbers (StateLayout), got {table.shape[1]}"
            raise ModelError(f"a state of this tree has {said}")
        if not count_beyond(table, self._cap):
            return table
        sound = (np.abs(table[:, 1:]) < self._cap[1:]).all(axis=1)  # false for NaN
        self.refused += int(len(table) - sound.sum())
        return table[sound]

    @property
    def frames(self) -> tuple[Array, Array]:
        """(R0, p) that θ is learned with: λ as it was when θ's moments were last rebuilt."""
        return self._R0, self._p

    def predict(self, table: Array) -> Array:
        """Torque (m, rows) of states with the λ, θ, effects and tool in use; nothing is learned.

        Args:
            table: (m, size) states of `StateLayout`; their torque is not looked at.
        """
        blank = table.copy()
        blank[:, self.layout.tau] = 0.0
        return -self.theta.errors(self.frames, blank)

    def posterior(self) -> LearnedPosterior:
        """What is known of θ and the effects by all states so far."""
        rows = np.arange(max(self._held_from, self._held_to - 5000), self._held_to)  # newest
        held, memory = self._held[rows % len(self._held)], None
        if len(held) > 1:
            apart_s = 1e-9 * float(np.median(np.diff(stamps_of(held))))
            memory = memory_s(self.theta.errors(self.frames, held)[:, -self.tree.n :], apart_s)
        # what is counted as a sample: a state, or (in moments from elsewhere) an independent one
        period_s = self._filtered.state_s * self._filtered.noise_gain / self.theta.noise_gain
        return learned_posterior(self.theta, self.documented, period_s, memory)

    def without_known(self, table: Array) -> Array:
        """Filtered states (m, size), which follow those before, without known effects."""
        return table if self.known is None or not len(table) else self.known.take_off(table)

    def learn_schema(self, table: Array, updates: int = 1) -> None:
        """λ's half of `step_table` on states that `without_known` has seen, if any."""
        if len(table):
            self.schema.absorb(table)
        for _ in range(updates):
            self._schema_gradient()
            self._adam_step(theta_too=False)
        self.learned += len(table)
        if updates:
            self._trace_schema(table)

    def learn_theta(self, table: Array, updates: int = 1) -> None:
        """θ's half of `step_table`, λ standing still; on states as in `learn_schema`."""
        ready = not self.change.waiting
        if len(table):
            ready = self._take_torque(table)
            self._judge_theta()
        if not ready or not updates:
            return
        self.schema.gradient[:] = 0.0
        self.adam.forget(slice(0, 6 * self.tree.n))  # λ's momentum would move it on
        self._states_per_update = max(len(table) / updates, 1.0)
        for _ in range(updates):
            if self.theta.compute_gradient():
                self.adam.step()
                self.theta.after_step(self.theta_converged, self._states_per_update)

    def take_every(self, states: int, triples: Array | None = None) -> None:
        """Let each state that comes from here on stand for so many, the others being left out.

        Args:
            triples: (t, 3, w) of neighbours among all states, see `TorqueRates.take_every`.
        """
        self.schema.weight = self.theta.weight = float(states)
        self.change.each = states
        if self.rates is not None:
            self.rates.take_every(states, triples)

    def follow_convergence(self) -> None:
        """Let ADAM go on at the rate that the settings have before or after θ has converged."""
        if self.settings.mode == Mode.MOMENTS:
            s = self.settings.theta
            self.adam.rate = s.settled_rate if self.theta_converged else s.rate

    def _schema_gradient(self) -> None:
        """λ's gradient; what ADAM remembers of a joint that has jumped is of no use."""
        self.schema.compute_gradient()
        while self.schema.started_anew:
            j = self.schema.started_anew.pop()
            self.adam.forget(slice(6 * j, 6 * j + 6))

    def _adam_step(self, theta_too: bool) -> None:
        """One ADAM step on the gradients as they stand; θ's counts only if asked for."""
        if not theta_too:
            self.theta.gradient[:] = 0.0
        self.adam.step()
        self.schema.apply_step(self.adam.rate)
        if theta_too:
            self.theta.after_step(self.theta_converged, self._states_per_update)

    def _trace_schema(self, table: Array) -> None:
        if self.schema_trace.due(len(table)):
            s = self.schema
            self.schema_trace.keep(
                stamp_of(table[-1]), s.R0, s.p, s.ranks.astype(float), float(s.converged)
            )

    def _theta_is_due(self, table: Array) -> bool:
        """Whether θ is being learned; sees to it that its moments follow λ."""
        if self.theta_started_ns is None:
            if self.settings.wait_for_schema and not self.schema.converged:
                self._hold(table)
                return False
            self.start_theta(stamp_of(table[0]))
        elif self.schema.looked:
            if self._strayed():
                self._begin_rebuild()
            self._judge_theta()
        return True

    def start_theta(self, stamp_ns: int) -> None:
        """Begin to learn θ, with the frames as they are now; states held so far count too."""
        self.theta_started_ns = stamp_ns
        if self._held_to > self._held_from:
            self._begin_rebuild()
        else:
            self._R0[:], self._p[:] = self.schema.R0, self.schema.p

    def _take_torque(self, table: Array) -> bool:
        """Add states to θ's moments; whether θ may be stepped on."""
        if self.rates is not None:
            # until θ has seen enough they count as zero, and nothing has to wait for them
            self._rates_known = self._rates_known or self.theta.count >= 1500  # samples
            if self._rates_known:
                table = self.rates.follow(table, self.frames, self.theta.theta, self.base)
        self._torque_states = table
        if not len(table):
            return not self.change.waiting
        if self.change.waiting:
            self._look_on(table, self.theta.errors(self.frames, table))
            return False
        error = self.theta.absorb(self.frames, table)
        self._hold(table)
        if self._shadow is not None:
            self._rebuild_some(len(table))
        self._look_on(table, error)
        theta, before = self.theta, self.theta.count - self.theta.weight * len(table)
        if theta.spare_in_use and any(before < k <= theta.count for k in theta.settings.restarts):
            theta.restart_spare()
            self.adam.forget(slice(6 * self.tree.n, None))  # momentum is of no use after a jump
        return True

    def _judge_theta(self) -> None:
        """θ has converged when it predicts the last seconds as well as it fits all samples."""
        before, now = self._judged, self.theta.updates
        if self.change.waiting or now - before < JUDGE_THETA_EVERY:
            return
        self._judged = now
        if now // ADAPT_EVERY > before // ADAPT_EVERY and self.theta.count >= ADAPT_EVERY:
            self.theta.adapt_prior(None if self.rates is None else self.rates.noise)
        excess = float(np.mean(self.change.level / self.theta.variance()))
        limit = CONVERGED_EXCESS if not self.theta_converged else 2.0 * CONVERGED_EXCESS
        self.theta_converged = self.change.samples >= self.change.settings.slow and excess < limit

    def _look_on(self, table: Array, error: Array) -> None:
        """Keep the scores, and notice a change."""
        self._keep_scores(table, error)
        if self.theta_trace.due(len(table)):
            self.theta_trace.keep(stamp_of(table[-1]), self.theta.th)
        alarmed_before = self.change.waiting
        own = error[:, self.tree.rows - self.tree.n :]
        if alarmed_before:
            self._doubted.append((table[:, self.layout.before_links].copy(), own.copy()))
        if self.change.look(own, self._a_load_explains):
            self._start_change(self._alarm_ns)
        elif self.change.waiting and not alarmed_before:
            self._alarm_ns = stamp_of(table[-1])
            self._doubted.clear()

    def _keep_scores(self, table: Array, error: Array) -> None:
        for k in self.score_trace.due(len(table)):
            state, at = table[k], self.layout
            parts = state[at.q.start : at.ddq.stop], state[at.joint_tau], error[k, -self.tree.n :]
            self.score_trace.keep(stamp_of(state), *parts, state[at.base], state[at.memory])

    def _a_load_explains(self) -> bool:
        """Whether the newest errors are what a body at the hand makes, and not friction's, say.

        A slow joint holds what its static friction lets it, which no model foretells.
        """
        if self.tree.floating:
            return True
        tables, errors = zip(*self._doubted, strict=True)
        newest = slice(-max(self.change.settings.fast // self.change.each, 1), None)
        table, error = np.concatenate(tables)[newest], np.concatenate(errors)[newest]
        at, (m, n) = self.layout, error.shape
        motion = JointMotion(*(np.ascontiguousarray(table[:, x]) for x in (at.q, at.dq, at.ddq)))
        Y = np.zeros((m, n, 10 * n))
        regressors(placed(self.tree, *self.frames), motion, self.base[None], Y)
        size = np.hypot(np.sqrt(self.change.level), self.theta.static_friction(motion.dq))
        power, seen = np.square(error / size), self.rates_seen
        new = is_new(table[:, at.dq.start : at.ddq.stop], seen)
        if len(seen) and power[new].sum() > 0.5 * power.sum():  # they are of what is new
            return False
        begin = self.theta.hand.start
        load = Y[:, :, begin : begin + 4] / size[:, :, None]  # mass and its moments
        # Of an error's power a body at the hand explains so much (0.997 where 0.3 kg were taken up
        # in motion, 0.88 at most where friction turned around).
        return explained_share(load, error / size) > 0.95

    @property
    def rates_seen(self) -> Array:
        """(k, 2 n) velocities and accelerations of the states still held, rad/s and rad/s²."""
        rows = np.arange(self._held_from, self._held_to) % len(self._held)
        return np.asarray(self._held[rows, self.layout.dq.start : self.layout.ddq.stop])

    def _start_change(self, stamp_ns: int) -> None:
        self.changes.append(stamp_ns)
        self.theta.start_change()
        self._held_from = self._held_to
        self._shadow = None
        self.theta_converged = False
        self.adam.forget(slice(6 * self.tree.n, None))

    def _hold(self, table: Array) -> None:
        rows = table[:, self.layout.before_links]
        size, first, count = len(self._held), self._held_to % len(self._held), len(rows)
        if first + count <= size:
            self._held[first : first + count] = rows
        else:
            self._held[np.arange(first, first + count) % size] = rows
        self._held_to += count
        self._held_from = max(self._held_from, self._held_to - size)

    def _strayed(self) -> bool:
        """Whether λ has left the frames of θ's moments by more than it is sure of."""
        std = np.sqrt(np.einsum("jaa->ja", self.schema.covariance()))
        allowed = np.maximum(self.settings.rebuild_stds * std, 1e-5)  # rad, m: no sensor shows it
        return self.schema.strayed(*self.frames, allowed)

    def _begin_rebuild(self) -> None:
        self._R0[:], self._p[:] = self.schema.R0, self.schema.p
        self._shadow = self.theta.empty_moments()
        self._shadow_at = self._held_from

    def _rebuild_some(self, states: int) -> None:
        """Redo some of the states still held with the present λ; swap when all are done."""
        assert self._shadow is not None
        start = max(self._shadow_at, self._held_from)
        stop = min(start + self.settings.rebuild_rows * states, self._held_to)
        rows = self._held[np.arange(start, stop) % len(self._held)]
        self.theta.absorb_again(self.frames, rows, self._shadow)
        self._shadow_at = stop
        if stop == self._held_to:
            self.theta.replace_moments(self._shadow, float(stop - self._held_from))
            self._shadow = None
            self.rebuilds += 1


def _taken_off(
    known: KnownArm, learned: Sequence[str], smoothing_s: float, floating: bool
) -> KnownEffects | None:
    """What takes the known effects off that nobody learns; None where there are none."""
    fixed = [active for active in known.effects if not active.starts(learned)]
    if not fixed:
        return None
    names = ", ".join(dict.fromkeys(active.effect.name for active in fixed))
    if known.arm is None or floating:
        needed = "a base that rests" if floating else "the model's arm beside them"
        raise SettingsError(f"effects of a model ({names}) need {needed}, or have to be learned")
    return KnownEffects(fixed, known.arm, smoothing_s)


@jit
def count_beyond(table, cap):
    """How many numbers of a table of states, stamps apart, are not finite or not below `cap`."""
    count = 0
    for m in range(table.shape[0]):
        for k in range(1, table.shape[1]):
            if not abs(table[m, k]) < cap[k]:  # so that a NaN counts too
                count += 1
    return count
