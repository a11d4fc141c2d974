"""Faults are put in as asked: in number, in kind, at their time, the same for the same seed."""

import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.faults.driver import FaultyDriver, corrupt, corrupt_stamp, with_faults
from drivers.faults.spec import KINDS, Fault, Faults
from drivers.files.log import LogArm
from drivers.interface import DriverError, EndOfStream, JointSample
from tests.helpers import contract_suite
from tests.helpers.live_tools import simulated_arm
from tests.helpers.mcap_tools import STEP_NS, record, samples

COUNT = 4000
SHARED = [name for name, kind in KINDS.items() if not kind.timed]


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return record(tmp_path_factory.mktemp("faults") / "a.mcap", samples(COUNT, links=True))


def run(path, text: str, seed: int = 1) -> tuple[list[JointSample], FaultyDriver]:
    """All samples of the recording behind these faults."""
    arm = with_faults(LogArm(path), text, seed)
    arm.connect()
    found = []
    with pytest.raises(EndOfStream):
        while True:
            found.append(arm.read())
    assert arm.account.delivered == len(found)
    assert arm.account.taken == COUNT and arm.account.balanced and arm.account.waiting == 0
    return found, arm


def stamps(found: list[JointSample]) -> np.ndarray:
    """In periods from the first."""
    return (np.array([s.stamp_ns for s in found]) - samples(1)[0].stamp_ns) // STEP_NS


def same(a: JointSample, b: JointSample) -> bool:
    return a.stamp_ns == b.stamp_ns and contract_suite.same(a, b)


def clean(path) -> list[JointSample]:
    return run(path, "")[0]


def near(count: int, share: float) -> bool:
    """Five standard deviations of a binomial."""
    return abs(count - share * COUNT) < 5.0 * np.sqrt(share * COUNT)


def test_without_faults_nothing_changes(path) -> None:
    found, arm = run(path, "")
    assert stamps(found).tolist() == list(range(COUNT))
    assert not arm.account.injected and arm.account.line().endswith("none")


@pytest.mark.parametrize("share", [0.001, 0.01, 0.1])
def test_lost(path, share: float) -> None:
    found, arm = run(path, f"lost={share}")
    assert near(arm.account.injected["lost"], share)
    assert len(found) == COUNT - arm.account.injected["lost"]
    assert (np.diff(stamps(found)) > 0).all()


def test_late_samples_come_after_newer_ones(path) -> None:
    found, arm = run(path, "late=0.01+7")
    assert near(arm.account.injected["late"], 0.01) and len(found) == COUNT
    at = stamps(found)
    assert sorted(at) == list(range(COUNT))
    newest = np.maximum.accumulate(at)
    late = newest - at
    assert 6 <= np.median(late[late > 0]) <= 8


def test_repeated(path) -> None:
    found, arm = run(path, "repeated=0.01")
    assert near(arm.account.injected["repeated"], 0.01)
    assert len(found) == COUNT + arm.account.injected["repeated"]
    again = np.flatnonzero(np.diff(stamps(found)) == 0)
    assert len(again) == arm.account.injected["repeated"]
    assert all(same(found[k], found[k + 1]) for k in again)


def test_reordered(path) -> None:
    found, arm = run(path, "reordered=0.01")
    at = stamps(found)
    assert sorted(at) == list(range(COUNT))
    assert 0 < (np.diff(at) < 0).sum() <= arm.account.injected["reordered"]
    assert np.abs(at - np.arange(COUNT)).max() <= 3


