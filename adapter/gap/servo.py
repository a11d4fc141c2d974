"""The gap between commanded and measured motion of an arm without torque signals.

Which of the servos' numbers are other than documented (an arm whose servos nobody documented is
ideal: where its commands are), and how far the motion of an unseen recording is foretold.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from adapter.gap import servo_kernels as col
from adapter.gap.hand import FACES, hand_frame
from adapter.gap.result import RolloutCurves
from adapter.gap.servo_fit import (
    ALL_FREE,
    BY_GAIN,
    PARAMETERS,
    SHAPE,
    Freedom,
    JointFit,
    JointTask,
    blocks,
    equations,
    first_guess,
    fit_joint,
    guesses,
    misfit,
)
from adapter.gap.servo_ground import LEAST_JOINTS, Tip, find_ground
from adapter.gap.servo_kernels import NO_GROUND, SLIP, Ground, Load
from adapter.gap.servo_model import ServoModel
from adapter.gap.servo_result import DOCUMENTED_SHARE, SURE, Findings, ServoGap, rms
from adapter.gap.servo_signals import Track, loads, over_ground
from adapter.gap.torque_gains import LEARNED_SHARE
from adapter.judgement.priors import theta_prior
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.kernels import place_frames
from adapter.physics.rigid_arm import RigidArm
from adapter.screening.screen import RecordingFault, RecordingRefused, moving_joints
from adapter.screening.timing import unwrapped
from drivers.files.mcap import Log

ROUNDS = 2  # in which the load follows from the arm's simulated motion
LEAST_DELAY_S = 1e-5  # standard deviation of one joint's, at least
DOCUMENTED_DELAY_S = 5e-5  # the same of a delay
TIE_CHI2 = 4.0  # by which an effect must foretell blocks that its fit has not seen better
DRAWS = 8  # of inertias as wrong as the documentation may be
NOISE_SHARE = 3.0  # of the encoders' noise: a tracking error within it is none
SHORTEST_S = 5.0
HAND_ROWS = 500  # of a recording, where the way of the hand is told
ROUGH_STEP_S = 8e-3  # of the first simulations
# what a limit, a dead band or backlash has to tell of blocks not seen, and its share of what was
# left: simulated ones explain nearly all of it, on a real arm a wrong one explained a tenth
LIMITED_CHI2, LIMITED_SHARE = 12.0, 0.25
STATIC_SHARE = 0.03  # of static friction: 0.05 to 0.4 where there is some, 0.005 beside a dead band
# for so long, in so many recordings (one, where the hand's tip is documented): its place is known
TOUCHED_S, LEAST_TOUCHED = 1.0, 2


@dataclass(frozen=True, eq=False)
class _Arm:
    """What every station needs: the documented arm and servos, recordings, inertias drawn.

    Attributes:
        usual: rad/(N m), one over the median of its position gains; 0 where it is not known.
        tips: of the hand, as documented: where nobody can bolt a tool on.
    """

    rigid: RigidArm
    documented: ServoModel
    tracks: tuple[Track, ...]
    inertia_prior: float
    ground: Ground = NO_GROUND
    usual: float = 0.0
    tips: tuple[Tip, ...] = ()

    def fixed(self, j: int) -> Array:
        """(12,) documented parameters of a joint, as `Freedom` takes them."""
        servos = self.documented
        x = servos.table()[j]
        kp = servos.position_gain[j]
        x[col.WITHIN] = x[col.WITHIN] / x[col.DAMPING] if x[col.DAMPING] > 0.0 else 0.0
        if np.isfinite(kp):
            x[BY_GAIN] *= kp
            x[col.TIGHT] /= kp
        return x

    def plain(self, j: int) -> Freedom:
        """Of a joint of which every number is free but limits, dead band and backlash."""
        others = np.arange(PARAMETERS) > col.DELAY
        return Freedom(ALL_FREE.free, np.where(others, self.fixed(j), 0.0))

    def tasks(self, motions: Sequence[Array]) -> list[JointTask]:
        """One for each joint, all judged readings, under the loads of these motions."""
        each = [loads(self.rigid, motion, self.ground) for motion in motions]
        rows = [track.judged for track in self.tracks]
        n = self.rigid.n
        return [
            JointTask(j, self.tracks, [own[j] for own in each], rows, self.usual) for j in range(n)
        ]

    def drawn_loads(self, motions: Sequence[Array]) -> list[list[list[Load]]]:
        """Loads by draw, recording and joint of arms whose inertias are as wrong as they may be."""
        rng, found = np.random.default_rng(0), []
        for _ in range(DRAWS):
            off = theta_prior(self.rigid.theta, self.inertia_prior)
            theta = self.rigid.theta + off * rng.standard_normal(off.shape)
            arm = self.rigid.changed(theta=theta)
            found.append([loads(arm, motion, self.ground) for motion in motions])
        return found


def explain(
    logs: Sequence[Log],
    model: SelfModel,
    documented: ServoModel | None = None,
    hold_out: Sequence[Log] = (),
    inertia_prior: float = 0.02,
    progress: Callable[[str], None] = lambda text: None,
) -> ServoGap:
    """Fit the servos of an arm of documented inertias, and name what is not as documented.

    Args:
        logs: of one arm, fitted; hold_out: of the same, foretold.
        documented: the servos; ideal ones where None.
        inertia_prior: by which share the model's inertias may be off, one standard deviation.

    Raises:
        RecordingRefused: too short, or nothing moves. DriverError: it lacks a joint.
    """
    names = model.tree.joint_names
    logs, hold_out = ([going_on(log, model) for log in x] for x in (logs, hold_out))
    documented = documented or ServoModel.ideal(names)
    tracks, unseen = (tuple(map(_track, x)) for x in (logs, hold_out))
    links = model.tree.link_names
    tips = tuple(
        (links.index(x.parent), x.position)
        for x in model.frames
        if x.parent in links[-2:] and not x.name.endswith(FACES)
    )
    arm = _Arm(RigidArm.of(model), documented, tracks, inertia_prior, documented.ground, tips=tips)
    progress("fitting each joint's servo")
    # of an encoder's reading, by its third differences
    noise = np.max(
        [np.std(np.diff(x.q, 3, axis=0), axis=0) / np.sqrt(20.0) for x in tracks], axis=0
    )
    error = np.max([documented.tracking_error(track, arm.rigid) for track in tracks], axis=0)
    if np.all(error < NOISE_SHARE * noise):
        fits: list[JointFit] = []
        servos = documented
    else:
        arm, fits = _rough(arm, logs, noise)
        fits = _named(arm, fits, progress)
        servos = _servos(arm, fits)
    down = [over_ground(arm.rigid, arm.ground, track.smooth[0])[1] < 0.0 for track in tracks]
    touched = tuple(float(x.sum() * t.step_s) for x, t in zip(down, tracks, strict=True))
    ground = NO_GROUND if arm.ground is documented.ground else arm.ground
    least = LEAST_TOUCHED if not tips else 1
    if ground.root > 0.0 and sum(x > TOUCHED_S for x in touched) < least:
        servos = replace(servos, ground=NO_GROUND)  # one motion does not tell it in other poses
    progress("foretelling what was held out")
    curves, scored = _scored(arm, fits, servos, unseen)
    hand = hand_frame(model)
    if hand.parent == hand.name:  # nothing rides on the last link, which may be a jaw
        hand = next((x for x in model.frames[::-1] if x.parent in model.tree.link_names), hand)
    place = arm.rigid, model.tree.link_names.index(hand.parent), hand.position
    found = Findings(documented, model.tree.slides)
    for j, fit in enumerate(fits):
        found.add_joint(j, fit)
    for j, fit in enumerate(fits):
        if fit.x[col.DELAY] != documented.delay_s:
            found.add("servo_delay", j, fit.x[col.DELAY], fit.delay_std, documented.delay_s)
    return ServoGap(
        joint_names=names,
        model_name=model.name,
        recordings=tuple(log.path.name for log in (*logs, *hold_out)),
        findings=found.findings(),
        servos=servos,
        curves=curves,
        scored=scored,
        hand=hand.name,
        hand_before=_hand_off(*place, [(x.measured, x.before) for _, x in curves]),
        hand_after=_hand_off(*place, [(x.measured, x.after) for _, x in curves]),
        scale_open=tuple(found.scale_open),
        ground=ground,
        touched=touched,
        notes=(*(w for log in logs for w in log.warnings), *found.notes),
        slides=tuple(model.tree.slides) if any(model.tree.slides) else (),
    )


def going_on(log: Log, model: SelfModel) -> Log:
    """A recording of the model's joints alone, those told within one turn going on beyond it."""
    log, own = log.select(model.tree.joint_names), model.limits
    q, _ = unwrapped(log.q, own.lower, own.upper)
    if log.commands is None or log.commands.q is None or not len(log.commands.q):
        return replace(log, q=q)
    goal, _ = unwrapped(log.commands.q, own.lower, own.upper)
    apart = np.nanmedian(goal, axis=0) - np.nanmedian(q, axis=0)
    turns = np.where(model.tree.slides, 0.0, np.round(apart / (2.0 * np.pi)))
    return replace(log, q=q, commands=replace(log.commands, q=goal - 2.0 * np.pi * turns))


