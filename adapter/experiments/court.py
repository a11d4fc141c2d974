"""`adapter bench --log`: ways to learn an arm side by side, on one recording, each told the same.

All learn from the same samples, in processes of their own. What they learned is judged by one
recipe on samples that none has seen: the torque that is left, and forward simulation in MuJoCo
under the measured torque, restarted from the measured state again and again.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import pickle
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from adapter import optional
from adapter.effects.robots import read_robot
from adapter.errors import ModelError, SettingsError
from adapter.experiments.rivals import WAYS, Given, Learned, rigid, signals_of, spec_of
from adapter.gap.hand import hand_frame
from adapter.gap.held_out import lasting, rms, torque_errors
from adapter.gap.signals import MEASURED, ROLLOUT_STEP_S, Recorded
from adapter.learning.batch.theta_filling import possible_theta
from adapter.model.inertia import is_consistent
from adapter.model.numbers import plain
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm
from adapter.report.html import fill, write_whole
from adapter.report.style import Drawing, joint_color, legend
from adapter.report.tables import Table
from adapter.runs.replay import from_s, last_s
from adapter.runs.terminal import output, print_table, say, show, write_json
from adapter.screening.screen import of_this_robot, refuse
from adapter.screening.timing import lateness
from adapter.signals.matching import present
from adapter.simulate import DrivenMotion, Rollouts
from drivers.errors import choices
from drivers.files.mcap import Log, read_log

OURS = "adapter gap"
HORIZONS_S = (0.1, 0.2, 0.5, 1.0, 2.0)
MOST_STARTS = 40
WORST_RAD = np.pi  # a simulation that runs away is off by no more
UNKNOWN = np.full(len(HORIZONS_S), np.nan)


class Verdict(NamedTuple):
    """What became of one way to learn.

    Attributes:
        way: its name; ran: whether it ended with a model.
        names: what it names; notes: warnings, and why it did not run.
        cpu_s, peak_mb: of its process, imports included.
        torque_nm: (n,) rms of what it leaves of unseen torque.
        off_rad, off_m: (h,) error of a rollout at `HORIZONS_S`, rms over joints and of the hand,
            the median of all restarts: a few run away; NaN where it could not be simulated, or
            nothing lasts so long.
    """

    way: str
    ran: bool = False
    names: Sequence[str] = ()
    notes: Sequence[str] = ()
    cpu_s: float = np.nan
    peak_mb: float = np.nan
    torque_nm: Array = UNKNOWN[:0]
    off_rad: Array = UNKNOWN
    off_m: Array = UNKNOWN


class Case(NamedTuple):
    """What is to be learned, and what it is judged on.

    Attributes:
        model: as documented; learned: the samples to learn from.
        unseen: those to judge on, cut at pauses.
    """

    model: SelfModel
    learned: Log
    unseen: Recorded

    @classmethod
    def of(cls, log: Log, model: SelfModel, until_s: float | None, hold_out: Log | None) -> Case:
        """From recordings, screened once for all.

        Args:
            until_s: learned before this second, judged after it; of `hold_out`, where that is
                given, all is judged.

        Raises:
            SettingsError: the second is outside the log. RecordingRefused: another robot.
            ModelError: its base floats. MeansError: no MuJoCo.
        """
        if model.tree.floating:
            raise ModelError(f"{model.name}: its base floats; only arms that stand are compared")
        optional.load("mujoco")
        model, _ = present(model, log.joint_names, log.path.name)
        both = [refuse(of_this_robot(x, model), model) for x in (log, hold_out) if x is not None]
        learned, unseen = (both[k].torque.in_time(both[k].log) for k in (0, -1))
        if hold_out is None:
            end_s = last_s(learned)
            until_s = 2.0 / 3.0 * end_s if until_s is None else until_s
            if not 0.0 < until_s < end_s:
                raise SettingsError(f"validation from {until_s} s is outside 0 to {end_s:.1f} s")
            learned, unseen = from_s(learned, 0.0, until_s), from_s(learned, until_s)
        judged = Recorded.of(unseen, lateness(refuse(unseen, model).timing)).cut()
        return cls(model, learned, judged)

    def verdict(self, way: str, learned: Learned, cpu_s: float, peak_mb: float) -> Verdict:
        """Judge what was learned."""
        simulated, notes = lasting(learned.model), [*learned.notes]
        torque = rms([torque_errors(self.unseen, self.model, [simulated]).after])
        n = simulated.tree.n
        if not is_consistent(simulated.theta):
            q, dq, ddq, _ = (x[::50] for x in signals_of(self.learned))
            Y = RigidArm.of(simulated).regressor(q, dq, ddq).reshape(-1, 10 * n)
            told = RigidArm.of(self.model).theta
            simulated = replace(simulated, theta=possible_theta(simulated.theta, told, Y.T @ Y))
            notes.append("its bodies cannot exist: simulated with the nearest that can, by torque")
        simulate, mujoco = Rollouts("mujoco"), optional.load("mujoco")
        mujoco.set_mju_user_warning(lambda said: None)  # runaways are counted, not logged
        off, hand, away = rollouts(self.unseen, simulated, self.model, simulate)
        mujoco.set_mju_user_warning(None)
        notes += simulate.troubles + [f"{away} rollouts run away"] * (away > 0)
        return Verdict(way, True, learned.names, notes, cpu_s, peak_mb, torque, off, hand)


def rollouts(
    recording: Recorded, model: SelfModel, documented: SelfModel, simulate: Rollouts
) -> tuple[Array, Array, int]:
    """Errors `HORIZONS_S` after a restart, of joints, rad, and of the hand, m (h,); see `Verdict`.

    And how many ran away.
    """
    at, every = np.rint(np.array(HORIZONS_S) / ROLLOUT_STEP_S).astype(int), 500  # half a second
    length = int(at[-1])
    lanes, off = length // every + 1, list[Array]()  # rollouts overlap: those of a lane do not
    for part in recording.stretches():
        t = part.grid()
        starts = np.arange(0, max(len(t) - at[0], 1), every)
        starts = starts[:: -(-len(starts) // MOST_STARTS)]
        q, dq, _ = part.smoothed().at(t)
        u = np.column_stack([np.interp(t, part.t, column) for column in part.tau.T])
        for lane in (starts[k::lanes] for k in range(lanes)):
            segments = [(a, min(a + length + 1, len(t))) for a in lane]
            found, _ = simulate(model, DrivenMotion(t, q, dq, u), segments, MEASURED)
            for begin in lane:
                rows = begin + at[begin + at < len(t)]
                wrong = np.nan_to_num(found[rows] - q[rows], nan=WORST_RAD)
                wrong = np.clip(wrong, -WORST_RAD, WORST_RAD)
                reached = hand_at(documented, q[rows] + wrong) - hand_at(documented, q[rows])
                error = np.full((len(at), q.shape[1] + 1), np.nan)
                error[: len(rows)] = np.c_[wrong, np.linalg.norm(reached, axis=1)]
                off.append(error)
    errors = np.array(off) if not simulate.troubles else np.full((1, len(at), 2), np.nan)
    away = int((np.abs(errors[:, :, :-1]) >= WORST_RAD).any(axis=(1, 2)).sum())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of horizons that nothing reaches
        joints, hand = np.sqrt(np.mean(errors[:, :, :-1] ** 2, axis=2)), errors[:, :, -1]
        return np.nanmedian(joints, axis=0), np.nanmedian(hand, axis=0), away


def hand_at(model: SelfModel, q: Array) -> Array:
    """(m, 3) m, where the hand is at q (m, n), in base axes."""
    mujoco, compiled = optional.load("mujoco"), spec_of(rigid(model)).compile()
    data, frame = mujoco.MjData(compiled), hand_frame(model)
    body = compiled.joint(model.tree.joint_names[-1]).bodyid[0]
    out = np.empty((len(q), 3))
    for k, row in enumerate(q):
        data.qpos[:] = row
        mujoco.mj_kinematics(compiled, data)
        out[k] = data.xpos[body] + data.xmat[body].reshape(3, 3) @ frame.position
    return out


def heard(
    case: Case, ways: Sequence[str], limit_s: float, rounds: int, tell: Callable[[str], None]
) -> list[Verdict]:
    """One verdict a way, in their order.

    Args:
        limit_s: for each, on the clock; rounds: how long those that iterate do.
        tell: hears what is being done.
    """
    for way in ways:
        if way not in WAYS:
            raise SettingsError(f"no way to learn '{way}'; {choices(way, WAYS)}")
    verdicts: list[Verdict] = []
    findings: Sequence[Mapping[str, Any]] = ()
    for way in ways:
        tell(way)
        given = Given(case.learned, case.model, rounds, findings)
        found = in_a_process(way, given, limit_s)
        if isinstance(found, str):
            verdicts.append(Verdict(way, notes=[found]))
            continue
        findings = found[0].findings if way == OURS else findings
        try:
            verdicts.append(case.verdict(way, found[0], **found[1]))
        except (ModelError, ValueError, np.linalg.LinAlgError) as error:
            verdicts.append(Verdict(way, notes=[f"what it learned cannot be judged: {error}"]))
    return verdicts


def in_a_process(way: str, given: Given, limit_s: float) -> tuple[Learned, dict[str, float]] | str:
    """What a way learned, with its processor time, s, and most memory, MB; or why nothing."""
    module = WAYS[way].module
    if module is not None and importlib.util.find_spec(module) is None:
        return "not installed: pip install 'panda-adapter[peers]'"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "asked"
        path.write_bytes(pickle.dumps((way, given)))
        child = "import sys, adapter.experiments.rivals as ways; ways.main(sys.argv[1])"
        command = [sys.executable, "-c", child, os.fspath(path)]
        env = {**os.environ, "OMP_NUM_THREADS": "1"}
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=limit_s, env=env)
        except subprocess.TimeoutExpired:
            return f"not done after {limit_s:g} s (--limit)"
        if done.returncode:
            last = (done.stderr.strip().splitlines() or [f"code {done.returncode}"])[-1]
            return f"ended by itself: {last}"
        found: tuple[Learned, dict[str, float]] = pickle.loads(path.read_bytes())
    return found


# --- words, tables, page -------------------------------------------------------------------------


def first(verdicts: Sequence[Verdict]) -> str:
    """Which way is first in what."""
    ran = [v for v in verdicts if v.ran]
    if not any(v.way == OURS for v in ran) or len(ran) < 2:
        return "there is nothing to compare"
    said = []
    for what, key, heads in (
        ("Least unseen torque, by joint", "torque_nm", range(1, len(ran[0].torque_nm) + 1)),
        ("Joints nearest in rollouts, by s", "off_rad", HORIZONS_S),
        ("The hand nearest in them, by s", "off_m", HORIZONS_S),
    ):
        table = np.array([getattr(v, key) for v in ran])
        told = np.flatnonzero(np.isfinite(table).any(axis=0))
        where: dict[str, list[str]] = {}
        for k, best in zip(told, np.nanargmin(table[:, told], axis=0), strict=True):
            where.setdefault(ran[best].way, []).append(f"{heads[k]:g}")
        said.append(f"{what}: " + "; ".join(f"{x} {', '.join(at)}" for x, at in where.items()))
    return ". ".join(said)


def tables(verdicts: Sequence[Verdict]) -> list[Table]:
    """Torque by joint; rollouts by horizon; what each costs; what each says."""
    ran = [v for v in verdicts if v.ran]
    torque = [[v.way, *(f"{x:.3f}" for x in v.torque_nm)] for v in ran]
    pairs = ((v, zip(1e3 * v.off_rad, 1e3 * v.off_m, strict=True)) for v in ran)
    rolled = [[v.way, *("; ".join(map(plain, x)) for x in both)] for v, both in pairs]
    heads = [f"{s:g} s" for s in HORIZONS_S]
    joints = [f"joint {j + 1}" for j in range(max((len(v.torque_nm) for v in ran), default=0))]
    cost = [[v.way, f"{v.cpu_s:.1f}", f"{v.peak_mb:.0f}"] for v in ran]
    said = [[v.way, "; ".join(filter(None, [", ".join(v.names), *v.notes]))] for v in verdicts]
    return [
        Table(["Unseen torque left, N m rms", *joints], torque),
        Table(["Rollouts off, mrad; hand, mm", *heads], rolled),
        Table(["Cost", "processor, s", "memory, MB"], cost),
        Table(["Way", "what it names, and says"], said),
    ]


def compare(args: argparse.Namespace) -> int:
    """Carry out `adapter bench --log`; returns the exit code."""
    unseen = None if args.hold_out is None else read_log(args.hold_out)
    case = Case.of(read_log(args.log), read_robot(args.robot), args.validate_from, unseen)
    verdicts = heard(case, args.only or list(WAYS), args.limit, args.rounds, say)
    shown, said = tables(verdicts), first(verdicts)
    for table in shown:
        print_table(table.heads, table.rows)
        output.print()
    show(said)
    write_json(args.json, {"ways": [v._asdict() for v in verdicts], "said": said})
    if args.out is None:
        return 0
    drawing = Drawing("half", stretch=1.4)
    ax = drawing.axes[0]
    for k, verdict in enumerate(v for v in verdicts if np.isfinite(v.off_rad).any()):
        ax.plot(HORIZONS_S, 1e3 * verdict.off_rad, color=joint_color(k), label=verdict.way)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel("s after the restart")
    legend(ax, ncols=1, fontsize=6, loc="upper left")
    note = "rms over joints, median of the restarts"
    context = {
        "about": f"{case.learned.path.name}, judged on {case.unseen.name}",
        "headline": said,
        "tables": shown,
        "panels": [drawing.panel("Forward simulation", "mrad", note)],
    }
    page = fill("court.html", context, "adapter.experiments")
    show(f"page: {write_whole(args.out / 'court.html', page)}")
    return 0
