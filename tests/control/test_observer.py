"""The contact observer: external torque held to a known push, noise, changes of parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from adapter.control.observer import ContactObserver
from adapter.realtime.following import FollowingObserver
from adapter.realtime.snapshot import SnapshotReader, SnapshotWriter
from adapter.runs.contacts import Kind, kind_of
from drivers.interface import JointSample
from sim.effects import payload
from sim.truth import panda
from tests.helpers.arm_data import Motion, arm, panda_model, pin_model, record, rnea
from tests.helpers.live_learners import nothing_known

STD = np.full(7, 0.05)
NONE = np.zeros((0, 7))


def samples_with(external: np.ndarray, begin_s: float, seed: int = 3) -> list[JointSample]:
    """Motion of 4 s with a real arm's noise; from `begin_s` on something puts these torques on."""
    data = record(arm(), Motion(4.0, seed, low_hz=0.1))
    tau = data.tau.copy()
    tau[round(1e3 * begin_s) :] -= external
    return replace(data, tau=tau).samples()


def learned_observer() -> ContactObserver:
    """One that knows the arm."""
    model = panda_model()
    observer = ContactObserver(model)
    observer.adopt(model.lam, model.theta, NONE, NONE, STD)
    return observer


@pytest.mark.parametrize("seed", range(3))
def test_a_push_is_seen_at_once_and_is_as_large_as_it_is(seed: int) -> None:
    """5 N m on joint 2 and 4 on joint 4, as 10 N at the hand make."""
    external = np.array([0.0, 5.0, 0.0, 4.0, 0.0, 0.0, 0.0])
    observer = learned_observer()
    late = []
    for sample in samples_with(external, 3.0, seed):
        torque = observer.step(sample)
        if sample.stamp_ns > 3.2e9:
            late.append(torque.copy())
    (contact,) = observer.contacts
    assert 0.0 <= 1e-9 * contact.begin_ns - 3.0 < 0.03
    assert contact.joint in (1, 3)
    assert contact.end_ns is None
    assert np.abs(np.mean(late, axis=0) - external).max() < 0.3
    wrench, std = observer.wrench()
    assert (std > 0.0).all() and np.isfinite(wrench).all()


def test_parameters_may_change_at_any_time() -> None:
    """New parameters each 20 ms, a little other each time, look like no push."""
    model, observer = panda_model(), learned_observer()
    rng = np.random.default_rng(1)
    for k, sample in enumerate(samples_with(np.zeros(7), 5.0)):
        if k % 20 == 0:
            theta = model.theta * (1.0 + 1e-3 * rng.standard_normal(model.theta.shape))
            observer.adopt(model.lam, theta, NONE, NONE, STD)
        observer.step(sample)
    assert observer.contacts == []


def test_what_new_parameters_explain_is_no_push() -> None:
    """An arm whose model has 10 kg too many at the hand, until it is learned in motion."""
    model, heavy = panda_model(), panda_model().theta.copy()
    heavy[-1, 0] += 10.0
    observer = ContactObserver(replace(model, theta=heavy))
    samples = samples_with(np.zeros(7), 5.0)
    before: np.ndarray = np.zeros(7)
    for k, sample in enumerate(samples):
        if k == 2500:
            before = observer.torque.copy()
            assert not observer.learned and np.abs(before).max() > 8.0
            observer.adopt(model.lam, model.theta, NONE, NONE, STD)
            gone = before - observer.torque
            np.testing.assert_allclose(observer.explained, gone, atol=1e-9)
            np.testing.assert_allclose(observer.expected, sample.tau, atol=3.0)
        observer.step(sample)
        if k >= 2500:
            assert observer.learned and np.abs(observer.torque).max() < 3.0
    assert np.abs(before).max() > 8.0


