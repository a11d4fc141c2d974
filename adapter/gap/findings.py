"""From a fit to what people and files are told: parameters, deviations, rivals, what is left."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from adapter.effects.active import WHOLE
from adapter.effects.base import ALL, JOINT, LINK, TWO_LEVELS
from adapter.effects.catalogue import HELD, KNOWN, WRONG_LINK
from adapter.effects.law import SIGNALS, OverSignals
from adapter.effects.phrases import experiments
from adapter.gap.candidates import Pattern, prior_log_odds, signal_of
from adapter.gap.evidence import Carried, Moments, score
from adapter.gap.fit import Fit, Named, honest_covariance, place_of
from adapter.gap.laws import in_doubt
from adapter.gap.real_arm import OFFSET, SPRING
from adapter.gap.result import Curves, Finding, Leftover
from adapter.gap.rivals import Rival, Standing
from adapter.gap.search import Found, from_the_start
from adapter.judgement.noise import LEAST_NM
from adapter.model.posterior import Label, Posterior, root_of
from adapter.model.spatial import Array
from adapter.screening.readings import rms

ODD = 4.0  # standard deviations from which on a correction is a finding
DISCREPANCY = 0.12  # of a finding's torque: what is below that is its equation's inexactness
OUTBURST_S, OUTBURST = 1.0, 5.0  # windows; how many times louder than usual
SMOOTH, BEFORE = 3.5, 6  # level of a residual over what so many samples before do not foretell
FOLLOWS = 0.05  # share of its power that a signal must explain to be named
FEW_ROWS, FEW_SPANS = 12, 5
VISIBLE = 1.05  # by which what is left must exceed the noise to be worth a word


def _joints(named: Named) -> list[int]:
    scope = named.candidate.effect.scope
    own = scope in (JOINT, LINK) or (scope == ALL and named.candidate.joint >= 0)
    return [named.candidate.joint + 1] if own else []


def entries(
    fit: Fit, recording: int | None = None, known: Carried | Moments | None = None
) -> list[dict[str, Any]]:
    """Entries of a model file for the named effects of the catalogue.

    What was assumed and is as no arm has it (without some blocks of the data, say) is not there.

    Args:
        recording: of several, whose own effects are among them; None: what is common alone.
        known: of the coefficients, for standard deviations.
    """
    out, alone, covariance = [], len(fit.recordings) == 1, None
    if known is not None:
        fit, covariance = _doubts(fit, known)
    for k, named in enumerate(fit.named):
        here = alone or named.recording in (None, recording)
        here &= not named.assumed or named.possible
        if here and not isinstance(named.candidate.effect, Pattern):
            begin, end = (None if not np.isfinite(x) else float(x) for x in named.interval_s)
            out.append(
                {
                    "effect": named.candidate.effect.in_files or named.candidate.effect.name,
                    "joints": _joints(named),
                    "interval_s": None if begin is None and end is None else [begin, end],
                    "parameters": named.values,
                    "units": named.candidate.units,
                }
            )
            if covariance is not None:
                out[-1]["std"] = parameter_std(fit, covariance, k)
    return out


def _doubts(fit: Fit, known: Carried | Moments) -> tuple[Fit, Array]:
    """A fit whose laws' settings are free, too, and the covariance of its coefficients."""
    free = in_doubt(fit)
    if free is fit or isinstance(known, Moments):
        return fit, honest_covariance(fit, known)
    return free, honest_covariance(free, free.carried())


