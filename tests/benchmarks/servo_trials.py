"""Position-controlled arms without torque: servos named, their numbers, unseen motion; and nulls.

    python tests/benchmarks/servo_trials.py [--seeds 12] [--first 0] [--seconds 20] [--json FILE]

Each seed is a simulated Panda with its own servos, delay, friction and armature, as documented and
with bodies 2 % off. It is fitted on sines and foretells a motion from point to point; then its true
servos are given as documentation, and nothing is to be named. MuJoCo alone steps the MJCF that
`adapter export` writes of the fitted servos: its error on that motion, over our simulation's.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adapter.effects.robots import read_robot
from adapter.gap.servo import explain
from adapter.gap.servo_files import servo_mjcf
from adapter.gap.servo_signals import Track
from adapter.model.self_model import Limits
from tests.helpers.benchmark import options, write
from tests.helpers.position_arm import Drawn, as_log, errors, named, position_arm
from tests.helpers.position_mujoco import error_in_mujoco


def main() -> None:
    args = options(__doc__, seeds=12, first=0, seconds=20.0).parse_args()
    panda, rows = read_robot("panda"), []
    free = replace(panda, limits=Limits.unknown(panda.tree.n))  # as the simulated motors are
    for seed in range(args.first, args.first + args.seeds):
        rng = np.random.default_rng(1000 + seed)
        period = float(rng.choice([2e-3, 4e-3, 5e-3, 10e-3]))
        noise = float(10.0 ** rng.uniform(-5.0, -4.0))
        base = Drawn(args.seconds, period, noise, feeds_speed=seed % 2 == 0)
        for drawn in (base, replace(base, masses_off=0.02)):
            arm = position_arm(seed, drawn)
            seen = as_log(arm.moved("sines", seed))
            unseen = as_log(arm.moved("points", 500 + seed))
            gap = explain([seen], panda, None, [unseen])
            null = explain([seen], panda, arm.documentation, [unseen])
            start = Track.of(unseen).start
            there = error_in_mujoco(servo_mjcf(free, gap.servos).text, unseen, start) / gap.after
            off = errors(gap, arm)
            worst = {effect: np.abs(error).max() for effect, error in off.items()}
            within = sum(int((np.abs(error) < 0.1).sum()) for error in off.values())
            names = (
                len(named(gap) & arm.expected),
                len(arm.expected),
                len(named(gap) - arm.expected),
            )
            motion = float(gap.before.max()), float(gap.after.max())
            last = len(null.findings), float(there.max())
            rows.append((drawn.masses_off > 0.0, *names, within, *motion, *last))
            write(args.json, rows)
            told = ", ".join(f"{e} {100.0 * x:.1f} %" for e, x in worst.items())
            print(
                f"seed {seed}, masses {'2 % off' if rows[-1][0] else 'right'}, {1 / period:.0f} Hz,"
                f" {1e3 * noise:.2f} mrad: named {rows[-1][1]} of {rows[-1][2]}, wrong "
                f"{rows[-1][3]}, within 10 % {within}; worst {told}; unseen "
                f"{1e3 * rows[-1][5]:.1f} -> {1e3 * rows[-1][6]:.3f} mrad; null names "
                f"{rows[-1][7]}; MuJoCo's error over ours {there.max():.2f}",
                flush=True,
            )
    for wrong in (False, True):
        part = np.array([row[1:] for row in rows if row[0] == wrong])
        total = part.sum(axis=0)
        print(
            f"masses {'2 % off' if wrong else 'right'}: named {total[0]:.0f} of {total[1]:.0f}, "
            f"wrong {total[2]:.0f}, within 10 % {total[3]:.0f}; unseen motion, worst joint: median "
            f"{1e3 * np.median(part[:, 5]):.3f}, worst {1e3 * part[:, 5].max():.3f} mrad (before "
            f"{1e3 * np.median(part[:, 4]):.1f}); nulls with a name "
            f"{(part[:, 6] > 0).sum()} of {len(part)}; MuJoCo's error over ours, worst "
            f"joint: median {np.median(part[:, 7]):.2f}, worst {part[:, 7].max():.2f}"
        )


if __name__ == "__main__":
    main()