def _track(log: Log) -> Track:
    span = 1e-9 * float(np.ptp(log.stamp_ns)) if len(log.stamp_ns) else 0.0
    orders = 0 if log.commands is None else len(log.commands.stamp_ns)
    if span < SHORTEST_S or orders < 2:
        raise RecordingRefused(
            RecordingFault.DATA,
            f"{log.path}: {span:.2g} s with {orders} commands; record at least "
            f"{SHORTEST_S:g} s of motion, better 20 s, with its position commands.",
        )
    track = Track.of(log)
    if not moving_joints(track.smooth[0], track.smooth[1], track.step_s):
        raise RecordingRefused(
            RecordingFault.MOTION,
            f"{log.path}: too little motion to tell anything of the servos; move every joint by "
            "0.3 rad with at least 0.3 rad/s, for some 20 s.",
        )
    return track


def _rough(arm: _Arm, logs: Sequence[Log], noise: Array) -> tuple[_Arm, list[JointFit]]:
    """All numbers of all joints, the load being that of the motion as it was measured.

    First on long steps; what these leave beyond the encoders' noise may be something that the hand
    came down on.
    """
    tracks = tuple(Track.of(log, ROUGH_STEP_S) for log in logs)
    motions = [track.smooth for track in tracks]
    tasks = replace(arm, tracks=tracks).tasks(motions)
    fits = [fit_joint(task, arm.plain(j), first_guess(task)) for j, task in enumerate(tasks)]
    x = np.array([fit.x for fit in fits])
    left = np.sqrt([fit.error() / sum(map(np.sum, fit.task.rows)) for fit in fits])
    unexplained = np.sum(left > NOISE_SHARE * noise) >= LEAST_JOINTS
    if unexplained and arm.ground.root == 0.0 and np.any(arm.rigid.gravity):
        ground, x = find_ground(arm.rigid, tasks, x, arm.tips)
        arm = replace(arm, ground=ground)
        tasks = replace(arm, tracks=tracks).tasks(motions)
    if arm.documented.is_ideal:
        arm = replace(arm, usual=float(np.median(x[:, col.A])))
    fits = [
        _limited(JointFit(replace(task, usual=arm.usual), fit.freedom, own), noise[j])
        for j, (task, fit, own) in enumerate(zip(tasks, fits, x, strict=True))
    ]
    tasks = arm.tasks([track.smooth for track in arm.tracks])
    return arm, [fit_joint(task, fit.freedom, fit.x) for task, fit in zip(tasks, fits, strict=True)]