def posterior_of(fit: Fit, known: Carried | Moments) -> Posterior:
    """What is known of a fit's inertias and of its effects' numbers together.

    What lies on a grid, and whole inertias of bodies, have standard deviations of their own alone.
    Where a weak spring rests is no Gaussian's; what it adds at zero is, and counts to the offset.
    """
    fit, covariance = _doubts(fit, known)
    size = fit.dtheta.size
    labels, least, rows = [], [], [*np.eye(size, len(covariance))]
    at_zero: dict[Label, Array] = {}
    for k, named in enumerate(fit.named):
        effect, values = named.candidate.effect, named.values
        on_grid = {p.key for p in effect.parameters if p.grid_share}
        own, place = np.zeros((_flat(values).size, len(covariance))), 0
        own[:, place_of(fit, k)] = _slopes(_flat, fit, k).T
        for key, value in values.items():
            if np.ndim(value) == 0 and key not in on_grid:
                joint = next(iter(_joints(named)), 0)
                labels.append((effect.in_files or effect.name, joint, key))
                least.append(0.0 if key in effect.positive else -np.inf)
                rows.append(own[place])
            place += np.size(value)
        if effect is SPRING:  # k (q - q0), told with q0 as it is
            slopes = _slopes(lambda x: np.array([x["k"], x["k"] * x["q0"]]), fit, k)
            offset = OFFSET.name, labels[-1][1], "o"
            at_zero[offset] = np.zeros(len(covariance))
            at_zero[offset][place_of(fit, k)] = slopes @ [values["q0"], -1.0]
            rows[-1] = 0.0 * rows[-1]
    for k, label in enumerate(labels):
        rows[size + k] = rows[size + k] + at_zero.get(label, 0.0)
    way = np.array(rows)
    root = root_of(way @ covariance @ way.T, len(way))
    frames = np.zeros((fit.n, 6, 6))
    return Posterior(tuple(labels), np.array(least), root, np.zeros_like(fit.dtheta), frames)


def _curve(fit: Fit, covariance: Array, k: int) -> dict[str, Any] | None:
    """A law's torque over the range of its signal that was seen, and its standard deviation."""
    named, law = fit.named[k], fit.named[k].candidate.effect
    if not isinstance(law, OverSignals):
        return None
    joint, at = law.by - 1 if law.by else named.candidate.joint, fit.model.stages(0)
    seen = signal_of(law.along, at.links, at.rigid, joint)
    x = np.linspace(seen.min(), seen.max(), 41)  # of a law over its signal
    std = _std_of(lambda values: law.curve(x, values), fit, covariance, k)
    torque = law.curve(x, named.values)
    return {"over": f"{law.along}{joint + 1}", "at": x, "torque_nm": torque, "std_nm": std}


def parameter_std(fit: Fit, covariance: Array, k: int) -> dict[str, Any]:
    """Standard deviations of the parameters of the k-th named effect, through its decoding."""
    named, deviations = fit.named[k], _std_of(_flat, fit, covariance, k)
    std, place = {}, 0
    on_grid = {p.key: p.grid_share for p in named.candidate.effect.parameters if p.grid_share}
    for key, value in named.values.items():
        size = np.size(value)
        part = deviations[place : place + size]
        std[key] = float(part[0]) if np.ndim(value) == 0 else [float(x) for x in part]
        if key in on_grid:
            std[key] = on_grid[key] * abs(float(value))
        place += size
    return std


def _std_of(
    of_values: Callable[[dict[str, Any]], Array], fit: Fit, covariance: Array, k: int
) -> Array:
    """Standard deviations (p,) of what hangs on the parameters of the k-th named effect."""
    own, slopes = place_of(fit, k), _slopes(of_values, fit, k)
    return np.sqrt(np.einsum("ip,ij,jp->p", slopes, covariance[np.ix_(own, own)], slopes))


def _slopes(of_values: Callable[[dict[str, Any]], Array], fit: Fit, k: int) -> Array:
    """(c, p) of what hangs on the parameters of the k-th named effect, by its coefficients."""
    named = fit.named[k]
    decode, steps = named.candidate.template.decode, 1e-4 * named.candidate.prior_std  # of a prior
    at = of_values(named.values)
    pairs = zip(steps, np.eye(len(named.x)), strict=True)
    return np.array([(of_values(decode(named.x + d * unit)) - at) / d for d, unit in pairs])


def _flat(values: dict[str, Any]) -> Array:
    return np.concatenate([np.atleast_1d(np.asarray(v, dtype=float)) for v in values.values()])