def test_one_reading_that_cannot_be_is_not_believed_whole() -> None:
    """20 rad/s more in one reading, of one joint after the other: less than half of the effort."""
    observer, worst = learned_observer(), 0.0
    effort = panda_model().limits.effort
    for k, sample in enumerate(samples_with(np.zeros(7), 5.0)):
        dq = sample.dq.copy()
        if k % 200 == 199:
            dq[k // 200 % 7] += 20.0
        torque = observer.step(replace(sample, dq=dq))
        worst = max(worst, float(np.abs(torque / effort).max()))
    assert 0.05 < worst < 0.5


def test_what_is_no_number_changes_nothing() -> None:
    """Readings and parameters that are not finite, holes, a clock that is set back."""
    model, observer = panda_model(), learned_observer()
    samples = samples_with(np.zeros(7), 5.0)
    for k, sample in enumerate(samples):
        if k % 97 == 0:
            observer.step(JointSample(sample.stamp_ns, sample.q, sample.dq * np.nan, sample.tau))
            observer.adopt(model.lam, model.theta * np.nan, NONE, NONE, STD)
        if k % 1000 == 500:
            observer.step(JointSample(0, sample.q, sample.dq, sample.tau))
        if k % 700 < 650:
            assert np.isfinite(observer.step(sample)).all()
    assert observer.contacts == []


def torque_of(kind: Kind, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
    """(m, n) N m, by Pinocchio, of 1 kg that hangs on the hand, or 10 N along y of the base."""
    bare = pin_model(panda())
    if kind == Kind.LOAD:
        held = pin_model(panda(), payload(1.0, (0.0, 0.02, 0.12)))
        return rnea(held, q, dq, ddq) - rnea(bare, q, dq, ddq)
    data, tau = bare.createData(), np.empty_like(q)
    for row, angles in zip(tau, q, strict=True):
        jacobian = pin.computeJointJacobian(bare, data, angles, 7)
        row[:] = -jacobian[:3].T @ data.oMi[7].rotation.T @ np.array([0.0, 10.0, 0.0])
    return tau


@pytest.mark.parametrize("kind", [Kind.LOAD, Kind.PUSH])
@pytest.mark.parametrize("seed", [5, 6, 7])
def test_a_load_is_told_from_a_push_aside(kind: Kind, seed: int) -> None:
    """What begins after 2 s."""
    data, model = record(arm(), Motion(4.0, seed, low_hz=0.3)), panda_model()
    more = torque_of(kind, *data.true[:3])
    more[:2000] = 0.0
    observer = learned_observer()
    for sample in replace(data, tau=data.tau + more).samples():
        observer.step(sample)
    contact = observer.contacts[0]
    assert 0.0 <= 1e-9 * contact.begin_ns - 2.0 < 0.05
    assert kind_of(contact, observer.frames, model.gravity, model.limits.effort) == kind


def test_friction_that_is_documented_and_learned_counts_once() -> None:
    """Each joint's 0.5 N m s/rad; counted twice it would push the arm with 0.5 dq."""
    model, name = panda_model(), "viscous_friction"
    known = {"effect": name, "parameters": {"Fv": 0.5}}
    rough = replace(model, effects=tuple({**known, "joints": [j]} for j in range(1, 8)))
    data = record(arm(), Motion(4.0, 3, low_hz=0.1))
    observer = ContactObserver(rough, (name,))
    observer.adopt(model.lam, model.theta, np.full((1, 7), 0.5), np.full((1, 7), np.nan), STD)
    samples = replace(data, tau=data.tau + 0.5 * data.true[1]).samples()
    assert np.abs(data.dq[:, 4:]).max() > 1.0
    assert max(np.abs(observer.step(sample)[4:]).max() for sample in samples) < 0.3
    assert observer.contacts == []


def test_a_contact_ends_a_motion_where_that_is_asked_for() -> None:
    """Not by the documented model, not without leave; by what was learned, with joint and size."""
    external = np.array([0.0, 8.0, 0.0, 6.0, 0.0, 0.0, 0.0])
    model = panda_model()
    for stops in (False, True):
        following = FollowingObserver(ContactObserver(model), stops, model.tree.joint_names)
        board = SnapshotWriter.create(model.tree.joint_names, name=None)
        try:
            following.attach(board.name)
            some = nothing_known(7, 7, 0)
            known = {"lam": model.lam, "theta": model.theta, "torque_std": STD}
            board.publish(replace(some, **known, lam_converged=True, theta_converged=True))
            alarms = []
            for sample in samples_with(external, 3.0):
                following.step(sample)
                if following.alarm is not None:
                    alarms.append((1e-9 * sample.stamp_ns, following.alarm))
            assert bool(alarms) == stops
            if stops:
                assert 3.0 <= alarms[0][0] < 3.03
                assert "panda_joint" in alarms[0][1] and "standard deviations" in alarms[0][1]
            with SnapshotReader(board.name) as reader:
                told = reader.read_external()
            observer, (wrench, wrench_std) = following.observer, following.observer.wrench()
            assert told.learned and told.contact_joint in (1, 3) and told.version == 4000
            assert told.stamp_ns == sample.stamp_ns
            np.testing.assert_array_equal(told.torque, observer.torque)
            np.testing.assert_array_equal(told.torque_std, observer.std)
            np.testing.assert_array_equal(told.wrench, wrench)
            np.testing.assert_array_equal(told.wrench_std, wrench_std)
        finally:
            following.detach()
            board.unlink()
            board.close()
