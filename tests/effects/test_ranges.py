"""Ranges of a model's numbers are as wide as what draws from it are, in numbers and in torque."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapter.cli import main
from adapter.effects.ranges import ranges
from adapter.effects.torque import ModelTorque
from adapter.errors import ModelError
from adapter.model.model_file import save_model
from adapter.model.robots import documented
from adapter.model.self_model import SelfModel


def unsure() -> SelfModel:
    """A Panda with doubt in two masses, a moment of mass and friction."""
    std = np.full((7, 10), np.nan)
    std[3, 0], std[5, 0], std[4, 3] = 0.05, 0.02, 0.004
    effect = {"effect": "viscous_friction", "joints": [2], "parameters": {"Fv": 0.3}}
    effect |= {"std": {"Fv": 0.05}, "units": {"Fv": "N m s/rad"}}
    return replace(documented("panda"), theta_std=std, effects=(effect,))


def test_they_are_as_wide_as_what_is_drawn(tmp_path: Path) -> None:
    path = save_model(unsure(), tmp_path / "model.json")
    assert main(["export", str(path), "--ranges", str(tmp_path / "r.json")]) == 0
    told = json.loads((tmp_path / "r.json").read_text())
    std, mean = told["std"], told["mean"]
    masses = [std["links"][f"panda_link{k}"]["mass"] for k in range(1, 8)]
    assert np.allclose(masses, [0, 0, 0, 0.05, 0, 0.02, 0], atol=1e-9)
    assert np.isclose(std["joints"]["panda_joint2"]["viscous_friction Fv"], 0.05)
    assert told["units"]["viscous_friction Fv"] == "N m s/rad"
    assert mean["links"]["panda_link6"]["mass"] == pytest.approx(unsure().theta[5, 0])
    drawn, limits = unsure().sample(400, seed=1), unsure().limits
    along = [m.theta[4, 3] / m.theta[4, 0] for m in drawn]  # of link 5, whose axes are the file's
    assert np.isclose(np.std(along), max(std["links"]["panda_link5"]["com"]), rtol=0.15)

    rng = np.random.default_rng(9)
    q = rng.uniform(limits.lower, limits.upper, (150, 7))
    motion = q, 0.5 * rng.normal(size=q.shape), 2.0 * rng.normal(size=q.shape)
    spread = np.std([ModelTorque(m)(*motion) for m in drawn], axis=0)
    total = np.linalg.norm([x["torque_nm"] for x in told["directions"]], axis=0)
    assert np.allclose(total[:4], np.sqrt(np.mean(spread**2, axis=0))[:4], rtol=0.2)
    shares = [x["torque_share"] for x in told["directions"]]
    assert shares == sorted(shares, reverse=True) and 0.95 < sum(shares) <= 1.0 + 1e-9


def test_a_model_without_doubt_has_none() -> None:
    with pytest.raises(ModelError, match="has no standard deviations"):
        ranges(documented("panda"))