def told_of(
    found: Found, ends: Mapping[str, float], trusted: Array
) -> tuple[tuple[Finding, ...], tuple[Leftover, ...]]:
    """Effects that the model lacks, and what no effect explains.

    Args:
        found: of the search; ends: recordings by name -> s, when each ends.
        trusted: (n, 10) standard deviation of the model's inertias as they were believed.
    """
    # of each joint one entry: patterns, else what happens but once
    first_end_s = next(iter(ends.values()))
    kept = {x.joint: x for x in _patterns_left(found, first_end_s)}
    for leftover in (*_outbursts(found.fit), *_too_smooth(found.fit, first_end_s)):
        kept.setdefault(leftover.joint, leftover)
    left = tuple(kept[joint] for joint in sorted(kept))
    findings = *findings_of(found, ends), *corrected_links(found, max(ends.values()), trusted)
    return doubted(sorted(findings, key=lambda f: -f.detectability), left), left


def corrected_links(found: Found, end_s: float, trusted: Array) -> list[Finding]:
    """Links whose inertias were corrected by more than they were believed to be wrong.

    Only those that the data single out: torques that one link's error explains, another's does
    too. What the hand holds is not told again as a heavier last link.
    """
    fit, known = found.fit, found.known or found.carried
    odd = np.abs(fit.dtheta / trusted).max(axis=1) > ODD
    odd[-1] &= not any(e.candidate.effect is HELD for e in fit.named)
    odd[[e.candidate.joint for e in fit.named if e.candidate.effect is WRONG_LINK]] = False
    gains = {int(k): _gain_of_link(fit, known, int(k), trusted) for k in np.flatnonzero(odd)}
    odds = prior_log_odds(WRONG_LINK, 0, len(odd), 1)  # what the search asks of the name
    wrong = sum(e.candidate.effect is WRONG_LINK for e in fit.named)
    wrong += sum(gain + odds > 0.0 for gain in gains.values())
    if wrong > 1:  # one wrong link says nothing of the others, several: the whole model is poor
        odds = max(odds, float(np.log((wrong - 1) / len(odd))))
    told = [_wrong_link(fit, known, k, end_s, gain + odds) for k, gain in gains.items()]
    return [f for f in told if f.evidence > 0.9]  # probability of a link's correction


def _gain_of_link(fit: Fit, known: Carried | Moments, k: int, trusted: Array) -> float:
    """nats by which the data want the k-th link's correction, before the odds of its name."""
    own, std = np.arange(10 * k, 10 * k + 10), known.prior_std.copy()
    std[own] = trusted[k]
    gain = score(known.G, known.g, known.prior_std).log_evidence
    gain -= score(known.G, known.g, std).log_evidence
    covariance = np.diagonal(honest_covariance(fit, known))[own]
    return float(gain / np.max(covariance / np.diagonal(known.covariance())[own]))


def _wrong_link(
    fit: Fit, known: Carried | Moments, k: int, end_s: float, log_odds: float
) -> Finding:
    """The correction of the k-th link as a finding."""
    own, size = np.arange(10 * k, 10 * k + 10), len(known.prior_std)
    covariance = honest_covariance(fit, known)[np.ix_(own, own)]
    torque = np.tensordot(fit.dtheta[k], fit.recordings[0].low_regressor[own], 1)
    key = WRONG_LINK.parameters[0].key
    return Finding(
        effect=WRONG_LINK.name,
        title=WRONG_LINK.title,
        joints=(k + 1,),
        interval_s=(0.0, end_s),
        lasting=True,
        parameters={key: [float(x) for x in fit.dtheta[k]]},
        std={key: [float(x) for x in np.sqrt(np.diagonal(covariance))]},
        units=WRONG_LINK.units(),
        evidence=float(1.0 / (1.0 + np.exp(-np.clip(log_odds, -700.0, 700.0)))),
        overlaps={},
        split_by="; ".join(experiments(WRONG_LINK, [])),
        detectability=float(np.sqrt(known.worth(own, np.delete(np.arange(size), own)).chi2)),
        torque_rms_nm=np.sqrt(np.mean(torque**2, axis=0)),
    )


