"""A hose that no catalogue has: hidden in a simulated arm, found, kept by name, simulated."""

from dataclasses import replace

import numpy as np

import adapter
from adapter.simulate import MujocoArm

panda = adapter.load_model("panda")
hose = {"effect": "law: max(q - a, 0)²", "joints": [2], "parameters": {"c": 9.0, "a": -0.9}}
hosed = replace(panda, effects=(hose,))  # 9 N m/rad² on joint 2 beyond -0.9 rad
t, rate = np.arange(0.0, 8.0, 1e-3)[:, None], np.linspace(0.9, 1.9, 7)
angle, damping = rate * t + np.arange(7), np.array([40, 40, 40, 40, 4, 2, 0.5])
q = np.array([0.0, -0.8, 0.0, -2.0, 0.0, 1.6, 0.8]) + 0.5 * np.sin(angle)
dq, ddq = 0.5 * rate * np.cos(angle), -0.5 * rate**2 * np.sin(angle)
tau = adapter.inverse_dynamics(panda, q, dq, ddq)  # of a controller that knows no hose


def driven(model: adapter.SelfModel) -> adapter.Log:
    """An arm in MuJoCo, driven along sines; what its sensors read."""
    arm, rows = MujocoArm(model), []
    arm.place(q[0], dq[0])
    for k in range(len(t)):
        rows.append(arm.measured())
        arm.step(tau[k] + damping * (10.0 * (q[k] - rows[k][0]) + dq[k] - rows[k][1]))
    is_q, is_dq, is_tau = (np.array(signal) for signal in zip(*rows, strict=True))
    is_tau += 0.05 * np.random.default_rng(1).standard_normal(q.shape)
    return adapter.make_log(t[:, 0], is_q, is_dq, is_tau, panda.tree.joint_names)


log = driven(hosed)
result = adapter.find_gap(log, panda, model_out="hosed.json")
print(result)
print(adapter.keep_law(result, "hose", "own.toml"))  # with_kept("own.toml") looks for it again
for model in (panda, adapter.load_model("hosed.json")):
    away = 1e3 * np.abs(driven(model).q - log.q)[:, 1].max()
    print(f"joint 2 moves by up to {away:.1f} mrad otherwise in the simulator")
