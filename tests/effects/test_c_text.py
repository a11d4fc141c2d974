"""The C file of an arm says what Python says, to rounding, and is C99 without a warning."""

from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import adapter
from adapter.cli import main
from adapter.effects.base import JointTorque
from adapter.effects.c_text import c_text
from adapter.effects.catalogue import KNOWN
from adapter.effects.law import CURVES, LAWS, Curve, Law
from adapter.effects.torque import ModelTorque
from adapter.errors import ModelError
from adapter.model.model_file import save_model
from adapter.model.robots import documented
from adapter.model.self_model import SelfModel, Tool
from sim.fci.server import COMPILER
from tests.effects.test_law import entries_of
from tests.helpers.robot_models import entry, machine_urdf, read_quietly
from tests.simulate.test_rollouts import BALL, CASES, SENSED

compiled = pytest.mark.skipif(COMPILER is None, reason="no C compiler (cc, gcc, clang) is here")
FORMS = [law for law in (LAWS | CURVES).values() if law.by in (0, 3)]
NAMED = [effect.as_dict() for effect in (*CASES, *SENSED)]
BRISTLES = [entry("stribeck_friction", [5], Fc=0.3, Fs=0.6, vs=0.08, s0=3e-3)]
BRISTLES += [x for x in NAMED if x["effect"] == "bristle_friction"]
AT_JOINTS = [x for x in NAMED if isinstance(KNOWN[x["effect"]], JointTorque)]


def panda(entries: Sequence[Mapping[str, Any]], *laws: Law | Curve) -> SelfModel:
    """With a load, which comes first, and a tool, on a table that is not level."""
    load = {"effect": "payload", "joints": [], "parameters": BALL}
    tool, gravity = Tool(0.7, np.full(3, 0.05), 1e-3 * np.eye(3)), np.array([1.0, -2.0, -9.5])
    effects = (load, *entries, *entries_of(laws))
    return replace(documented("panda"), effects=effects, tool=tool, gravity=gravity)


class State(ctypes.Structure):
    _fields_ = (("begun", ctypes.c_int), ("q", ctypes.c_double * 7), ("bent", ctypes.c_double * 3))


class Arm:
    """A C file as strict C99, every warning an error; its functions over tables (m, n)."""

    def __init__(self, text: str, folder: Path) -> None:
        (folder / "arm.c").write_text(text, encoding="utf-8")
        flags = "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-std=c99", "-fPIC", "-shared"
        files = str(folder / "arm.c"), "-o", str(folder / "arm.so"), "-lm"
        subprocess.run([COMPILER, *flags, *files], check=True)
        self.functions = ctypes.CDLL(str(folder / "arm.so"))

    def __call__(self, name: str, *tables: np.ndarray, state: State | None = None) -> np.ndarray:
        """tau (m, n), row by row; `adapter_torque` takes a state, or none, first."""
        function, out = getattr(self.functions, f"adapter_{name}"), np.zeros(tables[0].shape)
        first = [state and ctypes.byref(state)] if name == "torque" else []
        for row in zip(*tables, out, strict=True):
            numbers = (x.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for x in row)
            function(*first, *numbers)
        return out


def motion(n: int) -> np.ndarray:
    """q, dq, ddq (3, 500, n), slow and at rest among them."""
    table = np.random.default_rng(4).normal(size=(3, 500, n)) * [[[1.5]], [[1.0]], [[3.0]]]
    table[1, ::5] *= 1e-2
    table[1, ::50] = 0.0
    return np.asarray(table)


def close(found: np.ndarray, told: np.ndarray) -> bool:
    return bool(np.allclose(found, told, rtol=1e-12, atol=1e-12 * np.abs(told).max()))


@compiled
def test_all_numbers_are_pythons(tmp_path: Path) -> None:
    model, table = panda(AT_JOINTS, *FORMS), motion(7)
    path = save_model(model, tmp_path / "model.json")
    assert main(["export", str(path), "--c", str(tmp_path / "new.c")]) == 0
    arm = Arm((tmp_path / "new.c").read_text(encoding="utf-8"), tmp_path)
    bare, still = replace(model, effects=model.effects[:1]), 0.0 * table[0]
    rigid = adapter.inverse_dynamics(bare, *table)
    assert close(arm("torque", *table), adapter.inverse_dynamics(model, *table))
    assert close(arm("rigid", *table), rigid) and not close(arm("torque", *table), rigid)
    assert close(arm("gravity", table[0]), adapter.inverse_dynamics(bare, table[0], still, still))


@compiled
def test_bristles_remember_the_way(tmp_path: Path) -> None:
    model, t = panda(BRISTLES), np.arange(0.0, 2.0, 2e-3)
    q = 0.02 * np.sin(np.outer(t, np.arange(3.0, 10.0)))
    table = q, np.gradient(q, t, axis=0), np.zeros_like(q)
    arm, state = Arm(c_text(model).text, tmp_path), State()
    arm.functions.adapter_begin(ctypes.byref(state))
    wound, at_once = arm("torque", *table, state=state), arm("torque", *table)
    assert close(wound, ModelTorque(model)(*table, t)) and not close(wound, at_once)
    assert close(at_once, ModelTorque(model)(*table))


@compiled
def test_joints_that_slide(tmp_path: Path) -> None:
    effect = {"effect": "coulomb_friction", "joints": [3], "parameters": {"Fc": 4.0}}
    model = replace(read_quietly(machine_urdf("scara"), False), effects=(effect,))
    told = adapter.inverse_dynamics(model, *motion(4))
    assert close(Arm(c_text(model).text, tmp_path)("torque", *motion(4)), told)


def test_what_c_cannot_hold_is_said() -> None:
    written = c_text(panda(NAMED))
    ended = {x["effect"] for x in NAMED if (x.get("interval_s") or [0, None])[1] is not None}
    bodies = {"payload", "base_tilt"}
    held = {x["effect"] for x in AT_JOINTS} | bodies
    names = {x["effect"] for x in NAMED} - held - ended
    assert set(written.left_out) == names
    head = written.text.partition("*/")[0]
    assert all(f"{KNOWN[x].title}: no\n" in head for x in names)
    assert "viscous friction: whole\n" in head
    with pytest.raises(ModelError, match="its base floats"):
        c_text(documented("panda").with_base(True))