def findings_of(found: Found, ends: Mapping[str, float]) -> tuple[Finding, ...]:
    """Every named effect of the catalogue. `ends`: recordings by name -> s, when each ends."""
    fit, covariance = _doubts(found.fit, found.known or found.carried)
    # of an offset that is there but has no name, its friction may be asymmetric in its place
    shifted = {
        e.candidate.joint
        for e, standing in zip(fit.named, found.standings, strict=True)
        if e.candidate.effect is OFFSET and standing.chi2 > 4.0  # two standard deviations
    }
    out = []
    for k, (named, standing) in enumerate(zip(fit.named, found.standings, strict=True)):
        effect = standing.candidate.effect
        if isinstance(effect, Pattern) or k in found.weak:
            continue
        recording = named.recording or 0
        own, (name, last) = named.recording is not None, list(ends.items())[recording]
        begin, end = named.interval_s
        torque = fit.model.contribution(recording, k)
        t = fit.recordings[recording].t
        on = (t >= begin) & (t < end)
        overlaps = _overlaps(standing, named.candidate.joint in shifted)
        keys = [p.key for p in effect.parameters]
        values = {key: x for key, x in named.values.items() if key in keys}
        spread, evidence = parameter_std(fit, covariance, k), standing.probability
        spread = {key: std for key, std in spread.items() if key in keys}
        if from_the_start(named):  # that it is there, whatever else could stand for it
            evidence = math.erf(named.values["m"] / spread["m"] / math.sqrt(2.0))
        out.append(
            Finding(
                effect=effect.name,
                title=effect.title,
                joints=tuple(_joints(named)),
                interval_s=(max(begin, 0.0), min(end, last)),
                lasting=not np.isfinite(end),
                parameters=values,
                std=spread,
                units=named.candidate.units,
                evidence=evidence,
                overlaps=overlaps,
                split_by="; ".join(experiments(effect, [KNOWN[x] for x in overlaps])),
                detectability=float(np.sqrt(standing.chi2)),
                torque_rms_nm=np.sqrt(np.mean(torque[on] ** 2, axis=0)),
                recording=name if own and len(ends) > 1 else "",
                curve=_curve(fit, covariance, k),
            )
        )
    return tuple(sorted(_with_rests(fit, out), key=lambda f: -f.detectability))


def _with_rests(fit: Fit, findings: list[Finding]) -> list[Finding]:
    """Springs that rest where the offset of their joint says, which is not told beside them.

    What any arm has are springs that rest at zero, and offsets (`real_arm`).
    """
    named = [e.candidate for e in fit.named if e.assumed]
    at_zero = {(c.joint + 1,) for c in named if c.effect is SPRING}
    springs = {_where(f) for f in findings if f.effect == SPRING.name and f.joints in at_zero}
    offsets = {_where(f): f for f in findings if f.effect == OFFSET.name and _where(f) in springs}
    rest = [f for f in findings if f.effect != OFFSET.name or _where(f) not in offsets]
    return [
        _resting(f, offsets[_where(f)]) if f.effect == SPRING.name and _where(f) in offsets else f
        for f in rest
    ]


def _where(finding: Finding) -> tuple[tuple[int, ...], tuple[float, float]]:
    return finding.joints, finding.interval_s


def _resting(spring: Finding, offset: Finding) -> Finding:
    """A spring and an offset as one spring."""
    k, o = spring.parameters["k"], offset.parameters["o"]
    std = math.hypot(offset.std["o"], o / k * spring.std["k"]) / abs(k)
    parameters = {**spring.parameters, "q0": spring.parameters["q0"] - o / k}
    return replace(spring, parameters=parameters, std={**spring.std, "q0": std})


