"""How the self is learned. Light to load: wrong settings are told at once."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

from adapter.effects.catalogue import effects_by_name
from adapter.errors import SettingsError


class Mode(StrEnum):
    """What an update descends: the cost over all samples, or (the paper) that of the newest."""

    MOMENTS = "moments"
    SAMPLE = "sample"


@dataclass(frozen=True)
class SchemaSettings:
    """How λ is learned.

    Attributes:
        rate: ADAM's longest step per sample, rad and m.
        share: longest step as a share of the distance to the optimum.
        sample_rate: ADAM's rate in mode `sample`.
        start_rms: spread of the random starting λ, rad and m.
        forget_s: time constant of the forgotten window in moving samples x 1 ms; None keeps all.
        judge_every: updates between two looks at curvature and identifiability; fewer looks are
            enough once λ has converged.
        std_goal: standard deviation of a turn (rad) or shift (m) that counts as known.
        distance_goal: what of those may be left to the optimum when λ has converged.
        stable_s: for how long that must hold, of motion.
        spin_measured: whether measured link motion has angular accelerations dw. Where not, the
            base's is carried along the tree by eq. 8d with the present λ, and moments made
            while λ still turned are dropped.
        imus: links with a gyroscope and an accelerometer mounted anyhow; λ is then found from
            these (see `imu_schema`), and most of the above does not count.
    """

    rate: float = 1.5e-2
    share: float = 0.15
    sample_rate: float = 1e-3
    start_rms: float = 0.01
    forget_s: float | None = None
    judge_every: int = 10
    std_goal: float = 0.00125
    distance_goal: float = 2.5e-4
    stable_s: float = 0.2
    spin_measured: bool = True
    imus: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(set(self.imus)) < len(self.imus):
            raise SettingsError(f"schema.imus names a link twice: {', '.join(self.imus)}")
        for name in ("rate", "share", "sample_rate", "start_rms", "judge_every", "stable_s"):
            if not getattr(self, name) > 0:
                raise SettingsError(f"schema.{name} must be above zero, got {getattr(self, name)}")
        if self.forget_s is not None and self.forget_s < 0.05:
            raise SettingsError(f"schema.forget_s must be at least 0.05 s, got {self.forget_s}")


@dataclass(frozen=True)
class ThetaSettings:
    """How θ is learned.

    Attributes:
        rate: ADAM's rate per sample on the log-Cholesky parameters.
        settled_rate: the same once θ has converged: smaller steps, no spikes.
        betas: ADAM's averaging constants.
        average: samples that the reported running mean spans.
        settled_average: the same once θ has converged.
        restarts: samples after a change at which the spare body is put to the point mass that
            fits best so far; ADAM refines it from there.
        warm_up: samples in the moments before the first step.
        forget_s: time constant of directional forgetting in moving samples x 1 ms; None: none.
        model_error: torque that the model is not trusted to explain, N m; no weight looks below
            it. None: 0.025 where friction or another effect is found (a real arm, whose friction
            no such model explains better), 0.001 else.
        sample_rate: ADAM's rate in mode `sample`.
    """

    rate: float = 3e-3
    settled_rate: float = 1e-3
    betas: tuple[float, float] = (0.97, 0.99)
    average: int = 100
    settled_average: int = 30
    restarts: tuple[int, ...] = (50, 100, 200, 400)
    warm_up: int = 50
    forget_s: float | None = None
    model_error: float | None = None
    sample_rate: float = 1e-3

    def __post_init__(self) -> None:
        for name in ("rate", "settled_rate", "average", "settled_average", "sample_rate"):
            if not getattr(self, name) > 0:
                raise SettingsError(f"theta.{name} must be above zero, got {getattr(self, name)}")
        if len(self.betas) != 2 or not all(0.0 <= beta < 1.0 for beta in self.betas):
            raise SettingsError(f"theta.betas must be two numbers in [0, 1), got {self.betas}")
        if self.forget_s is not None and self.forget_s < 0.5:
            raise SettingsError(f"theta.forget_s must be at least 0.5 s, got {self.forget_s}")


@dataclass(frozen=True)
class ChangeSettings:
    """When a torque error means that something changed.

    Attributes:
        enabled: whether changes are looked for.
        fast, slow: samples that the error and its level are averaged over.
        all_factor: alarm when the rms over all joints, each in units of its level, exceeds this.
        one_factor: alarm when a single joint's does.
        burst_factor: neither alarms below this multiple of the largest burst seen before; real
            arms show bursts where friction reverses.
        burst_memory: samples over which such a burst is forgotten.
        arm_after: samples of θ learning before the first alarm can be.
        rearm_after: samples after a change before the next can be.
        wait: samples after an alarm while the filters fill with the new state; the error must
            still be there behind them, or the alarm was a burst.
    """

    enabled: bool = True
    fast: int = 50
    slow: int = 2000
    all_factor: float = 2.6
    one_factor: float = 5.0
    burst_factor: float = 1.5
    burst_memory: int = 20_000
    arm_after: int = 5000
    rearm_after: int = 3000
    wait: int = 130

    def __post_init__(self) -> None:
        if not 1 <= self.fast < self.slow:
            raise SettingsError("change.fast must be at least 1 and below change.slow")


@dataclass(frozen=True)
class LearnerSettings:
    """How the self is learned.

    Attributes:
        mode: see `Mode`.
        effects: names from the catalogue, learned beside θ.
        seed: of the random start of λ.
        update_every: states for each ADAM step; every state joins the moments.
        base_wrench: whether the wrench on a floating base in the states counts (zero in free
            motion); where nobody knows what pushes it, joints' torques alone teach θ.
        wait_for_schema: whether θ waits until λ has converged.
        held_samples: newest states kept to rebuild θ's moments from when λ has moved.
        rebuild_rows: how many of them each state redoes.
        rebuild_stds: by how many of its standard deviations λ may leave θ's moments.
        schema, theta, change: of the parts.
    """

    mode: str = Mode.MOMENTS
    effects: tuple[str, ...] = ()
    seed: int = 0
    update_every: int = 1
    base_wrench: bool = True
    wait_for_schema: bool = True
    held_samples: int = 60_000
    rebuild_rows: int = 10
    rebuild_stds: float = 1.0
    schema: SchemaSettings = field(default_factory=SchemaSettings)
    theta: ThetaSettings = field(default_factory=ThetaSettings)
    change: ChangeSettings = field(default_factory=ChangeSettings)

    def __post_init__(self) -> None:
        if self.mode not in tuple(Mode):
            raise SettingsError(f"no learner mode '{self.mode}'; have: {', '.join(Mode)}")
        if self.held_samples < 1000:
            raise SettingsError(f"held_samples must be at least 1000, got {self.held_samples}")
        if self.update_every < 1:
            raise SettingsError(f"update_every must be at least 1, got {self.update_every}")
        if self.rebuild_rows < 2:
            raise SettingsError(f"rebuild_rows must be at least 2, got {self.rebuild_rows}")
        effects_by_name(self.effects)
