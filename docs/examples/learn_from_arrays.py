"""Learn λ and θ of an arm from arrays, look at what is known, and export the result."""

import numpy as np

import adapter

# Any source of joint signals will do; here a recording of the simulated Panda stands in for it.
log = adapter.read_log("recordings/panda_nominal_6s.mcap")
time_s, q, dq, tau = 1e-9 * log.stamp_ns, log.q, log.dq, log.tau  # s; (m, n) rad, rad/s, N m

arrays = adapter.make_log(time_s, q, dq, tau, joint_names=log.joint_names)
panda = adapter.load_model("panda")  # or the path of a URDF
found = adapter.learn(arrays, panda, every=10)
print(found)

# λ: one row per joint, [α β γ px py pz]; a standard deviation of NaN: the motion shows nothing.
shown = np.isfinite(found.lam_std).sum()
print(f"{shown} of {found.lam_std.size} single turns and shifts of the frames are shown")

# θ: masses of single links mean nothing alone (43 combinations of 70 numbers do), torque does.
print("held-out torque error by joint, N m:", np.round(found.held_out_rmse_nm, 3))
for name, values in found.effects.items():
    print(f"{name}: {np.round(values, 3)}")

# The learned model works like any other.
signals = adapter.filtered(arrays, panda)  # q, dq, ddq and tau of one instant per row
motion = signals.q, signals.dq, signals.ddq  # one motion by its stamps: bristles remember the way
predicted = adapter.inverse_dynamics(found.model, *motion, time_s=signals.time_s)
print("largest error anywhere, N m:", np.abs(signals.tau - predicted).max().round(2))
print(adapter.export(found.model, "panda_learned.urdf"))
