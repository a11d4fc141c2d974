"""λ learned in batch from motion that Pinocchio made: moments, networks, one pass and v missing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from adapter.errors import ModelError
from adapter.experiments.networks import NetworkSettings, schema_by_networks
from adapter.learning.batch.prediction_errors import kinematic_errors
from adapter.learning.batch.schema import schema_from_moments, schema_moments
from adapter.learning.schema_kernels import CHANNELS
from adapter.learning.tree_data import BodyMotion, TreeData
from adapter.model.self_model import SelfModel
from adapter.model.spatial import matrix_from_zxz, rotation_angle
from adapter.physics.identifiability import frame_observability
from tests.helpers.robot_models import PANDA, pinocchio_case, random_urdf


def samples(text: str, floating: bool, count: int, seed: int) -> tuple[SelfModel, TreeData]:
    """Samples of a robot, link motion and torques by Pinocchio."""
    case = pinocchio_case(text, floating, count, seed)
    first = int(floating)
    v, w, a, dw = (x.numpy() for x in case.motion)
    if floating:
        base = BodyMotion(w[:, 0], a[:, 0], dw[:, 0], v[:, 0])
    else:
        zero = np.zeros((count, 3))
        base = BodyMotion(zero, zero - case.model.gravity, zero, zero)
    links = BodyMotion(*(x[:, first:] for x in (w, a, dw)), v[:, first:])
    signals = (x.numpy() for x in (case.q, case.dq, case.ddq))
    return case.model, TreeData(case.model.tree, *signals, case.tau, base, links)


def without_speed(data: TreeData) -> TreeData:
    return replace(data, links=replace(data.links, v=None), base=replace(data.base, v=None))


@pytest.mark.parametrize("floating", [True, False])
@pytest.mark.parametrize(
    ("links", "seed", "sliding"),
    [(5, 1, 0.0), (9, 2, 0.0), (12, 3, 0.0), (6, 4, 0.5), (11, 5, 0.5)],
)
def test_moments_find_every_frame_without_noise(
    links: int, seed: int, sliding: float, floating: bool
) -> None:
    text = random_urdf(links, seed, sliding)
    model, data = samples(text, floating, 200, seed)
    _, control = samples(text, floating, 50, seed + 100)
    seen = frame_observability(model.tree, model.lam, model.gravity)
    for given in (data, without_speed(data)):
        found = schema_from_moments(given)
        assert found.ranks == seen.ranks
        hidden = np.eye(6) - seen.projectors
        np.testing.assert_allclose(found.freedom.hidden(found.lam[:, 3:]), hidden, atol=1e-6)
        errors = kinematic_errors(control, found.lam)
        assert max(errors.largest.values()) < 1e-9, errors.largest
        assert all(h.sum() == 50 * links * 3 for h in errors.histogram.values())
    whole = np.array([r == 6 for r in seen.ranks])
    assert whole.all() or not floating
    turned = rotation_angle(matrix_from_zxz(found.lam[:, :3]), matrix_from_zxz(model.lam[:, :3]))
    np.testing.assert_allclose(turned[whole], 0.0, atol=1e-10)
    np.testing.assert_allclose(found.lam[whole, 3:], model.lam[whole, 3:], atol=1e-10)


def test_what_the_data_do_not_show_stays_at_zero() -> None:
    model, data = samples(PANDA.read_text(), False, 200, 4)
    found = schema_from_moments(data)
    assert found.ranks == (2, 4, 6, 6, 6, 6, 6)
    assert not found.observable[0, 2:].any() and found.observable[2:].all()
    assert abs(found.lam[0, 5]) < 1e-9  # the height of joint 1, which nothing shows
    np.testing.assert_allclose(found.lam[2:, 3:], model.lam[2:, 3:], atol=1e-9)
    assert kinematic_errors(data, found.lam).largest["a"] < 1e-9


@pytest.mark.parametrize("floating", [True, False])
def test_spread_says_how_far_noise_moves_a_frame(floating: bool) -> None:
    text = random_urdf(6, 5) if floating else PANDA.read_text()
    model, data = samples(text, floating, 300, 5)
    seen = frame_observability(model.tree, model.lam, model.gravity)
    noise = dict(zip(CHANNELS, (0.003, 0.004, 0.02, 0.03), strict=True))
    rng = np.random.default_rng(0)
    scores = []
    for _ in range(4):
        noisy = replace(data, links=_noisy(data.links, noise, rng))
        for given in (np.array(list(noise.values())), None):
            found = schema_from_moments(noisy, given)
            assert found.ranks == seen.ranks
            whole = found.observable.all(axis=1)
            shift = (found.lam - model.lam)[whole, 3:]
            scores.append(shift / found.std[whole, 3:])
    rms = float(np.sqrt(np.mean(np.concatenate(scores) ** 2)))
    assert 0.8 < rms < 1.25


@pytest.mark.parametrize("speed", [True, False])
def test_noise_of_the_parents_is_taken_out_of_every_moment(speed: bool) -> None:
    """What is left of its power, of 1, is chance alone: no channel forgotten, none twice."""
    _, data = samples(random_urdf(5, 9), True, 100, 9)
    data = data.take(np.tile(np.arange(100), 200))
    clean = schema_moments(data if speed else without_speed(data))
    noise = dict(zip(CHANNELS, (0.3, 0.4, 0.2, 0.5), strict=True))
    rng = np.random.default_rng(1)
    # each noise comes with both signs, so that its products with the signals cancel
    base, links = (_noisy(x, noise, rng, both_signs=True) for x in (data.base, data.links))
    noisy = replace(data, links=links, base=base)
    found = schema_moments(noisy if speed else without_speed(noisy))
    variance = np.array(list(noise.values())) ** 2
    left = np.array([found.without_noise(j, variance) for j in range(5)]) - clean.sums
    places = {0: [(3, "w")], 1: [(3, "v"), (6, "w")], 2: [(3, "a"), (6, "dw")], 3: [(3, "dw")]}
    for channel, parts in places.items():
        for at, name in parts if speed or channel != 1 else ():
            power = found.count * noise[name] ** 2
            blocks = left[:, channel, at : at + 3, at : at + 3] / power
            assert np.abs(np.trace(blocks, axis1=1, axis2=2) / 3.0).max() < 0.05
    assert speed or not left[:, 1].any()


def _noisy(
    links: BodyMotion | None,
    noise: dict[str, float],
    rng: np.random.Generator,
    both_signs: bool = False,
) -> BodyMotion:
    assert links is not None and links.v is not None

    def read(x: np.ndarray, std: float) -> np.ndarray:
        e = std * rng.normal(size=x.shape)
        if both_signs:
            half = len(e) // 2
            e[half:] = -e[:half]
        return x + e

    w, a, dw = (read(getattr(links, name), noise[name]) for name in ("w", "a", "dw"))
    return BodyMotion(w, a, dw, read(links.v, noise["v"]))


@pytest.mark.parametrize(("floating", "speed"), [(True, True), (False, False)])
def test_networks_reach_the_same_frames(floating: bool, speed: bool) -> None:
    """Eq. 18 from random starts, mini-batches of 10, without moments."""
    _, data = samples(random_urdf(5, 7), floating, 800, 7)
    _, control = samples(random_urdf(5, 7), floating, 50, 8)
    settings = NetworkSettings(starts=4, cycles=12)
    found = schema_by_networks(data if speed else without_speed(data), 1, settings)
    assert list(found.snapshots) == [0, 50, 100, 960] and len(found.loss) == 960
    assert found.loss[-1] < 1e-12 < found.loss[0]
    first = kinematic_errors(control, found.snapshots[0]).largest["w"]
    assert first > 0.1 and kinematic_errors(control, found.snapshots[100]).largest["w"] < first
    errors = kinematic_errors(control, found.lam).largest
    assert max(errors.values()) < 1e-6, errors


def test_bad_input_is_named() -> None:
    _, data = samples(random_urdf(5, 8), True, 30, 8)
    with pytest.raises(ModelError, match="none is given"):
        schema_from_moments(replace(data, links=None))
    with pytest.raises(ModelError, match="none is given"):
        kinematic_errors(replace(data, links=None), np.zeros((5, 6)))
    with pytest.raises(ModelError, match="mini-batch"):
        schema_by_networks(data.take(slice(0, 5)))
