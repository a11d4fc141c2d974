"""Torque limits, dead bands, backlash, static friction of position-controlled arms: named?

    python tests/benchmarks/servo_limit_trials.py KIND [--seeds 12] [--first 0] [--json FILE]

KIND is limit, dead, backlash or stiction. Each seed is a simulated Panda of `servo_trials.py` with
one such effect in two joints: a dead band of 2 to 10 mrad, backlash of 2 to 20 mrad, friction that
is 1.3 to 2.5 times Coulomb's at rest (an e-th of it left at 0.03 to 0.3 rad/s), or a torque limit
between what sines ask for in 60 % of time and the most that they ask for. Joints whose limit acts
in less than a hundredth of the readings are not counted.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from adapter.effects.robots import read_robot
from adapter.gap.servo import explain
from tests.helpers.benchmark import options, write
from tests.helpers.position_arm import Drawn, PositionArm, as_log, errors, named, position_arm

EFFECTS = {
    "limit": "servo_torque_limit",
    "dead": "servo_dead_band",
    "backlash": "backlash",
    "stiction": "static_friction",
}


def asked(arm: PositionArm, seed: int) -> np.ndarray:
    """(m, n) N m, what both gains ask for as its sines are read, by the command that acts then."""
    servos, period = replace(arm.servos, noise_rad=0.0), arm.drawn.period_s
    moved = replace(arm, servos=servos).moved("sines", seed)
    late = int(np.ceil(servos.delay_s / period - 1e-9))
    goal = np.concatenate([moved.q_command[:1]] * late + [moved.q_command])[: len(moved.q)]
    fed = np.diff(goal, axis=0, prepend=goal[:1]) / period * servos.feeds_speed
    rate = fed - np.gradient(moved.q, period, axis=0)
    return np.abs(servos.kp * (goal - moved.q) + servos.kd * rate)


def drawn(kind: str, seed: int) -> tuple[PositionArm, list[int]]:
    """An arm with the effect, and its joints (from 1)."""
    rng = np.random.default_rng(9000 + seed)
    period, noise = float(rng.choice([2e-3, 4e-3, 5e-3, 10e-3])), 10.0 ** rng.uniform(-5.0, -4.0)
    arm = position_arm(seed, Drawn(20.0, period, float(noise), feeds_speed=seed % 2 == 0))
    joints = rng.permutation(arm.truth.n)[:2]
    if kind == "limit":
        low, high = np.quantile(free := asked(arm, seed), 0.6, axis=0), free.max(axis=0)
        sizes = low + rng.uniform(0.2, 0.8, arm.truth.n) * (high - low)
    elif kind == "stiction":
        sizes = arm.servos.coulomb * rng.uniform(0.3, 1.5, arm.truth.n)
    else:
        most = {"dead": -2.0, "backlash": np.log10(0.02)}[kind]
        sizes = 10.0 ** rng.uniform(np.log10(2e-3), most, arm.truth.n)
    values = np.array(getattr(arm.servos, kind))
    values[joints] = sizes[joints]
    changed: dict[str, Any] = {kind: values}
    if kind == "stiction":
        changed["slip"] = 10.0 ** rng.uniform(np.log10(0.03), np.log10(0.3), arm.truth.n)
    return replace(arm, servos=replace(arm.servos, **changed)), (joints + 1).tolist()


def main() -> None:
    parser = options(__doc__, seeds=12, first=0)
    parser.add_argument("kind", choices=tuple(EFFECTS))
    args = parser.parse_args()
    panda, effect, rows = read_robot("panda"), EFFECTS[args.kind], []
    for seed in range(args.first, args.first + args.seeds):
        arm, joints = drawn(args.kind, seed)
        if args.kind == "limit":
            reached = (asked(arm, seed) > arm.servos.limit).mean(axis=0) > 0.01
            joints = [j for j in joints if reached[j - 1]]
        gap = explain([as_log(arm.moved("sines", seed))], panda)
        told, off = named(gap), errors(gap, arm).get(effect, np.zeros(0))
        of = next((f.joints for f in gap.findings if f.effect == effect), ())
        close = sum(abs(x) < 0.1 for j, x in zip(of, off, strict=True) if j in joints)
        right = len(told & {(effect, j) for j in joints})
        wrong = sorted(told - arm.expected)
        others = {(e, j) for e, j in arm.expected if e != effect}
        rows.append((right, len(joints), close, len(wrong), len(told & others), len(others)))
        write(args.json, rows)
        print(
            f"seed {seed}: {right} of {len(joints)}, within 10 % {close}, wrong {wrong}", flush=True
        )
    total = np.array(rows).sum(axis=0)
    print(
        f"{args.kind}: named {total[0]} of {total[1]}, within 10 % {total[2]}, wrong names "
        f"{total[3]}; the servos' other numbers {total[4]} of {total[5]}"
    )


if __name__ == "__main__":
    main()