def _overlaps(standing: Standing, shifted: bool) -> dict[str, float]:
    """Other names that explain 0.9 and more of the signature, best first.

    `shifted`: whether an offset of the same joint was named beside it.
    """
    best: dict[str, float] = {}
    for rival in standing.rivals:
        effect = rival.candidate.effect
        if isinstance(effect, Pattern) or effect.name == standing.candidate.effect.name:
            continue
        if rival.overlap >= 0.9 and _is_open(standing, rival, shifted):
            best[effect.name] = max(best.get(effect.name, 0.0), min(rival.overlap, 1.0))
    # of rivals that explain all but the same, those that the data favour come first
    credible = {r.candidate.effect.name: -i for i, r in enumerate(standing.rivals[::-1])}
    order = sorted(best, key=lambda name: (-round(best[name], 2), credible.get(name, 0)))
    return {name: best[name] for name in order[:3]}  # the likeliest


def _is_open(standing: Standing, rival: Rival, shifted: bool) -> bool:
    """Whether the data leave a rival open that is a finer form of the named effect or a coarser.

    Friction and an offset of the same joint are asymmetric friction in other words.
    """
    mine, other = standing.candidate.effect, rival.candidate.effect
    nested = mine.form in dict(other.simpler) or other.form in dict(mine.simpler)
    if not nested or (shifted and other.form == TWO_LEVELS):
        return True
    return rival.log_evidence > standing.log_evidence - 3.0  # nats: it is open


def noise_floor(fit: Fit) -> Array:
    """(n,) rms in the band of what is left when all is explained that can be, N m."""
    left = np.concatenate(fit.model.residuals())
    levels = [noise.level for noise in fit.noise]
    return np.minimum(np.max(levels, axis=0), np.sqrt(np.mean(left**2, axis=0)))


def _too_smooth(fit: Fit, end_s: float) -> list[Leftover]:
    """Joints whose residual the samples before it foretell too well to be noise.

    Disturbances are slow too, but not by so much; memory, as hysteresis has it, is.
    """
    out = []
    level, residual, slides = fit.noise[0].level, fit.model.residual(0), fit.recordings[0].slides
    motion = fit.recordings[0].motion
    rows = np.searchsorted(motion.t, fit.recordings[0].t - 1e-9)
    for j in range(fit.n):
        lagged = np.lib.stride_tricks.sliding_window_view(residual[:, j], BEFORE + 1)
        throughout = np.lib.stride_tricks.sliding_window_view(slides[:, j], BEFORE + 1).all(axis=1)
        if throughout.sum() < FEW_ROWS:
            continue
        before, now = lagged[throughout, :-1], lagged[throughout, -1]
        surprise = rms(now - before @ np.linalg.lstsq(before, now, rcond=None)[0])
        if level[j] < SMOOTH * surprise:
            continue
        signals = {f"{key}{j + 1}": getattr(motion, key)[rows, j] for key in ("q", "dq", "ddq")}
        on = slides[:, j]
        shares = {name: explained(residual[on, j], x[on]) for name, x in signals.items()}
        follows = sorted((x for x in shares if shares[x] > FOLLOWS), key=lambda x: -shares[x])
        size = rms(residual[on, j])
        if size < DISCREPANCY * _idealised(fit, j):
            continue
        names = tuple(follows) or (f"q{j + 1}", "t")
        out.append(Leftover(j + 1, size, min(surprise, size), names, (0.0, end_s)))
    return out


