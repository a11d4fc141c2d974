"""Gains of current-driven joints: simulated ones with a known mass and without, over seeds.

    python tests/benchmarks/gain_trials.py [--seeds 12] [--seconds 30] [--json FILE]

Prints the largest error of the six gains of every seed, in %, and how far it lies in standard
deviations; then the same against the documented masses alone, whose scale is hidden.
"""

from __future__ import annotations

import numpy as np

from adapter.gap.torque_gains import learn_gains
from tests.helpers.benchmark import options, write
from tests.helpers.driven_arm import LOAD_KG, currents, driven_arm, six_joints


def main() -> None:
    args = options(__doc__, seeds=12, seconds=30.0).parse_args()
    worst = []
    for seed in range(args.seeds):
        hidden = driven_arm(seed)
        bare = currents(hidden, seed, args.seconds)
        loaded = currents(hidden, seed + 100, args.seconds, LOAD_KG)
        known = learn_gains([bare, loaded], six_joints(), (False, True), LOAD_KG)
        alone = learn_gains([bare], six_joints())
        off = 100.0 * (known.gain / hidden.gain - 1.0)
        z = (known.gain - hidden.gain) / known.std
        other = 100.0 * (alone.gain / hidden.gain - 1.0)[alone.shown]
        worst.append(np.abs(off).max())
        print(
            f"seed {seed}: known mass {worst[-1]:.2f} % (z {np.abs(z).max():.1f}); masses "
            f"{100.0 * (hidden.scale - 1.0):+.1f} % off: gains alone {np.mean(other):+.1f} %, "
            f"{alone.shown.sum()} of {len(off)} shown, scale open: {alone.load_kg is None}",
            flush=True,
        )
    write(args.json, worst)
    print(f"known mass: worst {max(worst):.2f} %, within 2 %: {sum(x < 2.0 for x in worst)}")


if __name__ == "__main__":
    main()