@pytest.mark.parametrize("name", ["corrupt", "nan", "spike", "stamp"])
def test_wrong_numbers(path, name: str) -> None:
    found, arm = run(path, f"{name}=0.02")
    changed = [not same(a, b) for a, b in zip(found, clean(path), strict=True)]
    assert sum(changed) == arm.account.injected[name] and near(sum(changed), 0.02)
    wrong = [(a, b) for a, b, c in zip(found, clean(path), changed, strict=True) if c]
    if name == "stamp":
        assert all(a.stamp_ns != b.stamp_ns and a.stamp_ns >= 0 for a, b in wrong)
    else:
        assert all(a.stamp_ns == b.stamp_ns for a, b in wrong)
    if name == "nan":
        assert all(np.isnan([a.q, a.dq, a.tau]).sum() in (1, 3) for a, _ in wrong)
    if name == "spike":
        off = [np.array([a.q - b.q, a.dq - b.dq, a.tau - b.tau]) for a, b in wrong]
        assert all(np.count_nonzero(x) == 1 and np.abs(x).max() >= 0.1 - 1e-9 for x in off)


def test_stuck_jump_and_clock(path) -> None:
    found, _ = run(path, "stuck:2@1+0.5,jump:3@2-0.25,clock@3+100")
    true = clean(path)
    for k, (now, was) in enumerate(zip(found, true, strict=True)):
        held = true[1000] if 1000 <= k < 1500 else was
        assert (now.q[1], now.dq[1], now.tau[1]) == (held.q[1], held.dq[1], held.tau[1])
        assert now.q[2] == was.q[2] - (0.25 if k >= 2000 else 0.0)
        assert (now.q[0], now.dq[2]) == (was.q[0], was.dq[2])
        assert now.stamp_ns - was.stamp_ns == (100_000_000_000 if k >= 3000 else 0)


def test_a_short_silence_is_a_hole_and_a_long_one_an_error(path) -> None:
    found, arm = run(path, "silence@1+0.05")
    assert len(found) == COUNT - 50 and arm.account.injected["silence"] == 50
    arm = with_faults(LogArm(path), "silence@1+0.5")
    arm.connect()
    for _ in range(1000):
        arm.read()
    with pytest.raises(DriverError, match=r"nothing heard.*connect again"):
        arm.read()
    assert arm.account.balanced


def test_a_connection_that_died_stays_dead_until_the_next(path) -> None:
    arm = with_faults(simulated_arm(), "died@0.1")
    arm.connect()
    for _ in range(100):
        arm.read()
    for _ in range(2):
        with pytest.raises(DriverError, match="gone"):
            arm.read()
        with pytest.raises(DriverError, match="gone"):
            arm.command(np.zeros(7))
    assert arm.account.injected["died"] == 1 and arm.account.balanced
    arm.stop()
    arm.connect()
    assert arm.read().stamp_ns > 0
    arm.close()


def test_a_slow_read_takes_its_time(path) -> None:
    arm = with_faults(LogArm(path), "slow=0.999+0.03")
    arm.connect()
    begin = time.monotonic()
    for _ in range(5):
        arm.read()
    assert time.monotonic() - begin >= 0.03 * arm.account.injected["slow"] > 0.0