def _outbursts(fit: Fit) -> list[Leftover]:
    """Joints whose residual is much larger for a while than it is usually."""
    out = []
    t, residual = fit.recordings[0].t, fit.model.residual(0)
    counted = fit.recordings[0].slides
    counted = counted & np.isfinite(fit.doubts[0]) if fit.doubts else counted
    window = (t // OUTBURST_S).astype(int)
    for j in range(fit.n):
        rows = counted[:, j]
        spans = [w for w in np.unique(window[rows]) if np.sum(rows & (window == w)) >= FEW_ROWS]
        sizes = [rms(residual[rows & (window == w), j]) for w in spans]
        if len(sizes) < FEW_SPANS:
            continue
        usual, worst = float(np.median(sizes)), int(np.argmax(sizes))
        if sizes[worst] > OUTBURST * usual:
            loud = [w for w, x in zip(spans, sizes, strict=True) if x > 0.5 * sizes[worst]]
            interval = (OUTBURST_S * min(loud), OUTBURST_S * (max(loud) + 1))
            out.append(Leftover(j + 1, sizes[worst], usual, ("t",), interval))
    return out


def doubted(findings: Sequence[Finding], leftovers: Sequence[Leftover]) -> tuple[Finding, ...]:
    """Findings whose joint holds something unexplained as well are believed the less."""
    power = {x.joint: max(x.rmse_nm**2 - x.noise_floor_nm**2, 0.0) for x in leftovers}
    out = []
    for f in findings:
        for joint in f.joints:
            mine = float(f.torque_rms_nm[joint - 1]) ** 2
            left = power.get(joint, 0.0)
            f = replace(f, evidence=f.evidence * mine / (mine + left) if mine else f.evidence)
        out.append(f)
    return tuple(out)


def _patterns_left(found: Found, end_s: float) -> tuple[Leftover, ...]:
    """What patterns found, on each joint that is not merely its named effects' inexactness."""
    fit, out = found.fit, []
    for j in range(fit.n):
        own = [k for k, e in enumerate(fit.named) if e.is_pattern and e.candidate.joint == j]
        if not own:
            continue
        parts = [fit.model.contribution(0, k)[:, j] for k in own]
        left, pattern = fit.model.residual(0)[:, j], np.sum(parts, axis=0)
        floor, rmse = rms(left), rms(left + pattern)
        if rmse < VISIBLE * floor or rms(pattern) < DISCREPANCY * _idealised(fit, j):
            continue
        order = np.argsort([-np.mean(part**2) for part in parts])
        signals = [s for i in order for s in fit.named[own[i]].candidate.effect.depends_on]
        dated = (fit.named[k].interval_s for k in own)
        begin, end = next((x for x in dated if x != WHOLE), WHOLE)
        interval = max(begin, 0.0), min(end, end_s)
        out.append(Leftover(j + 1, rmse, floor, tuple(dict.fromkeys(signals)), interval))
    return tuple(out)


def _idealised(fit: Fit, joint: int) -> float:
    """Torque on a joint (from 0) of the largest named effect that is an idealisation, N m rms."""
    return max(
        (
            rms(fit.model.contribution(e.recording or 0, k)[:, joint])
            for k, e in enumerate(fit.named)
            if e.candidate.effect.inexact
        ),
        default=0.0,
    )


BINS = 12


def disagreement(curves: Curves, noise_floor_nm: Array) -> tuple[dict[str, Any], ...]:
    """Of the nominal model, joint by joint.

    Returns:
        One entry a joint (from 1): `rmse_nm`, `times_noise`, and `follows`: the share of the
        residual's power that its mean by velocity, position, acceleration, load (the joint's
        own) and time explains, beyond what as many bins of pure noise would.
    """
    out = []
    for j in range(curves.before.shape[1]):
        residual = curves.before[:, j]
        rmse = rms(residual)
        signals = {f"{name}{j + 1}": getattr(curves, name)[:, j] for name in SIGNALS}
        signals["t"] = curves.t
        shares = {name: explained(residual, x) for name, x in signals.items()}
        out.append(
            {
                "joint": j + 1,
                "rmse_nm": rmse,
                "times_noise": rmse / max(float(noise_floor_nm[j]), LEAST_NM),
                "follows": dict(sorted(shares.items(), key=lambda pair: -pair[1])),
            }
        )
    return tuple(out)


def explained(residual: Array, x: Array) -> float:
    """Share of the power of a residual (k,) in its means over bins of x (k,), noise discounted."""
    order = np.argsort(x, kind="stable")
    parts = np.array_split(residual[order], BINS)
    between = sum(len(p) * float(p.mean()) ** 2 for p in parts)
    whole = float(residual @ residual)
    if not whole > 0.0:
        return 0.0
    by_chance = BINS * (whole - between) / max(len(residual) - BINS, 1)
    return float(np.clip((between - by_chance) / whole, 0.0, 1.0))
