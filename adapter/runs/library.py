"""The functions behind `import adapter`: on files or on arrays, with what they return."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from adapter.discovery import Discovery
from adapter.discovery import discover as discover_tree
from adapter.effects.c_text import c_text
from adapter.effects.catalogue import REAL_ARM_EFFECTS
from adapter.effects.kept import keep
from adapter.effects.robots import RobotText, read_robot, robot_mjcf, robot_text, robot_urdf
from adapter.effects.torque import ModelTorque
from adapter.errors import ModelError, ModelWarning, SettingsError
from adapter.gap.result import GapResult
from adapter.gap.workflow import GapSettings
from adapter.gap.workflow import find_gap as gap_of
from adapter.learning.known_effects import learnable
from adapter.learning.settings import LearnerSettings
from adapter.model.model_file import save_model
from adapter.model.numbers import plus_minus
from adapter.model.self_model import SelfModel, effects_html
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm
from adapter.runs.config import PipelineSettings
from adapter.runs.outcome import collect, learned_model
from adapter.runs.pipeline import Pipeline, make_front_end
from adapter.runs.replay import ReplayOptions, fitted_to, from_s, held_out_rms, last_s, replay
from adapter.screening.screen import check_torque
from adapter.signals.importer import read_log as read_any
from adapter.signals.matching import matching, present
from adapter.signals.records import stamps_of
from drivers.files.html_table import html_table
from drivers.files.mcap import Log
from drivers.files.mcap import read_log as read_mcap
from drivers.interface import JointSample, LinkMotion

EXPORTED: dict[str, Callable[..., RobotText]] = {  # by suffix, what writes a model
    ".urdf": robot_urdf,
    ".xml": robot_mjcf,
    ".c": c_text,
    ".sdf": partial(robot_text, "sdf"),
    ".usda": partial(robot_text, "usd"),
    ".py": partial(robot_text, "isaac"),
}


def load_model(
    name: str | Path, joints: Sequence[str] | None = None, lock: Mapping[str, float] | None = None
) -> SelfModel:
    """The model of an arm: S = {N, A, λ, θ} (paper, eq. 1), with limits, effects and gravity.

    Args:
        name: a robot known by name (`panda`), a .urdf or MJCF (.xml) file, or a model file
            (.json) of ours.
        joints: which joints are wanted; all revolute ones where None. The others are locked.
        lock: values of joints to be locked, by name, rad or (a finger's) m.

    Returns:
        The model. `lam` (n, 6) holds each joint frame in its parent's, [α β γ px py pz], rad and
        m; `theta` (n, 10) each link's inertia in its own frame, [m mX mY mZ XX XY XZ YY YZ ZZ],
        kg, kg m, kg m².

    Raises:
        ModelError: no such robot (names the choices), or a file that cannot be read.

    >>> import adapter
    >>> panda = adapter.load_model("panda")
    >>> panda
    SelfModel(panda: 7 joints, λ documentation)
    >>> panda.lam.shape, panda.theta.shape
    ((7, 6), (7, 10))
    """
    return read_robot(name, joints, lock=lock)


def read_log(
    path: str | Path, joint_names: Sequence[str] | None = None, topic: str | None = None
) -> Log:
    """Read a recording (MCAP, rosbag2, ROS 1), whole or cut, or a table whose headers tell it.

    Args:
        path: the file, or a folder of rosbag2.
        topic: of the joint states: `/joint_states`, else the only one that fits, where None.
        joint_names: joints that must be there, in the order wanted; all where None.

    Returns:
        The recording: `stamp_ns` (m,) ns; `q`, `dq`, `tau` (m, n) rad, rad/s, N m; `twists`,
        `accels` (m, n, 6) of the links in their own frames, linear part first, where recorded.

    Raises:
        DriverError: the file cannot be read, or has no joint states; says what it has.

    >>> import adapter
    >>> adapter.read_log("recordings/panda_nominal_6s.mcap")
    Log(panda_nominal_6s.mcap: 6001 samples of 7 joints, 6.0 s)
    """
    return read_mcap(path, joint_names, topic) if joint_names else read_any(path, topic)


def make_log(
    time_s: ArrayLike,
    q: ArrayLike,
    dq: ArrayLike,
    tau: ArrayLike,
    joint_names: Sequence[str] | None = None,
) -> Log:
    """A recording from arrays, for whatever takes one.

    Args:
        time_s: (m,) s, increasing.
        q, dq, tau: (m, n) rad, rad/s and N m (link side, gravity included).
        joint_names: joint1 to jointN where None; `learn` matches names that differ only in what
            stands before their number.

    Raises:
        SettingsError: shapes that do not fit together.

    >>> import adapter, numpy as np
    >>> t = np.arange(0.0, 2.0, 1e-3)
    >>> q = np.sin(t)[:, None] * np.ones(7)
    >>> adapter.make_log(t, q, np.gradient(q, t, axis=0), np.zeros_like(q))
    Log(arrays: 2000 samples of 7 joints, 2.0 s)
    """
    at_s, q, dq, tau = (np.asarray(x, float) for x in (time_s, q, dq, tau))
    m, n = q.shape if q.ndim == 2 else (0, 0)
    if not m or at_s.shape != (m,) or dq.shape != (m, n) or tau.shape != (m, n):
        shapes = ", ".join(str(x.shape) for x in (at_s, q, dq, tau))
        raise SettingsError(f"time_s needs shape (m,), q, dq and tau (m, n); got {shapes}")
    names = tuple(joint_names or (f"joint{k + 1}" for k in range(n)))
    if len(names) != n:
        raise SettingsError(f"{len(names)} joint names for {n} columns")
    return Log(Path("arrays"), names, np.round(1e9 * at_s).astype(np.int64), q, dq, tau)


@dataclass(frozen=True, eq=False)
class LearnResult:
    """What was learned from a recording.

    Attributes:
        model: learned, to be saved, exported, or given to `inverse_dynamics`.
        lam, lam_std: (n, 6) λ, rad and m, and the standard deviations of each frame's turn and
            shift in its parent's axes; NaN where the motion shows nothing.
        theta, theta_std: (n, 10) θ and its standard deviations, SI.
        effects: values (n,) by name of what was learned beside θ (friction, offsets, ...).
        lam_converged: whether λ settled; theta_learned: whether θ could be learned (after λ).
        held_out_rmse_nm: (n,) torque error on the part that was not learned from, N m.
    """

    model: SelfModel
    effects: dict[str, Array]
    lam_converged: bool
    theta_learned: bool
    held_out_rmse_nm: Array
    lam: Array = field(init=False)
    lam_std: Array = field(init=False)
    theta: Array = field(init=False)
    theta_std: Array = field(init=False)

    def __post_init__(self) -> None:
        for name in ("lam", "lam_std", "theta", "theta_std"):
            object.__setattr__(self, name, getattr(self.model, name))

    def __repr__(self) -> str:
        worst = np.max(self.held_out_rmse_nm)
        lam = "converged" if self.lam_converged else "not converged"
        settled = self.model.provenance.get("theta_converged", True)
        theta = "learned" if settled else "not converged" if self.theta_learned else "not learned"
        return f"LearnResult(λ {lam}, θ {theta}, held-out torque error at most {worst:.2g} N m)"

    def _repr_html_(self) -> str:
        """Error and effects of each joint, for notebooks; `model` shows bodies and frames."""
        names = self.model.tree.joint_names
        rows = [(name, plus_minus(self.held_out_rmse_nm[j])) for j, name in enumerate(names)]
        errors = html_table(repr(self), ("joint", "held-out torque error, N m rms"), rows)
        return errors + effects_html(self.model.effects)


def learn(
    log: Log | str | Path,
    model: SelfModel | str | Path = "panda",
    *,
    effects: Sequence[str] | None = None,
    every: int = 1,
    validate_from_s: float | None = None,
) -> LearnResult:
    """Learn λ and θ of a fixed-base arm from a recording, as `adapter replay` does.

    Args:
        log: a file, of any length, or what `read_log` or `make_log` returned.
        model: the documented arm; the learner gets its topology, gravity (or the torques', where
            the base clearly stands askew), tool and limits.
        effects: names learned beside θ, () for none; those of a real arm where None.
        every: samples per update; 1 is what the live process does, up to 50 is faster.
        validate_from_s: learn before this time (s after the first sample), score on the rest;
            the last quarter where None.

    Raises:
        DriverError: the recording lacks a joint of the arm, or samples.
        ValueError: units, sign or order of the torques are not the arm's; says which.
        SettingsError: an effect or a number that does not exist.

    >>> import adapter
    >>> found = adapter.learn("recordings/panda_nominal_6s.mcap", every=10)
    >>> found.lam.shape, found.theta.shape, found.lam_converged
    ((7, 6), (7, 10), True)
    >>> bool((found.held_out_rmse_nm < 0.2).all())
    True
    """
    arm, own = _fitting(model, _log(log))
    end_s = last_s(own) if len(own) else 0.0
    split_s = 0.75 * end_s if validate_from_s is None else validate_from_s
    if not 0.0 < split_s < end_s:
        raise SettingsError(f"validation from {split_s} s is outside 0 to {end_s:.1f} s")
    own, arm, said = check_torque(own, arm)
    for note in said:
        warnings.warn(note, ModelWarning, stacklevel=2)
    filter_settings, _ = fitted_to(own, PipelineSettings().filter)
    names = learnable(arm, REAL_ARM_EFFECTS if effects is None else tuple(effects))
    settings = PipelineSettings(filter=filter_settings, learner=LearnerSettings(effects=names))
    outcome = replay(own, arm, settings, ReplayOptions(every, split_s)).outcome
    learned = learned_model(outcome, arm)
    rmse = held_out_rms(from_s(own, split_s), learned, settings).value
    values = dict(zip(names, outcome.effects.copy(), strict=True))
    started = outcome.theta_started_ns is not None
    return LearnResult(learned, values, outcome.lam_converged, started, rmse)


class Learner:
    """Learns λ and θ of a fixed-base arm sample by sample, each in some 0.1 ms.

    Args:
        model: the documented arm, or its name or file.
        settings: of filter, front end and learner; a real arm's effects are learned where None.

    >>> import adapter
    >>> log = adapter.read_log("recordings/panda_nominal_6s.mcap")
    >>> learner = adapter.Learner("panda")
    >>> for t, q, dq, tau in zip(1e-9 * log.stamp_ns, log.q, log.dq, log.tau):
    ...     learned_from = learner.step(t, q, dq, tau)
    >>> learner
    Learner(panda: 5777 samples learned, λ converged)
    >>> learner.predict(log.q[0], log.dq[0], 0.0 * log.q[0]).shape
    (7,)
    """

    def __init__(
        self, model: SelfModel | str | Path = "panda", settings: PipelineSettings | None = None
    ) -> None:
        self._documented = _model(model)
        if settings is None:
            names = learnable(self._documented, REAL_ARM_EFFECTS)
            settings = PipelineSettings(learner=LearnerSettings(effects=names))
        self._pipeline = Pipeline(self._documented, settings)
        self._told: tuple[int, SelfModel] | None = None  # at how many samples, and what

    def step(
        self,
        time_s: float,
        q: ArrayLike,
        dq: ArrayLike,
        tau: ArrayLike,
        links: tuple[ArrayLike, ArrayLike] | None = None,
    ) -> bool:
        """Take one sample; whether it was learned from (`refused` counts the others).

        Args:
            time_s: of the sample, s, on any clock that increases.
            q, dq, tau: (n,) rad, rad/s, N m.
            links: measured twists and accelerations (n, 6) of the links in their own frames,
                [v; w] m/s, rad/s and [a; dw] m/s², rad/s² (a with gravity, as an accelerometer
                reads it); synthesized from the documented λ where None.
        """
        motion = None if links is None else LinkMotion(*(np.asarray(x, float) for x in links))
        q, dq, tau = (np.asarray(x, float) for x in (q, dq, tau))
        return self._pipeline.step(JointSample(round(1e9 * time_s), q, dq, tau, motion))

    def predict(self, q: ArrayLike, dq: ArrayLike, ddq: ArrayLike) -> Array:
        """Torque (n,) or (m, n) N m by what is learned so far, as `inverse_dynamics` of instants.

        Args:
            q, dq, ddq: (n,) or (m, n) rad, rad/s, rad/s².
        """
        return inverse_dynamics(self.model, q, dq, ddq)

    @property
    def model(self) -> SelfModel:
        """The self model as it is known now, with standard deviations."""
        learned = self._pipeline.learner.learned
        if self._told is None or self._told[0] != learned:
            model = learned_model(collect(self._pipeline.learner), self._documented)
            self._told = learned, model
        return self._told[1]

    @property
    def refused(self) -> dict[str, int]:
        """How many samples were not learned from, by reason."""
        return dict(self._pipeline.front_end.refused)

    def __repr__(self) -> str:
        learner = self._pipeline.learner
        state = "converged" if learner.schema.converged else "not converged"
        return f"Learner({self._documented.name}: {learner.learned} samples learned, λ {state})"


def inverse_dynamics(
    model: SelfModel,
    q: ArrayLike,
    dq: ArrayLike,
    ddq: ArrayLike,
    *,
    effects: bool = True,
    time_s: ArrayLike | None = None,
) -> Array:
    """Joint torque (n,) or (m, n) N m of a fixed-base model, tool included (eqs. 11 to 16).

    Each row is an instant by itself: torque sensors have settled, bristles are bent the way the
    joint moves. With stamps the rows are one motion, and effects know what came before (late
    sensors, elastic gears, play, bristles, drift); rates less well within 50 ms of either end.

    Args:
        model: whose λ, θ, tool and gravity are used.
        q, dq, ddq: (n,) or (m, n) rad, rad/s, rad/s².
        effects: with the model's friction and other effects; False for the rigid body alone.
        time_s: (m,) s since the recording began, increasing, as in what `filtered` returns.

    Raises:
        ModelError: the model's base floats.
        SettingsError: stamps of another number than rows, or that do not increase.

    >>> import adapter, numpy as np
    >>> panda = adapter.load_model("panda")
    >>> rest = np.zeros(7)
    >>> bool(abs(adapter.inverse_dynamics(panda, rest, rest, rest)[0]) < 1e-9)  # axis upright
    True
    """
    tables = _joint_tables(model, q, dq, ddq)
    stamps = () if time_s is None else (_stamps(time_s, len(tables[0])),)
    tau = ModelTorque(model)(*tables, *stamps) if effects else RigidArm.of(model).torque(*tables)
    return tau[0] if np.ndim(q) == 1 else tau


def regressor(model: SelfModel, q: ArrayLike, dq: ArrayLike, ddq: ArrayLike) -> Array:
    """Y (n, 10 n) or (m, n, 10 n) of a fixed base (eq. 16): rigid torque is Y @ theta.ravel().

    Args:
        model: whose λ and gravity are used.
        q, dq, ddq: (n,) or (m, n) rad, rad/s, rad/s².

    Raises:
        ModelError: the model's base floats.

    >>> import adapter, numpy as np
    >>> panda = adapter.load_model("panda")
    >>> q = np.array([0.0, -0.7, 0.0, -2.3, 0.0, 1.6, 0.8])
    >>> Y = adapter.regressor(panda, q, 0.1 * q, q)
    >>> tau = adapter.inverse_dynamics(panda, q, 0.1 * q, q)
    >>> Y.shape, np.allclose(Y @ panda.theta.ravel(), tau)
    ((7, 70), True)
    """
    Y = RigidArm.of(model).regressor(*_joint_tables(model, q, dq, ddq))
    return Y[0] if np.ndim(q) == 1 else Y


class FilteredSignals(NamedTuple):
    """Joint signals of one and the same instant per row.

    Attributes:
        time_s: (k,) s after the first sample of the recording.
        q, dq, ddq, tau: (k, n) rad, rad/s, rad/s², N m.
    """

    time_s: Array
    q: Array
    dq: Array
    ddq: Array
    tau: Array

    def __repr__(self) -> str:
        return f"FilteredSignals({len(self.q)} instants of {self.q.shape[1]} joints)"


def filtered(log: Log | str | Path, model: SelfModel | str | Path = "panda") -> FilteredSignals:
    """q, dq, ddq and tau of one instant each, as the learner gets them.

    All go through one transfer, so that none lags another; what is refused (out of range, at
    rest, around a gap, ...) is left out.

    Args:
        log: a file, or what `read_log` or `make_log` returned.
        model: the documented arm, for its limits.

    Raises:
        DriverError: the recording lacks a joint of the arm.

    >>> import adapter
    >>> adapter.filtered("recordings/panda_nominal_6s.mcap")
    FilteredSignals(5777 instants of 7 joints)
    """
    arm, own = _fitting(model, _log(log))
    filter_settings, _ = fitted_to(own, PipelineSettings().filter)
    front_end = make_front_end(arm, PipelineSettings(filter=filter_settings))
    states = front_end.step_table(own.stamp_ns, own.q, own.dq, own.tau)
    at = front_end.layout
    since = 1e-9 * (stamps_of(states) - own.stamp_ns[0]) if len(own) else np.zeros(0)
    return FilteredSignals(since, *(states[:, part] for part in (at.q, at.dq, at.ddq, at.tau)))


def find_gap(
    logs: Log | str | Path | Sequence[Log | str | Path],
    model: SelfModel | str | Path = "panda",
    *,
    inertia_prior: float | None = None,
    validate_from_s: float | None = None,
    hold_out: Sequence[Log | str | Path] = (),
    model_out: str | Path | None = None,
) -> GapResult:
    """Where recordings and a model disagree, and which effects the model lacks (`adapter gap`).

    Args:
        logs: one or several recordings of one arm: what the hand carries is each one's own.
        model: never changed.
        inertia_prior: standard deviation of the model's inertial numbers, as a share of them.
        validate_from_s: of one recording, fit before this second and score after it.
        hold_out: recordings to score on; where none is, blocks of time of all in turn.
        model_out: where the new model goes (.json).

    Returns:
        `findings` (effect, joints from 1, parameters, std, evidence), `unexplained`, and the
        torque error of every joint `before` and `after`, N m, on data that the fit never saw.

    Raises:
        ValueError: another robot, flipped signs, other units; says which.
        DriverError, ModelError: a file that cannot be read.

    >>> import adapter
    >>> adapter.find_gap("recordings/panda_nominal_6s.mcap")
    GapResult(nothing found, torque error at most 0.0... -> 0.0... N m)
    """
    several = [logs] if isinstance(logs, Log | str | Path) else list(logs)
    settings = GapSettings(validate_from_s=validate_from_s, hold_out=tuple(hold_out))
    if inertia_prior is not None:
        settings = replace(settings, inertia_prior=inertia_prior)
    out = None if model_out is None else Path(model_out)
    return gap_of(several, model, settings, model_out=out)


def keep_law(result: GapResult, name: str, path: str | Path, *, joint: int | None = None) -> str:
    """Add a law that `find_gap` found to a file of one's own (`adapter effects keep`).

    Args:
        name: by which `find_gap` looks for it inside `with adapter.with_kept(path):`.
        joint: (from 1) whose law it is, where the result has several.

    Returns:
        the text that was added.

    Raises:
        SettingsError: a result without such a law, a name that is taken; names the choices.

    >>> import adapter
    >>> result = adapter.find_gap("recordings/panda_nominal_6s.mcap")
    >>> adapter.keep_law(result, "hose", "own.toml")
    Traceback (most recent call last):
        ...
    adapter.errors.SettingsError: the result: no such law; have: none
    """
    return keep([finding.as_dict() for finding in result.findings], name, joint, Path(path))


def discover(log: Log | str | Path, *, base: str | None = None) -> Discovery:
    """Which joint moves which link, and who is whose parent: N and A from motion (section V).

    Args:
        log: a file with the motion of links (twists, accelerations or IMUs, in any order and
            under any names) and joint signals, or what `read_log` returned.
        base: name of the link that carries all others, if that is known.

    Returns:
        `edges` (joint, link, parent, confidence), `root`, and `undecided`, a sentence for
        everything that the data leave open.

    Raises:
        SettingsError, ModelError, DriverError: a recording that cannot serve; says why.

    >>> import adapter
    >>> adapter.discover("recordings/panda_nominal_6s.mcap")
    Traceback (most recent call last):
        ...
    adapter.errors.SettingsError: ...
    """
    return discover_tree(
        log if isinstance(log, Log) else read_mcap(log, beside="sensors"), base=base
    )


def export(model: SelfModel, path: str | Path, onto: str | Path | None = None) -> Path:
    """Write a model as URDF (.urdf), MJCF (.xml), SDF (.sdf), USD (.usda), actuators of Isaac Lab
    (.py), C (.c), or whole as a model file of ours (.json).

    Args:
        model: in a URDF friction and damping stand in their place; what has none is left out.
        path: its suffix decides.
        onto: a robot's file of that format, of which only what was learned is to change; where
            None, the one that the model came from.

    Raises:
        ModelError: another suffix, or a body that cannot exist.

    >>> import adapter, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = adapter.export(adapter.load_model("panda"), folder + "/arm.urdf")
    ...     adapter.load_model(path)
    SelfModel(panda: 7 joints, λ documentation)
    """
    path = Path(path)
    if path.suffix == ".json":
        return save_model(model, path)
    if path.suffix not in EXPORTED:
        raise ModelError(f"{path}: no such format; have: {', '.join(EXPORTED)}, .json")
    path.write_bytes(EXPORTED[path.suffix](model, onto).text.encode())
    return path


def _model(model: SelfModel | str | Path) -> SelfModel:
    return model if isinstance(model, SelfModel) else read_robot(model)


def _fitting(model: SelfModel | str | Path, log: Log) -> tuple[SelfModel, Log]:
    """Model and recording with the same joints; a warning where the recording lacks some."""
    arm, locked = present(_model(model), log.joint_names, log.path)
    for sentence in locked:
        warnings.warn(sentence, ModelWarning, stacklevel=3)
    return arm, matching(log, arm)


def _log(log: Log | str | Path) -> Log:
    return log if isinstance(log, Log) else read_any(log)


def _joint_tables(model: SelfModel, *signals: ArrayLike) -> tuple[Array, ...]:
    if model.tree.floating:
        raise ModelError(f"{model.name}: its base floats; only fixed-base arms have this torque")
    tables = tuple(np.atleast_2d(np.asarray(x, float)) for x in signals)
    if any(table.shape != (len(tables[0]), model.tree.n) for table in tables):
        shapes = ", ".join(str(np.shape(x)) for x in signals)
        raise ModelError(f"q, dq, ddq need {model.tree.n} columns and as many rows; got {shapes}")
    return tables


def _stamps(time_s: ArrayLike, rows: int) -> Array:
    """Stamps (m,) of rows that are one motion."""
    t = np.atleast_1d(np.asarray(time_s, float))
    wanted = f"time_s needs rising stamps of {rows} rows (without it, rows are instants)"
    if t.shape != (rows,):
        raise SettingsError(f"{wanted}; got shape {t.shape}")
    wrong = np.flatnonzero(~(np.isfinite(t) & (np.diff(t, prepend=-np.inf) > 0.0)))
    if len(wrong):
        raise SettingsError(f"{wanted}; row {wrong[0]} (from 0) has {t[wrong[0]]} s")
    return t