def _limited(fit: JointFit, noise: float) -> JointFit:
    """A joint's fit with what else a servo has where it pays.

    Static friction, a torque limit, a dead band, backlash.

    Args:
        noise: of the encoder, rad.
    """
    equation = equations(fit.task)
    while np.sqrt(fit.error() / sum(map(np.sum, fit.task.rows))) > NOISE_SHARE * noise:
        fits = []
        limited = [(col.TIGHT, share) for share in (0.0, 1.0)]
        for k, within in [(col.STICKS, None), *limited, (col.DEAD, None), (col.PLAY, None)]:
            if fit.freedom.free[k] or (within == 1.0 and fit.x[col.LEAD] > 0.0):
                continue
            freedom = fit.freedom.beside(k, within)
            starts = (freedom.full(x[freedom.free]) for x in guesses(equation, fit.x, k))
            start = min(starts, key=lambda x: misfit(fit.task.fitted(x)))
            fits.append((fit_joint(fit.task, freedom, start), k))
        fits.sort(key=lambda x: x[0].error())
        best = next((own for own, k in fits if _explains(own, fit, k)), None)
        if best is None:
            break
        fit = _needed(best, fit.freedom.free)  # what stood in for what is there now goes
    return fit


def _needed(fit: JointFit, asked: NDArray[np.bool_]) -> JointFit:
    """A fit without those extras asked for, (12,), that explain too little beside the rest."""
    for k in range(col.STICKS, col.SLIPS):
        if asked[k] and fit.freedom.free[k]:
            without = fit_joint(fit.task, fit.freedom.without(k), fit.x)
            fit = fit if _explains(fit, without, k) else without
    return fit


