"""A real servo arm's motions, each foretold by its commands from servos fitted on a few of them.

    python tests/benchmarks/sage_trials.py FOLDER --robot so101.urdf --fit multisine,figure_eight

FOLDER holds one folder of SAGE for each motion (`shared/data/so101_sage`). Told are rms tracking
errors by joint, mrad, as commanded and as foretold; a joint counts where the second is below a
quarter of the first or below 4 mrad. Behind: the error of MuJoCo alone, stepping what `adapter
export` writes of the servos, over that of our simulation.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from adapter.cli import main as adapter
from adapter.effects.robots import read_robot
from adapter.gap.servo import explain
from adapter.gap.servo_files import servo_mjcf
from adapter.gap.servo_model import ServoModel
from adapter.gap.servo_signals import Track
from adapter.gap.servo_words import headline
from adapter.physics.rigid_arm import RigidArm
from adapter.report.servo_page import CLOSE_MRAD, SHARE
from drivers.files.mcap import read_position_log
from tests.helpers.position_mujoco import error_in_mujoco


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--robot", type=Path, required=True)
    parser.add_argument("--fit", default="multisine,figure_eight")
    args = parser.parse_args()
    model, logs = read_robot(str(args.robot)), {}
    names = model.tree.joint_names
    with tempfile.TemporaryDirectory() as folder:
        for motion in sorted(path for path in args.folder.iterdir() if path.is_dir()):
            log = Path(folder) / f"{motion.name}.mcap"
            words = ["import", str(motion), "--to", str(log), "--robot", str(args.robot)]
            assert adapter(words) == 0, motion
            found = read_position_log(log)
            assert found is not None, motion
            logs[motion.name] = found.select(names)
        begun = time.process_time()
        gap = explain([logs[name] for name in args.fit.split(",")], model)
        print(f"{headline(gap)}\n{time.process_time() - begun:.0f} s of processor time")
        arm, close, written = RigidArm.of(model), [], servo_mjcf(model, gap.servos).text
        for name, own in logs.items():
            track = Track.of(own)
            before, after = (
                1e3 * servos.tracking_error(track, arm)
                for servos in (ServoModel.ideal(names), gap.servos)
            )
            if name not in args.fit.split(","):
                close += ((after < SHARE * before) | (after < CLOSE_MRAD)).tolist()
            there = 1e3 * error_in_mujoco(written, own, track.start) / after
            print(f"{name:<20} {before.round(1)} -> {after.round(1)}; {there.round(2)}")
        print(f"{sum(close)} of {len(close)} joints of motions not fitted: {np.mean(close):.0%}")


if __name__ == "__main__":
    main()
