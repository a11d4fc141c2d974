"""N and A unknown: the tree comes back from shuffled recordings, and no wrong edge is trusted."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import pytest

from adapter.discovery import Discovery, discover, learn
from adapter.discovery.hypotheses import FREE, Option
from adapter.discovery.tree_search import TreeSearch, cycle
from adapter.errors import ModelError, SettingsError
from adapter.model.spatial import log_rotation, matrix_from_zxz
from tests.helpers.discovery_data import RATE_HZ, SHORT, TRUSTED, Case, Motion, confidences, record

NO_TURNING = (1, 1, 1, 0, 0, 0)


@cache
def _case(name: str, motion: Motion, seed: int, noise: float = 1.0) -> Case:
    return record(name, motion, seed, noise=noise)


def _worst_wrong(case: Case, found: Discovery) -> float:
    return max((c for edge, c in confidences(found).items() if edge not in case.edges), default=0.0)


@pytest.mark.parametrize("parts", ["ta", "t"])
@pytest.mark.parametrize(("name", "seed"), [("panda", 0), ("panda", 1), ("atlas", 0)])
def test_tree_comes_back(name: str, parts: str, seed: int) -> None:
    whole = _case(name, SHORT, seed)
    log = whole.log if parts == "ta" else replace(whole.log, accels=None)
    found = discover(log)
    assert set(confidences(found)) == whole.edges
    assert found.root == whole.root
    assert min(confidences(found).values()) > 0.99 and found.root_confidence > 0.99
    assert found.undecided == ()


@pytest.mark.parametrize(("seed", "noise"), [(2, 20.0), (3, 200.0)])
def test_short_and_noisy_is_never_trusted_wrongly(seed: int, noise: float) -> None:
    case = _case("panda", Motion(seconds=1.0, rate_hz=RATE_HZ), seed, noise)
    found = discover(case.log)
    assert _worst_wrong(case, found) < TRUSTED
    doubtful = [e for e in found.edges if e.confidence < TRUSTED]
    assert all(any(e.link in line for line in found.undecided) for e in doubtful)
    if noise > 100.0:
        assert doubtful


def test_a_second_of_motion_is_enough_with_real_parts() -> None:
    case = _case("atlas", Motion(seconds=1.0, rate_hz=RATE_HZ), 4)
    found = discover(case.log)
    assert _worst_wrong(case, found) < TRUSTED
    assert len(case.edges & set(confidences(found))) >= 28


@pytest.mark.parametrize("still", [(2,), (1, 4)])
def test_resting_joints_are_named_and_not_guessed(still: tuple[int, ...]) -> None:
    case = _case("panda", replace(SHORT, still=still), 5)
    found = discover(case.log)
    assert _worst_wrong(case, found) < TRUSTED
    resting = _chain(case)[list(still)]
    for joint in (joint for joint, link, _ in case.edges if link in resting):
        assert any(joint in line and "does not move" in line for line in found.undecided)


def test_joints_that_move_alike_tie() -> None:
    case = _case("panda", replace(SHORT, alike=((3, 5),)), 6)
    found = discover(case.log)
    assert _worst_wrong(case, found) < TRUSTED
    pair = [e for e in found.edges if e.confidence < TRUSTED]
    assert {e.confidence > 0.4 for e in pair} == {True} and len(pair) == 2
    assert any("moved alike" in line for line in found.undecided)


def test_a_missing_link_leaves_its_child_open() -> None:
    case = _case("panda", SHORT, 0)
    keep = [k for k, name in enumerate(case.log.link_names) if name != _chain(case)[3]]
    names = tuple(case.log.link_names[k] for k in keep)
    motion = {part: getattr(case.log, part)[:, keep] for part in ("twists", "accels")}
    found = discover(replace(case.log, link_names=names, **motion))
    assert _worst_wrong(case, found) < TRUSTED
    assert found.root is None and found.undecided
    with pytest.raises(ModelError, match="carried by nothing"):
        learn(found)


def test_lambda_follows_and_its_spread_is_what_it_is_off_by() -> None:
    case = _case("panda", SHORT, 0)
    learned = learn(discover(case.log))
    body = [case.body[name] - 1 for name in learned.data.tree.link_names]
    assert body == list(range(7))
    shown = [j for j, rank in enumerate(learned.schema.ranks) if rank == 6]
    assert shown == [2, 3, 4, 5, 6]
    found, true = learned.schema.lam[shown], case.model.lam[shown]
    back = np.swapaxes(matrix_from_zxz(true[:, :3]), 1, 2)
    turn = log_rotation(back @ matrix_from_zxz(found[:, :3]))
    off = np.concatenate([turn, found[:, 3:] - true[:, 3:]], axis=1)
    assert np.abs(off).max() < 1e-3
    assert 0.7 < np.sqrt(np.mean((off / learned.schema.std[shown]) ** 2)) < 1.4


def _chain(case: Case) -> np.ndarray:
    """Recorded link names of the Panda from the base on."""
    children = {parent: link for _, link, parent in case.edges}
    names = [children[case.root]]
    while names[-1] in children:
        names.append(children[names[-1]])
    return np.array(names)


def test_a_ring_is_split_for_the_best_tree() -> None:
    """Against all combinations, on random scores in which the best assignment is a ring."""
    rng = np.random.default_rng(0)
    rings = 0
    for _ in range(20):
        n = 4
        options = []
        for link in range(n):
            own = [Option(link, s, i, float(-9 * rng.random())) for s in range(3) for i in range(n)]
            own = [o for o in own if o.parent != link] + [Option(link, -1, FREE, -8.0)]
            options.append(tuple(sorted(own, key=lambda o: -o.score)))
        best = TreeSearch(tuple(options), 3).best()
        assert best is not None
        rings += bool(cycle(tuple(row[0] for row in options)))
        scores = []
        for chosen in product(*options):
            joints = [o.joint for o in chosen if o.joint != -1]
            if len({*joints}) == len(joints) and not cycle(chosen):
                scores.append(sum(o.score for o in chosen))
        assert best.score == pytest.approx(max(scores))
    assert rings > 3


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda log: {"twists": None, "accels": None, "link_names": ()}, "has no motion of links"),
        (lambda log: {"twists": np.nan * log.twists, "accels": None}, "it has: nothing"),
        (
            lambda log: {"twists": None, "accels": log.accels * NO_TURNING},
            "neither angular",
        ),
        (lambda log: {"stamp_ns": log.stamp_ns // 1000}, "lasts 0.00 s"),
        (lambda log: {"q": np.full_like(log.q, np.nan)}, "at the same time"),
        (lambda log: {"twists": _one_link_silent(log.twists)}, "at the same time.* 1 %"),
        (lambda log: {"dq": 0 * log.dq, "q": 0 * log.q}, "no joint moves"),
    ],
)
def test_what_cannot_serve_is_told(change, sentence: str) -> None:  # type: ignore[no-untyped-def]
    log = _case("panda", SHORT, 0).log
    with pytest.raises((SettingsError, ModelError), match=sentence):
        discover(replace(log, **change(log)))


def _one_link_silent(twists: np.ndarray) -> np.ndarray:
    out = twists.copy()
    out[10:, 3] = np.nan
    return out