def _explains(fit: JointFit, without: JointFit, k: int) -> bool:
    """Whether parameter k, which a fit has and another has not, explains enough of what is left."""
    share = STATIC_SHARE if k == col.STICKS else LIMITED_SHARE
    least = max(LIMITED_CHI2 * fit.unit, share * without.error())
    return without.error() - fit.error() > least and _paid(fit, without) > LIMITED_CHI2


def _motions(arm: _Arm, fits: Sequence[JointFit]) -> list[Array]:
    """The motion by the fitted servos on each recording, free of the encoders' noise."""
    servos = _servos(arm, fits)
    return [track.simulated(servos.follow(track, arm.rigid)) for track in arm.tracks]


def _named(arm: _Arm, fits: list[JointFit], progress: Callable[[str], None]) -> list[JointFit]:
    """Fits in which nothing is free but what is not as documented."""
    for _ in range(ROUNDS):
        tasks = arm.tasks(_motions(arm, fits))
        fits = [fit_joint(t, f.freedom, f.x) for t, f in zip(tasks, fits, strict=True)]
    # what one explained on long steps, and under noisy loads, may be explained by now
    fits = _with_lead(arm, [_needed(fit, fit.freedom.free) for fit in fits])
    drawn = arm.drawn_loads(_motions(arm, fits))
    fits = _with_one_delay(arm, fits, drawn)
    tasks = arm.tasks(_motions(arm, fits))
    fits = [
        replace(fit_joint(t, f.freedom, f.x), delay_std=f.delay_std)
        for t, f in zip(tasks, fits, strict=True)
    ]
    progress("weighing what is not as documented")
    return [_weighed(arm, fit, drawn) for fit in fits]


