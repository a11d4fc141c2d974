"""Take friction that a model lacks out of a recording: which joints, how much, how sure."""

import numpy as np

import adapter

# Hide friction in a recording: 0.4 N m of Coulomb friction in joint 2, which the model lacks.
log = adapter.read_log("recordings/panda_nominal_6s.mcap")
tau = log.tau.copy()
tau[:, 1] += 0.4 * np.tanh(log.dq[:, 1] / 0.01)
rubbing = adapter.make_log(1e-9 * log.stamp_ns, log.q, log.dq, tau, log.joint_names)

result = adapter.find_gap(rubbing, "panda", model_out="panda_with_friction.json")
print(result)
for finding in result.findings:
    for key, value in finding.parameters.items():
        size = f"{key} = {np.round(value, 3)} ± {np.round(finding.std[key], 3)}"
        print(f"{finding.effect} in joints {finding.joints}: {size} {finding.units[key]}")
    print(f"evidence {finding.evidence:.3f}; also possible: {list(finding.overlaps) or 'nothing'}")

# Torque error by joint on data that the fit never saw, N m
print("before", np.round(result.before.torque_rmse_nm, 3))
print("after ", np.round(result.after.torque_rmse_nm, 3))

# What no effect explains is said, not named.
print("unexplained:", result.unexplained or "nothing")
