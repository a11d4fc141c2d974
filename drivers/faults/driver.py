"""Any driver with faults between it and its user: seeded, so that a run can be repeated."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from drivers.faults.spec import KINDS, Fault, Faults
from drivers.interface import (
    Array,
    Driver,
    DriverError,
    EndOfStream,
    JointSample,
    LinkMotion,
    PassedOn,
)

MOST_BITS = 3  # flipped at a time
SIGNALS = ("q", "dq", "tau")
# A spike of factor 1 is up to this far off: rad, rad/s, N m; at least a fifth of it.
SPIKE_SIZE = {"q": 0.5, "dq": 2.0, "tau": 30.0}


def flip_bits(values: Array, at: int, rng: np.random.Generator) -> Array:
    """A copy of values with one to three bits of its entry `at` (flat) flipped."""
    out = values.copy()
    words = out.reshape(-1).view(np.uint64)
    for bit in rng.choice(64, size=rng.integers(1, MOST_BITS + 1), replace=False):
        words[at] ^= np.uint64(1) << np.uint64(bit)
    return out


def corrupt(sample: JointSample, rng: np.random.Generator) -> JointSample:
    """Flip bits of one number: it may become huge, tiny, not a number or just a little wrong."""
    n = len(sample.q)
    numbers = 3 * n if sample.links is None else 15 * n
    at = int(rng.integers(numbers))
    if at < 3 * n:
        name = SIGNALS[at // n]
        changed: dict[str, Any] = {name: flip_bits(getattr(sample, name), at % n, rng)}
        return replace(sample, **changed)
    assert sample.links is not None
    at -= 3 * n
    twist, accel = sample.links.twist, sample.links.accel
    if at < 6 * n:
        return replace(sample, links=LinkMotion(flip_bits(twist, at, rng), accel))
    return replace(sample, links=LinkMotion(twist, flip_bits(accel, at - 6 * n, rng)))


def corrupt_stamp(sample: JointSample, rng: np.random.Generator) -> JointSample:
    """Flip bits of the stamp."""
    stamp_ns = sample.stamp_ns
    bits = rng.choice(62, size=rng.integers(1, MOST_BITS + 1), replace=False)
    for bit in bits:
        stamp_ns ^= 1 << int(bit)
    return replace(sample, stamp_ns=stamp_ns)


def with_reading(sample: JointSample, name: str, joint: int, value: float) -> JointSample:
    """One reading (q, dq or tau) of one joint is another."""
    values = getattr(sample, name).copy()
    values[joint] = value
    return replace(sample, **{name: values})


def blank(sample: JointSample, rng: np.random.Generator) -> JointSample:
    """One reading of one joint, or all of them, is not a number."""
    joint, which = int(rng.integers(len(sample.q))), int(rng.integers(len(SIGNALS) + 1))
    for name in SIGNALS if which == len(SIGNALS) else SIGNALS[which : which + 1]:
        sample = with_reading(sample, name, joint, np.nan)
    return sample


def spike(sample: JointSample, rng: np.random.Generator, factor: float) -> JointSample:
    """One reading of one joint is off by up to `factor` times the usual size of a spike."""
    name = SIGNALS[rng.integers(len(SIGNALS))]
    size = rng.uniform(0.2, 1.0) * rng.choice([-1.0, 1.0])
    joint = int(rng.integers(len(sample.q)))
    value = getattr(sample, name)[joint] + factor * SPIKE_SIZE[name] * size
    return with_reading(sample, name, joint, value)


SILENCE_LIMIT_S = 0.1  # an arm that is silent for longer is given up with a DriverError


@dataclass
class Account:
    """What was made of the samples: taken + repeated = delivered + lost + silenced + waiting.

    Attributes:
        taken: samples read from the driver behind.
        delivered: samples given to the user.
        injected: how often each fault was put in, by name; jump, stuck, clock: samples concerned.
        waiting: samples held back, for a later read.
    """

    taken: int = 0
    delivered: int = 0
    injected: Counter[str] = field(default_factory=Counter)
    waiting: int = 0

    @property
    def balanced(self) -> bool:
        """Whether nothing got lost but on purpose."""
        kept_back = self.injected["lost"] + self.injected["silence"] + self.waiting
        return self.taken + self.injected["repeated"] == self.delivered + kept_back

    def line(self) -> str:
        """One line for people."""
        counts = [f"{name} {self.injected[name]}" for name in KINDS if self.injected[name]]
        return f"faults put into {self.taken} samples: {', '.join(counts) or 'none'}"


class FaultyDriver(PassedOn):
    """A driver with faults; names, period, intake and arrival instants are those of the driver.

    `lost`, `late` and `reordered` make one read take several samples of the driver, so that an
    arm that moves on by one period a read moves on by several, as a real one would. The same
    seed, faults and samples give the same faults. Each kind has random numbers of its own:
    another fault beside it changes nothing about the instants of the first.

    Args:
        driver: not connected yet.
        faults: to put in; times count from the first sample after `connect`.
        seed: of the random numbers.

    Attributes:
        driver: the one behind.
        account: what was put in since `connect`.
        plant_time_ns: sum over the samples that the last `read` took, where the driver says it.

    Raises:
        DriverError: a fault names a joint that the arm does not have.
    """

    robot = property(lambda self: getattr(self.driver, "robot", ""))  # that it says it is

    def __init__(self, driver: Driver, faults: Faults, seed: int = 0) -> None:
        n = len(driver.joint_names)
        for item in faults.items:
            if item.joint is not None and not 1 <= item.joint <= n:
                raise DriverError(f"fault '{item}': the arm has joints 1 to {n}")
        super().__init__(driver)
        self.faults, self.seed = faults, seed
        self.plant_time_ns = 0
        self._shares = {item.name: item for item in faults.items if item.share is not None}
        self._lasting = faults.timed("stuck", "jump", "clock")
        self._ends = faults.timed("silence", "died")
        self._start()

    def _start(self) -> None:
        self.account = Account()
        self._rng = {name: np.random.default_rng([self.seed, k]) for k, name in enumerate(KINDS)}
        self._first_ns: int | None = None
        self._last: JointSample | None = None
        self._held: list[tuple[int, JointSample]] = []  # (read that it is due at, sample)
        self._stuck: dict[Fault, list[float]] = {}
        self._reads = 0
        self._dead: str | None = None

    def connect(self) -> None:
        """Connect the driver and begin the faults anew. Raises DriverError."""
        self.driver.connect()
        self._start()

    def command(self, tau: Array) -> None:
        """Pass (n,) N m on. Raises DriverError."""
        if self._dead is not None:
            raise DriverError(self._dead)
        super().command(tau)

    def stop(self) -> None:
        """Stop the driver."""
        self.driver.stop()

    def close(self) -> None:
        """Close the driver; what waits is given to nobody."""
        self.driver.close()
        self._last = None
        self._held.clear()

    def read(self) -> JointSample:
        """The next sample, as the faults leave it. Raises DriverError, also as a fault."""
        if self._dead is not None:
            raise DriverError(self._dead)
        self.plant_time_ns = 0
        self._reads += 1
        if self._hits("slow"):
            time.sleep(self._amount("slow"))
        if self._last is not None and self._hits("repeated"):
            sample = self._last
        elif self._held and self._held[0][0] <= self._reads:
            sample = self._release()
        else:
            sample = self._fresh()
        self._last = sample
        self.account.delivered += 1
        return sample

    def _fresh(self) -> JointSample:
        """The next sample that is neither lost nor held back."""
        while True:
            try:
                sample = self._altered(self._take())
            except EndOfStream:
                if not self._held:
                    raise
                return self._release()
            if self._hits("lost"):
                continue
            if self._hits("late"):
                self._hold(sample, max(1, round(self._amount("late"))))
            elif self._hits("reordered"):
                self._hold(sample, 1)
            else:
                return sample

    def _hold(self, sample: JointSample, reads: int) -> None:
        self._held.append((self._reads + reads, sample))
        self._held.sort(key=lambda entry: entry[0])
        self.account.waiting += 1

    def _release(self) -> JointSample:
        self.account.waiting -= 1
        return self._held.pop(0)[1]

    def _take(self) -> JointSample:
        """A sample of the driver that no silence swallows. Raises DriverError."""
        while True:
            sample = self.driver.read()
            self.plant_time_ns += getattr(self.driver, "plant_time_ns", 0)
            self.account.taken += 1
            if self._first_ns is None:
                self._first_ns = sample.stamp_ns
            if not self._swallowed(self._time_s(sample)):
                return sample

    def _time_s(self, sample: JointSample) -> float:
        """Seconds since the first sample, on the clock that no fault has touched."""
        assert self._first_ns is not None
        return 1e-9 * (sample.stamp_ns - self._first_ns)

    def _swallowed(self, now_s: float) -> bool:
        """Whether a silence takes this sample. Raises DriverError when it is too long, or dead."""
        for fault in self._ends:
            assert fault.at_s is not None
            if now_s < fault.at_s:
                continue
            if fault.name == "died":
                self.account.injected["died"] += 1
                self.account.injected["silence"] += 1  # the sample that nobody gets
                self._dead = "the connection to the arm is gone (fault died); connect again"
                raise DriverError(self._dead)
            if fault.amount is not None and now_s < fault.at_s + fault.amount:
                self.account.injected["silence"] += 1
                if now_s >= fault.at_s + SILENCE_LIMIT_S:
                    raise DriverError(
                        f"nothing heard of the arm for {SILENCE_LIMIT_S} s (fault silence); "
                        "look at the cable, then connect again"
                    )
                return True
        return False

    def _altered(self, sample: JointSample) -> JointSample:
        """The sample as stuck joints, jumps, clocks and single wrong numbers leave it."""
        now_s = self._time_s(sample)
        for fault in self._lasting:
            assert fault.at_s is not None and fault.amount is not None
            joint = (fault.joint or 1) - 1
            if now_s < fault.at_s or (fault.name == "stuck" and now_s >= fault.at_s + fault.amount):
                continue
            if fault.name == "stuck":
                now = [float(getattr(sample, name)[joint]) for name in SIGNALS]
                held = self._stuck.setdefault(fault, now)
                for name, value in zip(SIGNALS, held, strict=True):
                    sample = with_reading(sample, name, joint, value)
            elif fault.name == "jump":
                sample = with_reading(sample, "q", joint, sample.q[joint] + fault.amount)
            else:
                sample = replace(sample, stamp_ns=sample.stamp_ns + round(1e9 * fault.amount))
            self.account.injected[fault.name] += 1
        if self._hits("spike"):
            sample = spike(sample, self._rng["spike"], self._amount("spike"))
        for name, change in (("corrupt", corrupt), ("nan", blank), ("stamp", corrupt_stamp)):
            if self._hits(name):
                sample = change(sample, self._rng[name])
        return sample

    def _hits(self, name: str) -> bool:
        """Whether the fault strikes now; counts it."""
        fault = self._shares.get(name)
        if fault is None or fault.share is None or self._rng[name].random() >= fault.share:
            return False
        self.account.injected[name] += 1
        return True

    def _amount(self, name: str) -> float:
        amount = self._shares[name].amount
        assert amount is not None
        return amount


def with_faults(driver: Driver, text: str, seed: int = 0) -> FaultyDriver:
    """The driver with the faults that a text names, see `Faults.parse`. Raises DriverError."""
    return FaultyDriver(driver, Faults.parse(text), seed)