def test_an_arm_that_is_not_paced_moves_on_while_samples_get_lost() -> None:
    arm = with_faults(simulated_arm(), "lost=0.3")
    arm.connect()
    at = [arm.read().stamp_ns // STEP_NS for _ in range(200)]
    arm.close()
    assert len(set(np.diff(at))) > 1
    assert at[-1] + 1 == arm.account.taken == 200 + arm.account.injected["lost"]
    assert arm.plant_time_ns > 0 and arm.driver.intake.received == arm.account.taken


def test_the_same_seed_gives_the_same_faults(path) -> None:
    text = ",".join(f"{name}=0.02" for name in SHARED if name != "slow")
    first, arm = run(path, text, seed=3)
    again, twin = run(path, text, seed=3)
    assert all(map(same, first, again)) and len(first) == len(again)
    assert arm.account == twin.account
    assert run(path, text, seed=4)[1].account.injected != arm.account.injected


def test_connecting_again_begins_anew(path) -> None:
    arm = with_faults(LogArm(path), "corrupt=0.1,late=0.1", seed=5)
    rounds = []
    for _ in range(2):
        arm.connect()
        rounds.append([arm.read() for _ in range(300)])
        arm.close()
    assert all(map(same, *rounds))


def test_a_fault_beside_it_leaves_the_instants_alone(path) -> None:
    alone, _ = run(path, "nan=0.02")
    beside, _ = run(path, "nan=0.02,spike=0.1")
    blank = [[np.isnan(s.q).any() or np.isnan(s.tau).any() for s in x] for x in (alone, beside)]
    assert blank[0] == blank[1]


def test_the_driver_behind_keeps_its_samples(path) -> None:
    log = LogArm(path)
    before = log.log.q.tobytes(), log.log.tau.tobytes(), log.log.twists.tobytes()
    arm = FaultyDriver(log, Faults.parse("corrupt=0.3,spike=0.3,nan=0.3,jump:1@0,stuck:2@1"), 2)
    arm.connect()
    for _ in range(2000):
        arm.read()
    assert before == (log.log.q.tobytes(), log.log.tau.tobytes(), log.log.twists.tobytes())


def test_flipped_bits_reach_every_number_and_the_stamp() -> None:
    rng = np.random.default_rng(0)
    sample = samples(1, links=True)[0]
    hit = dict.fromkeys(("q", "dq", "tau", "twist", "accel"), 0)
    for _ in range(2000):
        wrong = corrupt(sample, rng)
        parts = {k: getattr(wrong if k in ("q", "dq", "tau") else wrong.links, k) for k in hit}
        for name, values in parts.items():
            was = getattr(sample if name in ("q", "dq", "tau") else sample.links, name)
            changed = values.view(np.uint64) != was.view(np.uint64)
            assert changed.sum() <= 1
            hit[name] += int(changed.sum())
    assert sum(hit.values()) == 2000 and min(hit.values()) > 80
    assert len({corrupt_stamp(sample, rng).stamp_ns for _ in range(200)}) > 150


@given(st.text(alphabet="lostajumpck:=@+-.,0123456789e ", max_size=40))
def test_any_text_is_faults_or_one_clear_sentence(text: str) -> None:
    try:
        faults = Faults.parse(text)
    except DriverError as error:
        assert "\n" not in str(error) and len(str(error)) > 10
    else:
        assert Faults.parse(str(faults)) == faults


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("gremlins=0.1", "have: lost, late, repeated"),
        ("lost", "write lost=SHARE"),
        ("lost@3", "write lost=SHARE"),
        ("lost=1", "below 1"),
        ("lost=-0.1", "write lost=SHARE"),
        ("lost=0.1,lost=0.2", "two shares"),
        ("late=0.1-3", "above zero"),
        ("jump@3", "write jump:JOINT@SECONDS"),
        ("stuck:2=0.1", "write stuck:JOINT@SECONDS"),
        ("clock:2@3", "write clock@SECONDS"),
        ("died@3+1", "takes no amount"),
        ("silence@1e999", "too large"),
        ("nan=x", "write nan=SHARE"),
    ],
)
def test_wrong_texts_are_refused_with_the_choices(text: str, said: str) -> None:
    with pytest.raises(DriverError) as caught:
        Faults.parse(text)
    assert said in str(caught.value)


def test_a_joint_that_is_not_there(path) -> None:
    with pytest.raises(DriverError, match="joints 1 to 3"):
        with_faults(LogArm(path), "stuck:4@1")


def test_the_text_form_comes_back_and_amounts_have_defaults() -> None:
    shares = ",".join(f"{name}=0.01" for name in SHARED)
    timed = "clock@1.5-3600.0,silence@2+0.5,died@1e6,stuck:2@0+1e9,jump:7@3.25+1e-9"
    for text in ("", shares, timed, f"{shares},{timed}"):
        faults = Faults.parse(text)
        assert Faults.parse(str(faults)) == faults
        assert len(faults.items) == len([x for x in text.split(",") if x])
    faults = Faults.parse(" late=0.1 , clock@8-3600,jump:3@12")
    assert faults.items[0] == Fault("late", share=0.1, amount=5)
    assert faults.items[1].amount == -3600.0
    assert faults.items[2] == replace(Fault("jump", None, 12.0, 3), amount=0.1)
