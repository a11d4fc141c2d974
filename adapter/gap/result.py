"""What the workflow ends with: findings, what stays unexplained, the gap before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from adapter.effects.base import of_sliding
from adapter.model.numbers import plus_minus
from adapter.model.spatial import Array
from drivers.files.html_table import html_table

UNEXPLAINED = "unexplained"  # the name of what no effect of the catalogue explains
WORSE = 0.05  # share by which an error of a joint may grow on data not seen, and unsaid


@dataclass(frozen=True)
class Finding:
    """An effect that the model lacks.

    Attributes:
        effect: canonical name; title: for people.
        joints: from 1; empty where the effect has none of its own.
        interval_s: (from, to) s of the recording in which it acts.
        lasting: it goes on to the end of the recording.
        parameters, std, units: by key.
        evidence: posterior probability against the best rival, 0 to 1.
        overlaps: rivals, effect -> share of this signature that it explains on these data,
            0.9 and more, best first, at most three.
        split_by: the experiment that would tell them apart.
        detectability: z, its size in standard deviations of what else could explain it.
        torque_rms_nm: (n,) what it adds to each joint, rms while it acts.
        recording: whose own it is; empty where it is common to all.
        curve: of a law its torque `over` a signal ("q2"): torque_nm and std_nm at some of it.
    """

    effect: str
    title: str
    joints: tuple[int, ...]
    interval_s: tuple[float, float]
    lasting: bool
    parameters: dict[str, Any]
    std: dict[str, Any]
    units: dict[str, str]
    evidence: float
    overlaps: dict[str, float]
    split_by: str
    detectability: float
    torque_rms_nm: Array
    recording: str = ""
    curve: dict[str, Any] | None = None

    @property
    def throughout(self) -> bool:
        """Whether it acts from the first sample to the last."""
        return self.lasting and self.interval_s[0] <= 0.0

    @property
    def two_readings(self) -> bool:
        """Whether it is a load at the hand or a last link that is heavier by that, all the same."""
        common = self.throughout and not self.recording
        return self.effect == "payload" and common and self.overlaps.get("link_inertia", 0) > 0.995

    def _repr_html_(self) -> str:
        """Sizes with units and doubt, for notebooks."""
        return _findings_html(f"Finding: {self.title}", [self])

    def as_dict(self) -> dict[str, Any]:
        """As in the JSON file."""
        own = asdict(self)
        del own["title"]
        own["ambiguous_with"], own["overlap"] = list(self.overlaps), own.pop("overlaps")
        own["z"] = own.pop("detectability")
        return own


def _findings_html(title: str, findings: Sequence[Finding]) -> str:
    heads = ("effect", "joints", "size", "evidence", "could also be")
    rows = [
        (
            finding.title,
            ", ".join(map(str, finding.joints)),
            "; ".join(_size(finding, key) for key in finding.parameters),
            f"{finding.evidence:.0%}",
            ", ".join(finding.overlaps),
        )
        for finding in findings
    ]
    return html_table(title, heads, rows)


def _size(finding: Finding, key: str) -> str:
    """A parameter ± its standard deviation, with its unit; of a table of numbers all of them."""
    values, std = np.ravel(finding.parameters[key]), np.ravel(finding.std.get(key, np.nan))
    doubts = np.resize(np.asarray(std, float), values.shape)
    sizes = ", ".join(map(plus_minus, np.asarray(values, float), doubts))
    return f"{key} = {sizes} {finding.units.get(key, '')}".rstrip()


@dataclass(frozen=True)
class Leftover:
    """What no effect of the catalogue explains.

    Attributes:
        joint: from 1.
        rmse_nm: of what is left, in the band; noise_floor_nm: of the noise there.
        depends_on: signals that it follows, strongest first ("dq3", "q3", "tau2", "t", ...).
        interval_s: when.
    """

    joint: int
    rmse_nm: float
    noise_floor_nm: float
    depends_on: tuple[str, ...]
    interval_s: tuple[float, float]


@dataclass(frozen=True)
class Unseen:
    """How large an effect would have been named.

    Attributes:
        effect: canonical name; joint: from 1, 0 for the whole arm.
        parameter, size, unit: the least that would have been, or the largest where `above`: what
            is stiffer than that does not show.
    """

    effect: str
    joint: int
    parameter: str
    size: float
    unit: str
    above: bool


@dataclass(frozen=True)
class LogLoad:
    """What the hand carries in one of several recordings, fitted together.

    Attributes:
        recording: its name; shown: whether it weighs more than the doubt.
        mass_kg, mass_std_kg: of the load, beside what the model says is there.
        com_m, com_std_m: its centre in axes of `frame`; None where the recordings do not show it.
    """

    recording: str
    shown: bool
    mass_kg: float
    mass_std_kg: float
    com_m: tuple[float, ...] | None
    com_std_m: tuple[float, ...] | None
    frame: str


@dataclass(frozen=True)
class Shortfall:
    """How far model and data are apart on data that the fit never saw, by joint.

    Attributes:
        torque_rmse_nm: (n,) inverse dynamics, by the recipe of `adapter.signals.validation`.
        rollout_rmse_rad, rollout_rmse_rad_s: (n,) forward simulation restarted every 0.5 s;
            None where it was not asked for.
    """

    torque_rmse_nm: Array
    rollout_rmse_rad: Array | None = None
    rollout_rmse_rad_s: Array | None = None


@dataclass(frozen=True, eq=False)
class Curves:
    """Signals of one recording at 25 Hz, for plots: (k,) and (k, n).

    Attributes:
        recording: name of the file.
        t: s; q, dq, ddq, tau: smooth motion and measured torque in the band.
        before, after: measured less predicted torque, nominal model and new one, N m; after is
            predicted without the block of data that holds the instant.
    """

    recording: str
    t: Array
    q: Array
    dq: Array
    ddq: Array
    tau: Array
    before: Array
    after: Array


@dataclass(frozen=True, eq=False)
class RolloutCurves:
    """Forward simulation against data, (k,) and (k, n), rad: NaN between segments."""

    t: Array
    measured: Array
    before: Array
    after: Array


class InUnits:
    """A result whose joints turn or slide: `slides` (n,), empty where none does."""

    slides: tuple[bool, ...] = ()

    def unit(self, unit: str, joint: int | None = None) -> str:
        """A unit of turning joints as it is of a joint (from 0), or of all: N m (N of joint 1)."""
        own = [j for j, slides in enumerate(self.slides) if slides]
        if joint is not None:
            return of_sliding(unit) if joint in own else unit
        sliding = f" ({of_sliding(unit)} of joint {', '.join(str(j + 1) for j in own)})"
        return unit + sliding * bool(own)


@dataclass(frozen=True)
class GapResult(InUnits):
    """All that `adapter gap` says.

    Attributes:
        joint_names: of the arm; model_name: what it is called.
        recordings: names of the files; model_in: of the model.
        noise_floor_nm: (n,) rms of the torque noise in the band of the figures.
        before, after: nominal model and new one.
        findings, unexplained: see there.
        corrections: (n, 10) the small correction of the inertias; corrections_prior: (n, 10)
            what was allowed a priori, one standard deviation each.
        unseen: of effects that were not named, how large they would have been.
        loads: of several recordings, what the hand carries in each; empty for one.
        contradictions: of several recordings, which are not of the arm of the others, a sentence
            each.
        in_sample: nothing could be held out; `before` and `after` are of what was fitted.
        notes: sentences about the log (timing, joints that stand still, ...).
        problem: why nothing could be told; None where something could.
        curves: one per recording; rollouts: one per recording that was simulated.
        model_out: where the new model is.
        what_next: experiments worth making, best first.
        where: what the nominal model's residual follows, one entry a joint.
        simulator: in which was simulated; None where it was not.
        stopped_after_rounds: the search had to stop then, and might have found more; None where
            it came to its end.
        wall_s: how long all that took.
        sampled: of recordings that are too long to be searched whole, the stretches that were.
        torque_gains: of the drives, where they were learned (`torque_gains.TorqueGains`).
        slides: (n,) whether each joint does: its figures are then in N and m, whatever their names.
    """

    joint_names: tuple[str, ...]
    model_name: str
    recordings: tuple[str, ...]
    model_in: str
    noise_floor_nm: Array
    before: Shortfall
    after: Shortfall
    findings: tuple[Finding, ...] = ()
    unexplained: tuple[Leftover, ...] = ()
    unseen: tuple[Unseen, ...] = ()
    corrections: Array | None = None
    corrections_prior: Array | None = None
    notes: tuple[str, ...] = ()
    problem: str | None = None
    curves: tuple[Curves, ...] = ()
    rollouts: tuple[RolloutCurves, ...] = ()
    model_out: str | None = None
    what_next: tuple[str, ...] = ()
    where: tuple[dict[str, Any], ...] = ()
    simulator: str | None = None
    stopped_after_rounds: int | None = None
    wall_s: float = 0.0
    loads: tuple[LogLoad, ...] = ()
    contradictions: tuple[str, ...] = ()
    in_sample: bool = False
    torque_gains: dict[str, Any] | None = None
    sampled: tuple[dict[str, Any], ...] = ()
    slides: tuple[bool, ...] = ()

    def __repr__(self) -> str:
        if self.problem is not None:
            return f"GapResult({self.problem})"
        before, after = (np.max(part.torque_rmse_nm) for part in (self.before, self.after))
        names = ", ".join(dict.fromkeys(finding.effect for finding in self.findings)) or "nothing"
        fell = f"{before:.2g} -> {after:.2g} {self.unit('N m')}"
        return f"GapResult({names} found, torque error at most {fell})"

    def _repr_html_(self) -> str:
        """Findings, and the torque error of each joint before and after, for notebooks."""
        if self.problem is not None:
            return html_table(repr(self), (), ())
        errors = zip(
            self.joint_names,
            map(plus_minus, self.before.torque_rmse_nm),
            map(plus_minus, self.after.torque_rmse_nm),
            strict=True,
        )
        unit = self.unit("N m")
        heads = ("joint", f"torque error before, {unit}", f"after, {unit}")
        return _findings_html(repr(self), self.findings) + html_table("", heads, list(errors))

    @classmethod
    def untold(
        cls,
        joint_names: Sequence[str],
        model_name: str,
        recordings: Sequence[str],
        model_in: str,
        problem: str,
    ) -> GapResult:
        """Nothing but the reason why nothing could be told."""
        unknown: Array = np.full(len(joint_names), np.nan)
        nothing = Shortfall(unknown, unknown, unknown)
        names = tuple(joint_names), model_name, tuple(recordings), model_in
        return cls(*names, unknown, nothing, nothing, problem=problem)

    def as_dict(self) -> dict[str, Any]:
        """All but the curves; `adapter.gap.words.as_json` adds the headline."""
        own = {field.name: getattr(self, field.name) for field in fields(self)}
        for key in ("model_name", "curves", "rollouts", "corrections", "corrections_prior"):
            del own[key]
        for key in ("before", "after"):
            own[key] = asdict(own[key])
        own["findings"] = [finding.as_dict() for finding in self.findings]
        own["loads"] = [asdict(load) for load in self.loads]
        for key in ("unexplained", "unseen"):
            own[key] = [asdict(entry) for entry in getattr(self, key)]
        return {**own, "inertial_correction": self._correction()}

    def _correction(self) -> dict[str, Any] | None:
        if self.corrections is None or self.corrections_prior is None:
            return None
        return {
            "dtheta": self.corrections,
            "prior_std": self.corrections_prior,
            "largest_in_prior_std": float(np.abs(self.corrections / self.corrections_prior).max()),
        }
