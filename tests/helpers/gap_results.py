"""Made-up outcomes of the search for the gap, for tests of what is said and shown about them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from adapter.effects.catalogue import CATALOGUE
from adapter.effects.phrases import experiments
from adapter.gap.result import Curves, Finding, GapResult, Leftover, RolloutCurves, Shortfall

NOISE_NM = 0.02
LONG_S = 20.0


def finding(effect: str, joints=(), values=None, std=None, span=(0.0, LONG_S), **more) -> Finding:
    """A finding with plausible company; it lasts unless said otherwise."""
    known = CATALOGUE[effect]
    worth = np.full(7, 0.01)
    worth[[j - 1 for j in joints]] = 1.5
    usual: dict[str, Any] = {
        "lasting": True,
        "evidence": 0.9993,
        "overlaps": {},
        "split_by": "; ".join(experiments(known, map(CATALOGUE.get, more.get("overlaps", ())))),
        "detectability": 40.0,
        "torque_rms_nm": worth,
    }
    usual.update(more)
    return Finding(effect, known.title, joints, span, parameters=values, std=std or {},
                   units=known.units(), **usual)  # fmt: skip


COULOMB = finding(
    "coulomb_friction", (4,), {"Fc": 2.0}, {"Fc": 0.03}, overlaps={"load_dependent_friction": 0.97}
)
PAYLOAD = finding(
    "payload",
    (),
    {"m": 1.02, "cx": 0.01, "cy": -0.002, "cz": 0.081, "inertia": [0.01, 0, 0, 0.01, 0, 0.005]},
    {"m": 0.01, "cx": 0.002, "cy": 0.002, "cz": 0.004, "inertia": [0.002] * 6},
    span=(12.3, LONG_S),
    overlaps={"link_inertia": 1.0},
    torque_rms_nm=np.array([0.1, 5.0, 0.2, 4.0, 0.1, 0.6, 0.01]),
)


def curves(n: int = 7, seconds: float = LONG_S, name: str = "shelf.mcap") -> Curves:
    """Motion with Coulomb friction of 2 N m on the last but three joint, before; noise after."""
    rng = np.random.default_rng(3)
    t = np.arange(0.0, seconds, 0.04)
    rates = 0.5 + 0.2 * np.arange(n)
    q = 0.8 * np.sin(rates * t[:, None])
    dq, ddq = 0.8 * rates * np.cos(rates * t[:, None]), -(rates**2) * q
    tau = 10.0 * np.cos(q) + 0.5 * ddq
    after = NOISE_NM * rng.standard_normal((len(t), n))
    before = after + 0.03 * np.sin(t)[:, None]
    before[:, max(n - 4, 0)] += 2.0 * np.tanh(dq[:, max(n - 4, 0)] / 0.02)
    return Curves(name, t, q, dq, ddq, tau, before, after)


def leaving(before: float, after: Any) -> tuple[Curves, ...]:
    """Curves of which the models leave that much throughout, N m."""
    own = curves()
    levels = (x * np.ones_like(own.tau) for x in (before, after))
    return (replace(own, **dict(zip(("before", "after"), levels, strict=True))),)


def rollout(shown: Curves) -> RolloutCurves:
    """Half-second segments that drift away, less so after; the first sample of each is NaN."""
    n = shown.q.shape[1]
    t = np.arange(0.0, shown.t[-1], 0.01)
    measured = np.stack([np.interp(t, shown.t, shown.q[:, j]) for j in range(n)], axis=1)
    drift = (t % 0.5)[:, None] ** 2 * np.sin(0.7 * t)[:, None]
    before, after = measured + 0.4 * drift, measured + 0.02 * drift
    cut = t % 0.5 < 0.009
    before[cut], after[cut] = np.nan, np.nan
    return RolloutCurves(t, measured, before, after)


def errors(torque, rollout_rad=None) -> Shortfall:
    """Errors by joint."""
    if rollout_rad is None:
        return Shortfall(np.asarray(torque, dtype=float))
    rad = np.asarray(rollout_rad, dtype=float)
    return Shortfall(np.asarray(torque, dtype=float), rad, 8.0 * rad)


def one_finding() -> GapResult:
    """Coulomb friction on joint 4, with rollouts and a correction."""
    shown = curves()
    correction = np.zeros((7, 10))
    correction[2, 0], correction[3, 1], correction[5, 9] = 0.05, -0.002, 0.0004
    return GapResult(
        tuple(f"panda_joint{j + 1}" for j in range(7)),
        "panda",
        ("shelf.mcap",),
        "nominal.json",
        np.full(7, NOISE_NM),
        errors(
            [0.03, 0.05, 0.03, 1.92, 0.03, 0.02, 0.02],
            [0.001, 0.002, 0.001, 0.08, 0.001, 0.001, 0.002],
        ),
        errors([0.02] * 7, [5e-4, 9e-4, 5e-4, 2e-3, 6e-4, 7e-4, 9e-4]),
        findings=(COULOMB,),
        corrections=correction,
        corrections_prior=np.full((7, 10), 0.02),
        notes=("12 samples are repeated; they were left out", "joint 7 hardly moves"),
        curves=(shown,),
        rollouts=(rollout(shown),),
        model_out="nominal+coulomb_friction.json",
        what_next=(COULOMB.split_by,),
        wall_s=21.4,
    )  # fmt: skip


def pair() -> GapResult:
    """Coulomb friction, and a payload from 12.3 s on, over two recordings."""
    base = one_finding()
    both = (curves(), curves(seconds=8.0, name="again.mcap"))
    return replace(
        base, findings=(COULOMB, PAYLOAD), recordings=("shelf.mcap", "again.mcap"), curves=both
    )


def unexplained() -> GapResult:
    """Something on joint 3 that follows its velocity, beside a finding."""
    left = Leftover(3, 0.3, NOISE_NM, ("dq3", "q1"), (0.0, LONG_S))
    return replace(one_finding(), findings=(), unexplained=(left,), model_out=None)


def nothing() -> GapResult:
    """Nothing is missing."""
    level = errors([NOISE_NM] * 7)
    return replace(
        one_finding(), findings=(), before=level, after=level, rollouts=(), corrections=None,
        curves=leaving(NOISE_NM, NOISE_NM),
        what_next=(), notes=(), model_out=None,
    )  # fmt: skip


def problem() -> GapResult:
    """Nothing could be told."""
    unknown = errors([np.nan] * 7)
    return replace(
        nothing(),
        before=unknown,
        after=unknown,
        noise_floor_nm=np.full(7, np.nan),
        problem="joints 1 to 7 hardly move; move each over 0.5 rad and more than 0.2 rad/s.",
        what_next=("move every joint",),
        curves=(),
    )


def two_joints() -> GapResult:
    """An arm of two joints whose rollouts failed, with a delay of all."""
    shown = curves(2)
    nan = [np.nan, np.nan]
    delay = finding("signal_delay", (), {"d": 0.0021}, {"d": 0.0001}, torque_rms_nm=np.ones(2))
    return GapResult(
        ("shoulder", "elbow"),
        "planar",
        ("a.mcap",),
        "planar.urdf",
        np.full(2, NOISE_NM),
        errors([0.9, 0.05], nan),
        errors([0.03, 0.02], nan),
        findings=(delay,),
        curves=(shown,),
        rollouts=(RolloutCurves(shown.t, shown.q, np.nan * shown.q, np.nan * shown.q),),
    )


def many() -> GapResult:
    """A real arm: friction of two kinds on most joints, an offset, something left on two."""
    fc = (0.27, 0.20, 0.14, 0.45, 0.30, 0.15, 0.25)
    std = {"Fc": 0.011}
    found = [finding("coulomb_friction", (j,), {"Fc": x}, std) for j, x in enumerate(fc, 1)]
    found += [finding("viscous_friction", (j,), {"Fv": 0.1 * j}, {"Fv": 0.02}) for j in (1, 2, 4)]
    found.append(finding("torque_offset", (2,), {"o": -0.31}, {"o": 0.02}))
    found.append(
        finding("link_inertia", (5,), {"dtheta": [0.3, *[0.01] * 9]}, {"dtheta": [0.02] * 10},
                torque_rms_nm=np.full(7, 0.01))
    )  # fmt: skip
    wrench = dict.fromkeys(("fx", "fy", "fz", "mx", "my", "mz"), 3.0)
    doubt = dict.fromkeys(wrench, 0.2)
    worth = np.full(7, 0.005)
    found.append(
        finding(
            "external_wrench", (), wrench, doubt, (3.1, 4.6), lasting=False, torque_rms_nm=worth
        )
    )
    left = tuple(Leftover(j, 0.1 * j, 0.03, ("q2", "t"), (0.0, LONG_S)) for j in (3, 6))
    before = errors([0.28, 0.77, 0.37, 0.58, 0.34, 0.21, 0.28])
    after = errors([0.23, 0.29, 0.19, 0.28, 0.10, 0.07, 0.07])
    told = replace(one_finding(), findings=tuple(found), unexplained=left, rollouts=())
    return replace(told, before=before, after=after)
