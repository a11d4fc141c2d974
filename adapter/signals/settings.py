"""How signals are filtered and checked. Light to load: wrong settings are told at once."""

from __future__ import annotations

from dataclasses import dataclass

from adapter.errors import SettingsError

STATE_S = 1e-3  # between two filtered states, about: all that counts states counts milliseconds
WIDEST_BAND, FINEST_BAND = 0.3, 0.1  # corner over rate of samples, of steps, at most


@dataclass(frozen=True)
class FilterSettings:
    """How the filter weighs noise against change.

    Attributes:
        bandwidth_hz: corner of L; used where `dq_drive` is not given. Real Pandas show a torque
            oscillation of 10 to 40 Hz that no rigid model explains, so the default stays below
            (held-out error on a real log, worst joint: 0.90 at 6 Hz, 0.93 at 8, 0.96 at 10).
        dq_noise: standard deviation of one dq sample, rad/s; only the ratio to `dq_drive` matters.
            None: a replay takes it from the recording's high frequencies.
        dq_drive: white-noise intensity of dq's second derivative, rad/s³/√Hz; sets the gains
            together with `dq_noise` instead of `bandwidth_hz`.
        period_s: nominal sample period, s. Between slower samples there are several filtered
            states (`states_per_sample`), and of faster ones not all become one.
    """

    bandwidth_hz: float = 6.0
    dq_noise: float | None = None
    dq_drive: float | None = None
    period_s: float = 1e-3

    def __post_init__(self) -> None:
        for name in ("bandwidth_hz", "dq_noise", "period_s", "dq_drive"):
            if getattr(self, name) is not None and not getattr(self, name) > 0.0:
                raise SettingsError(f"filter.{name} must be above zero, got {getattr(self, name)}")
        if self.dq_drive is None and self.bandwidth_hz > self.widest_hz * (1.0 + 1e-6):
            raise SettingsError(
                f"filter.bandwidth_hz {self.bandwidth_hz} is too high at {1.0 / self.period_s:.0f} "
                f"samples a second; at most {self.widest_hz:.3g}"
            )

    @property
    def widest_hz(self) -> float:
        """Highest `bandwidth_hz` at this rate: of the samples and of the filter's steps."""
        return min(WIDEST_BAND / self.period_s, FINEST_BAND / self.step_s)

    @property
    def states_per_sample(self) -> int:
        """States that a sample completes: those since the one before, some `STATE_S` apart."""
        return max(round(self.period_s / STATE_S), 1)

    @property
    def samples_per_state(self) -> int:
        """Samples of which one becomes a state, where there are several in `STATE_S`."""
        return max(int(STATE_S / self.period_s + 1e-6), 1)

    @property
    def step_s(self) -> float:
        """What the filter advances by, s."""
        return self.period_s / self.states_per_sample


@dataclass(frozen=True)
class FrontEndSettings:
    """What counts as a usable sample.

    Attributes:
        rest_dq: below this on every joint (filtered, rad/s) the arm rests and teaches nothing.
        max_gap_s: a longer hole in the stamps restarts the filter, unless it is shorter than
            `GAP_PERIODS` sample periods.
        q_margin: how far beyond a documented position limit a reading may lie, rad.
        range_factor: how far beyond documented speed and effort, as a factor.
        saturation: share of the effort limit from which a torque counts as saturated.
    """

    rest_dq: float = 0.02
    max_gap_s: float = 0.02
    q_margin: float = 0.3
    range_factor: float = 3.0
    saturation: float = 0.98

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            if not getattr(self, name) > 0.0:
                raise SettingsError(f"front_end.{name} must be above zero")
