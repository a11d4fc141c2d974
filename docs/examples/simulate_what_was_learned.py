"""A learned arm in MuJoCo, with the effects that its file cannot hold."""

from dataclasses import replace

import mujoco
import numpy as np

import adapter
from adapter.simulate import MujocoArm

# In earnest the model comes from `adapter gap` or `adapter run`; these effects are made up.
stribeck = {"Fc": 0.5, "Fs": 1.2, "vs": 0.1}
found = (
    {"effect": "stribeck_friction", "joints": [1, 2, 3, 4], "parameters": stribeck},
    {"effect": "torque_gain", "joints": [4], "parameters": {"g": 0.05}},
)
panda = adapter.load_model("panda")
model = replace(panda, effects=found)
adapter.export(model, "panda.urdf")

ready, still = np.array([[0.0, -0.8, 0.0, -2.3, 0.0, 1.6, 0.8]]), np.zeros((1, 7))
tau = adapter.inverse_dynamics(panda, ready, still, still)[0] + 1.0 * (np.arange(7) == 0)


def turned(in_simulator: adapter.SelfModel) -> float:
    """By how much joint 1 turns in 0.3 s under 1 N m, rad."""
    file = mujoco.MjModel.from_xml_path("panda.urdf")  # or any scene with these joints in it
    file.opt.timestep = 1e-3
    arm = MujocoArm(in_simulator, (file, mujoco.MjData(file)))
    arm.place(ready[0], still[0])
    arm.data.qfrc_applied[:] = tau
    with arm.acting():  # every mj_step has the effects now, whoever calls it
        mujoco.mj_step(file, arm.data, 300)
    print("joint 4: torque", tau[3].round(2), "N m, read", arm.measured()[2][3].round(2), "N m")
    return float(arm.data.qpos[0])


print(f"pushed by 1 N m: {turned(panda):.3f} rad, with friction {turned(model):.3f} rad")