def _with_lead(arm: _Arm, fits: Sequence[JointFit]) -> list[JointFit]:
    """Whether the servos know the command's speed is one question for the whole arm."""
    told = bool(arm.documented.feeds_speed.any())
    start = [np.where(np.arange(PARAMETERS) == col.LEAD, 0.0, fit.x) for fit in fits]
    without = []
    for fit, x in zip(fits, start, strict=True):
        x[col.DAMPING] = max(fit.x[col.DAMPING] - fit.x[col.LEAD], 0.0)
        without.append(fit_joint(fit.task, fit.freedom.without(col.LEAD), x))
    # more than half of the joints that move decide it: a few may have servos of another kind
    moves = {j for t in arm.tracks for j in moving_joints(t.smooth[0], t.smooth[1], t.step_s)}
    pays = np.array([_paid(fits[j], without[j]) for j in moves])
    found = np.sort(pays)[(len(pays) - 1) // 2] > 2.0 * TIE_CHI2
    return list(fits) if told or found else without


def _with_one_delay(
    arm: _Arm, fits: Sequence[JointFit], drawn: Sequence[Sequence[Sequence[Load]]]
) -> list[JointFit]:
    """One bus brings all commands: the delay that all joints together show, or the documented.

    Inertias that are off move it in all joints at once.
    """
    delays = np.array([fit.x[col.DELAY] for fit in fits])
    noise, moved = [], []
    for fit in fits:
        at, j = int(fit.freedom.free[: col.DELAY].sum()), fit.task.joint
        noise.append(fit.scale[at] ** 2 * fit.noise_covariance[at, at])
        moved.append(fit.scale[at] * fit.under([[own[j] for own in each] for each in drawn])[:, at])
    together = np.diag(np.maximum(noise, LEAST_DELAY_S**2)) + np.cov(moved, bias=True)
    weight = np.linalg.solve(together, np.ones(len(fits)))
    delay = float(weight @ delays / weight.sum())
    left = delays - delay
    spread = float(left @ np.linalg.solve(together, left)) / max(len(fits) - 1, 1)
    std = float(np.sqrt(max(spread, 1.0) / weight.sum()))
    told = not arm.documented.is_ideal  # else nobody said that there is none
    if told and abs(delay - arm.documented.delay_s) < SURE * np.hypot(std, DOCUMENTED_DELAY_S):
        delay, std = arm.documented.delay_s, 0.0
    found = []
    for fit in fits:
        documented = fit.freedom.documented.copy()
        documented[col.DELAY] = delay
        freedom = replace(fit.freedom, documented=documented).without(col.DELAY)
        found.append(replace(fit_joint(fit.task, freedom, fit.x), delay_std=std))
    return found


def _paid(fit: JointFit, without: JointFit) -> float:
    """By how much a fit foretells blocks it has not seen better than another, in chi squared."""
    gain = 0.0
    for part in (0, 1):
        seen, unseen = blocks(fit.task, part), blocks(fit.task, 1 - part)
        errors = [
            JointFit(unseen, f.freedom, fit_joint(seen, f.freedom, f.x).x).error()
            for f in (without, fit)
        ]
        gain += errors[0] - errors[1]
    return gain / fit.unit


def _weighed(arm: _Arm, fit: JointFit, drawn: Sequence[Sequence[Sequence[Load]]]) -> JointFit:
    """One joint's fit without what is as documented, the surest to be so first.

    Where nobody documented the servo, all stays that foretells what the fit has not seen.
    """
    j, fixed = fit.task.joint, arm.fixed(fit.task.joint)
    others = [[own[j] for own in each] for each in drawn]
    fixed[col.DELAY], fixed[col.WITHIN] = fit.x[col.DELAY], fit.freedom.documented[col.WITHIN]
    known = np.isfinite(arm.documented.position_gain[j])
    if not fit.freedom.free[col.LEAD] and not arm.documented.feeds_speed[j]:
        fixed[col.LEAD] = 0.0
    while True:
        values, covariance = physical(fit, others)
        doubt = np.sqrt(np.diagonal(covariance))
        goal = fixed[: col.WITHIN].copy()
        goal[col.A] = 1.0 / goal[col.A] if known else np.nan
        with np.errstate(invalid="ignore", divide="ignore"):
            far = np.abs(values - goal) / np.hypot(doubt, DOCUMENTED_SHARE * goal)
        far[~fit.freedom.free[: col.WITHIN]] = np.inf
        if not known:
            far[col.A] = np.inf
        k = int(np.nanargmin(far))
        freedom = Freedom(fit.freedom.free, fixed).without(k)
        without = fit_joint(fit.task, freedom, freedom.full(fit.x[freedom.free]))
        apart = not known or far[k] > SURE
        if not np.isfinite(far[k]) or (apart and _paid(fit, without) > TIE_CHI2):
            return replace(fit, values=values, doubt=covariance)
        fit = replace(without, delay_std=fit.delay_std)


def physical(fit: JointFit, others: Sequence[Sequence[Load]] = ()) -> tuple[Array, Array]:
    """A servo's numbers (11,), SI, and their covariance (11, 11), as the table's columns.

    kp, gain of the command's speed, damping, armature, Coulomb, delay (no doubt of it), stiction,
    one over the torque's limit, dead band, half the backlash, speed at which stiction is gone.

    Args:
        others: loads of arms whose inertias are as wrong as they may be.
    """
    x, a = fit.x, fit.x[col.A]
    covariance = np.zeros((PARAMETERS, PARAMETERS))
    free = np.flatnonzero(fit.freedom.free)
    if free.size:
        late = fit.x + fit.delay_std * (np.arange(PARAMETERS) == col.DELAY)
        moved = fit.moved([fit.task.fitted(late)])  # the others make up for a delay that is off
        own = fit.noise_covariance + moved.T @ moved
        if others:
            moved = fit.under(others)
            own = own + moved.T @ moved / len(moved)
        covariance[np.ix_(free, free)] = own * np.outer(fit.scale, fit.scale)
    # to the power of the gain that each has in the table
    power = BY_GAIN[: col.WITHIN] - 1.0 * (np.arange(col.WITHIN) == col.TIGHT)
    values = x[: col.WITHIN] / a**power
    turn = np.zeros((col.WITHIN, PARAMETERS))
    turn[:, : col.WITHIN] = np.diag(fit.freedom.free[: col.WITHIN] / a**power)
    turn[:, col.A] -= fit.freedom.free[: col.WITHIN] * power * values / a
    values[col.A], turn[col.A] = 1.0 / a, 0.0
    turn[col.A, col.A] = -1.0 / a**2
    doubt, rubs = turn @ covariance @ turn.T, [col.STICKS, col.RUBS]
    doubt[rubs, rubs] += (SHAPE * values[col.STICKS]) ** 2
    return values, doubt


def _servos(arm: _Arm, fits: Sequence[JointFit]) -> ServoModel:
    """The servos that the fits found."""
    x = np.array([fit.x for fit in fits])
    kp = 1.0 / x[:, col.A]
    lead, damping = x[:, col.LEAD], x[:, col.DAMPING]
    fed = lead > 0.0
    documented = arm.documented
    gain = np.where(fed, lead * kp, np.minimum(documented.velocity_gain, damping * kp))
    gain = np.where(~fed & (documented.velocity_gain == 0.0), damping * kp, gain)
    # what acts beside the torque's limit is friction, whoever makes it
    gain = np.where(~fed & (x[:, col.TIGHT] > 0.0), x[:, col.WITHIN] * kp, gain)
    # A lead beyond all damping would be friction that drives: the damping is then all gain.
    return ServoModel(
        documented.joint_names,
        kp,
        gain,
        x[:, col.RUBS] * kp,
        np.maximum(damping * kp - gain, 0.0),
        x[:, col.INERTIA] * kp,
        np.asarray(fed),
        float(np.median(x[:, col.DELAY])),
        arm.ground,
        x[:, col.STICKS] * kp,
        np.divide(kp, x[:, col.TIGHT], out=np.full_like(kp, np.inf), where=x[:, col.TIGHT] > 0.0),
        x[:, col.DEAD],
        2.0 * x[:, col.PLAY],
        np.where(x[:, col.STICKS] > 0.0, x[:, col.SLIPS], SLIP),
    )


def _scored(
    arm: _Arm, fits: Sequence[JointFit], servos: ServoModel, unseen: Sequence[Track]
) -> tuple[tuple[tuple[str, RolloutCurves], ...], str]:
    """Motions that the fit has not seen, by name, measured and foretold; and what they are."""
    tracks, told = unseen, f"{len(unseen)} recordings held out"
    if len(unseen) == 1:
        told = "held out recording"
    if not unseen:
        tracks, told, fitted = arm.tracks, "last third, servos fitted before it", []
        for fit in fits:
            pairs = zip(fit.task.tracks, fit.task.rows, strict=True)
            rows = [take & (t.stamp_s < LEARNED_SHARE * t.stamp_s[-1]) for t, take in pairs]
            fitted.append(fit_joint(replace(fit.task, rows=rows), fit.freedom, fit.x))
        servos = _servos(arm, fitted) if fitted else servos
    found = []
    for t in tracks:
        take = t.judged if unseen else t.stamp_s >= LEARNED_SHARE * t.stamp_s[-1]
        ways = (t.q - t.left(s.follow(t, arm.rigid)) for s in (arm.documented, servos))
        found.append((t.name, RolloutCurves(*(x[take] for x in (t.stamp_s, t.q, *ways)))))
    return tuple(found), told


def _hand_off(
    arm: RigidArm, link: int, point: Array, pairs: Sequence[tuple[Array, Array]]
) -> Array:
    """(n + 1,) m, rms way of a point between two motions (m, n): by each joint alone, by all."""
    R, o, left = np.empty((arm.n, 3, 3)), np.empty((arm.n, 3)), []

    def at(q: Array) -> Array:
        place_frames(arm.frames, q, R, o)
        return np.asarray(o[link] + R[link] @ point)

    for one, other in pairs:
        ways = []
        for k in range(0, len(one), max(len(one) // HAND_ROWS, 1)):
            moved = np.tile(one[k], (arm.n + 1, 1))
            np.fill_diagonal(moved, other[k])
            moved[-1] = other[k]
            here = at(one[k])
            ways.append([np.linalg.norm(at(q) - here) for q in moved])
        left.append(np.array(ways))
    return rms(left)
