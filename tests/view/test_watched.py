"""What is shown of a run: against the learner itself, another kinematics, and in a real browser."""

from __future__ import annotations

import json
import re
import struct
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from mcap_ros2._dynamic import generate_dynamic  # not what encoded it
from rich.console import Console
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from adapter.cli.display import LiveTable, table_of
from adapter.control.observer import ContactObserver
from adapter.learning.settings import LearnerSettings
from adapter.realtime.ring import Ring
from adapter.realtime.session import run_lockstep
from adapter.realtime.showing import Looker, View
from adapter.realtime.snapshot import ExternalTorque, SnapshotReader, SnapshotWriter
from adapter.realtime.timing import Histogram, LoopBoard, Timing
from adapter.runs.config import PipelineSettings
from adapter.runs.live import FIRST_S, Publisher, news_of, single_thread_learner
from adapter.runs.pipeline import make_front_end
from adapter.signals.records import stamp_of
from adapter.view import foxglove_view
from adapter.view.foxglove_view import FoxgloveView, free_port
from adapter.view.now import KnownRun, Now, Onlooker
from adapter.view.page import LivePage, Messages, encode, page_of
from adapter.view.server import address, bind
from tests.helpers.browser import ids_of_a_page_that_fetches_nothing, tab
from tests.helpers.live_tools import PANDA, parts, simulated_arm
from tests.helpers.robot_models import PANDA as PANDA_URDF

SECONDS = 5.5
PROTOCOLS = [Subprotocol("foxglove.sdk.v1")]
CONTACT = {"contact_joint": 3, "learned": True}
FOUND = {
    "what": "viscous_friction",
    "joints": [2],
    "since_s": 1.5,
    "reported_s": 2.25,
    "over_s": None,
    "size": {"Fv": 0.75},
    "score": 9.0,
    "ambiguous_with": [{"what": "coulomb_friction", "joints": [2]}],
    "line": "viscous friction (or coulomb friction) since 1.5 s",
}
EVERY = 50  # states between two looks
TICK_NS = 200_000
FRICTION = ("viscous_friction", "coulomb_friction")


@dataclass
class Seen:
    """A run: what was known of it, what a display saw, and the arm's own truth beside.

    Attributes:
        known: the run.
        views: in order; the last one is done.
        states: all filtered states, (m, size).
        residuals: (n,) N m of the newest state of each look, by the learner itself.
    """

    known: KnownRun
    views: list[View]
    states: np.ndarray
    residuals: list[np.ndarray]


def seen_run(seconds: float) -> Seen:
    """Drive the simulated arm, learn, publish, look: all of it real, in one thread."""
    pipeline = PipelineSettings(learner=LearnerSettings(effects=FRICTION))
    known = KnownRun(PANDA, FRICTION, "pybullet:panda", seconds, "a run")
    learner, publish = single_thread_learner(PANDA, pipeline, None), Publisher()
    front_end, controller = make_front_end(PANDA, pipeline), parts()[1]
    ring = Ring.create(front_end.layout.size, 4000)
    names = PANDA.tree.joint_names
    board, loop = SnapshotWriter.create(names, FRICTION, name=None), LoopBoard.create()
    reader, observer = SnapshotReader(board.name), ContactObserver(PANDA, FRICTION)
    looker, timing, views = Looker(ring, reader, loop), Timing(loop.bins), list[View]()
    states, residuals = list[np.ndarray](), list[np.ndarray]()

    class Published:
        """A learner whose estimate is published, and looked at."""

        def step(self, state: np.ndarray) -> None:
            if not states:
                loop.write_begin(int(state[:1].view(np.int64)[0]))
            states.append(state.copy())
            learner.step(state)
            ring.push(state)
            ring.release(1)
            timing.add(len(states) * 10**6, len(states) * 10**6, len(states) * 10**6 + TICK_NS, 0)
            if len(states) % EVERY == 0:
                board.publish(publish(learner))
                board.publish_news(news_of(learner))
                views.append(looker.look(False))
                tau = state[front_end.layout.joint_tau]
                residuals.append(tau - learner.predict(state[None])[0])

    def watch(sample, command) -> None:
        torque = observer.step(sample)
        wrench = observer.wrench()
        push = ExternalTorque(torque, observer.std, *wrench, None, False, sample.stamp_ns)
        board.publish_external(push)

    run_lockstep(simulated_arm(), front_end, Published(), controller, seconds, each=watch)
    loop.write_end("duration", None)
    ring.finish()
    views.append(replace(looker.look(True), elapsed_s=views[-1].elapsed_s + 1.0))
    for part in (reader, board, loop, ring):
        part.close()
    for made in (board, loop, ring):
        made.unlink()
    return Seen(known, views, np.array(states), residuals)


def again(views: list[View]) -> Iterator[View]:
    """The same without the end."""
    return (view for view in views if not view.done)


@pytest.fixture(scope="module")
def seen() -> Seen:
    return seen_run(SECONDS)


@pytest.fixture(scope="module")
def course(seen: Seen) -> list[Now]:
    """What was to be shown, look by look."""
    onlooker = Onlooker(seen.known)
    return [onlooker.look(view) for view in seen.views]


def test_the_residual_is_the_learners_own(seen: Seen, course: list[Now]) -> None:
    known = [now for now in course if np.isfinite(now.residual).all() and not now.view.done]
    assert len(known) > 20
    off = [
        np.abs(now.residual - expected) / now.noise
        for now, expected in zip(known, seen.residuals[-len(known) :], strict=True)
    ]
    assert np.median(off) < 0.01 and np.quantile(off, 0.98) < 0.5  # friction turns more smoothly
    assert all((now.rms > 0.0).all() for now in known)


def test_the_course_of_a_run(course: list[Now], seen: Seen) -> None:
    assert course[0].headline == "Learning where the joints sit (λ)"
    assert np.isnan(course[0].residual).all() and course[0].joint_states[0] == "not learned yet"
    assert course[-2].headline == "Learning what the links weigh (θ); λ has converged"
    early = [now for now in course if now.t_s < FIRST_S]
    assert not any("converged" in f"{now.headline} {now.lam_state}" for now in early)
    assert course[-1].headline == "Ended: the planned time is over"
    lasted_s = 1e-9 * (stamp_of(seen.states[-1]) - stamp_of(seen.states[0]))
    assert abs(course[-1].t_s - lasted_s) < 0.2 and course[0].t_s < 0.2
    off = course[-1].frames
    assert off is not None and np.abs(off.off).max() < 1e-6 and off.hidden.sum() == 6
    states = [(now.lam_state, now.theta_state) for now in course]
    assert states == sorted(states, key=[*dict.fromkeys(states)].index)  # never back


def test_the_skeleton_stands_where_pinocchio_puts_it(course: list[Now], seen: Seen) -> None:
    messages = Messages(Onlooker(seen.known))
    arms = messages.take(course[-1])["frame"]["arms"]
    model = pin.buildModelFromUrdf(str(PANDA_URDF))
    data, q = model.createData(), course[-1].q
    pin.forwardKinematics(model, data, q)
    wanted = np.array([data.oMi[j + 1].translation for j in range(7)])
    np.testing.assert_allclose(arms["documented"]["joints"], wanted, atol=1e-4)
    np.testing.assert_allclose(arms["learned"]["joints"], wanted, atol=1e-4)
    axes = np.array([data.oMi[j + 1].rotation[:, 2] for j in range(7)])
    np.testing.assert_allclose(arms["learned"]["axes"], axes, atol=1e-4)


def test_timing_of_the_last_seconds_alone(course: list[Now]) -> None:
    whole = course[-1].view.timing
    assert whole is not None and course[-1].lately is not None
    ticks = whole.of("loop_us")
    assert ticks.count > 1000 * SECONDS - 200
    assert abs(ticks.percentile_us(99.0) - 1e-3 * TICK_NS) < 1.0
    assert Histogram.of(whole.bins[0]).count == ticks.count
    assert 0 < course[-1].lately.of("loop_us").count <= ticks.count


def troubled(seen: Seen) -> Now:
    """The last instant, with a contact, a finding and a load: what a page has to make loud."""
    onlooker = Onlooker(seen.known)
    for view in again(seen.views):
        last = view
        onlooker.look(view)
    begin_s = 1e-9 * last.began_ns
    found = {k: v + begin_s if k in ("since_s", "reported_s") else v for k, v in FOUND.items()}
    load = {"m": 0.5231, "m_std": 0.0112, "since_s": begin_s + 2.0}
    news = {**last.news, "findings": [found], "load": load}
    push = replace(last.push, torque=np.arange(7.0) + 10.0, **CONTACT)
    return onlooker.look(replace(last, news=news, push=push, lines=["a <b>line</b>"]))


def test_words_of_trouble(seen: Seen) -> None:
    now = troubled(seen)
    assert now.headline == "Contact: something pushes panda_joint4" and now.contact == 3
    assert now.joint_states[3] == "contact" and now.joint_states[1] == "viscous friction"
    assert now.load is not None and abs(now.load["since_s"] - 2.0) < 1e-6
    news = Messages(Onlooker(seen.known)).take(now)["news"]
    (finding,) = news["findings"]
    assert finding["title"] == "viscous friction" and finding["or"] == ["coulomb friction"]
    assert finding["size"] == [["Fv", 0.75, "N m s/rad"]]
    assert abs(finding["since_s"] - 1.5) < 1e-6
    failed = replace(now.view, ended=("driver_error", "the cable came off"))
    assert Onlooker(seen.known).look(failed).headline.startswith("Ended: the cable came off")
    behind = replace(now.view, push=None, waiting=31_000)
    assert "31000 samples behind" in Onlooker(seen.known).look(behind).headline


def test_messages_are_small_and_plain(seen: Seen, course: list[Now]) -> None:
    messages = Messages(Onlooker(seen.known))
    for now in course:
        for kind, message in messages.take(now).items():
            assert len(encode(message)) < 6000, kind
    history = json.loads(messages.history())
    assert len(history["frames"]) == len(course) and 3 < len(history["estimates"]) <= len(course)


def test_the_table_on_a_terminal(seen: Seen) -> None:
    text = Console(width=90, no_color=True, force_terminal=False)
    with text.capture() as captured:
        text.print(table_of(troubled(seen), seen.known))
    lines = captured.get().splitlines()
    assert lines[0].startswith("Contact: something pushes panda_joint4")
    assert [line.split()[0] for line in lines if "panda_joint" in line][1:] == [
        f"panda_joint{j}" for j in range(1, 8)
    ]
    assert any("load 0.523 ± 0.011 kg · contact joint 4" in line for line in lines)
    assert any("tick p99 200 µs, 0 deadlines missed" in line for line in lines)
    assert max(map(len, lines)) <= 90


def test_lines_come_out_above_the_table(seen: Seen, tmp_path: Path) -> None:
    """On a terminal that is emulated: what stays on it when the table is gone."""
    path = tmp_path / "typescript"
    with path.open("w") as file:
        shown = Console(file=file, force_terminal=True, width=100, height=40)
        table = LiveTable(seen.known, shown)  # type: ignore[arg-type]
        for k, view in enumerate(seen.views[::8]):
            table(replace(view, lines=["the recorder process died"] if k > 3 else []))
        table(seen.views[-1])
    rows, row = [""] * 400, 0
    text = path.read_bytes().decode().replace("\r", "")
    for part in filter(None, re.split(r"(\x1b\[[0-9;?]*[A-Za-z]|\n)", text)):
        if part == "\n":
            row += 1
        elif part == "\x1b[1A":
            row -= 1
        elif part == "\x1b[2K":
            rows[row] = ""
        elif not part.startswith("\x1b"):
            rows[row] = part if part.strip("\r") else rows[row]
    left = [line.strip() for line in rows if line.strip()]
    assert left == ["the recorder process died"]


def test_the_page_needs_nothing_but_itself(seen: Seen) -> None:
    page, policy = page_of(seen.known)
    assert "default-src 'none'" in policy and "connect-src 'self'" in policy
    without_icon = page.replace('<link rel="icon" href="data:,">', "")
    ids_of_a_page_that_fetches_nothing(f'<meta content="{policy}">{without_icon}')
    assert "innerHTML" not in page


@pytest.mark.parametrize("width", [1200, 390, 360])
def test_the_page_in_a_browser(seen: Seen, tmp_path: Path, width: int) -> None:
    """Numbers, words and pictures of a run with trouble; nothing wider than the window."""
    listening = bind(0)
    shown = LivePage(Onlooker(seen.known), listening)
    now = troubled(seen)
    with tab(tmp_path) as page:
        page.size(width, 900, dark=width == 360)
        page.open(address(listening))
        page.wait_for("document.getElementById('who')?.textContent.includes('pybullet')")
        shown(now)
        page.wait_for("document.getElementById('headline').textContent.startsWith('Contact')")
        text = page.value("document.body.innerText")
        for words in ("0.523 ± 0.011 kg", "viscous friction (or coulomb friction)", "joint4"):
            assert words in text
        assert "on joint2, from 1.50 s on" in text and "a <b>line</b>" in text
        assert page.value("document.documentElement.scrollWidth") <= width
        assert page.value(PAINTED) > 0.9
        page.value("document.querySelectorAll('input[name=joint]')[1].click()")
        title = "document.getElementById('theta-title').textContent"
        page.wait_for(f"{title} === 'θ: inertial parameters of link2'")
        assert len(page.picture()) > 20_000 and page.console == []
        shown(replace(now, headline="Ended: somebody stopped it", view=seen.views[-1]))
        page.wait_for("document.getElementById('badge').textContent === 'ended'")
        assert page.value("document.getElementById('headline').textContent").startswith("Ended")
        assert "0.523 ± 0.011 kg" in page.value("document.body.innerText")  # the last state stays


# Share of the residuals' and parameters' pictures that are not empty.
PAINTED = """(() => {
  const all = [...document.querySelectorAll('#residuals canvas, #arm')];
  const full = all.filter((c) => c.getContext('2d').getImageData(0, 0, c.width, c.height)
    .data.some((v) => v > 0));
  return full.length / all.length;
})()"""


def test_a_page_comes_back_by_itself(seen: Seen, tmp_path: Path) -> None:
    """The process dies and another serves the same run, then a new run, at the same address."""
    listening = bind(0)
    port = listening.getsockname()[1]
    first = LivePage(Onlooker(seen.known), listening)
    onlooker = Onlooker(seen.known)
    for view in again(seen.views):
        first(onlooker.look(view))
    with tab(tmp_path) as page:
        page.size(1200, 900)
        page.open(f"http://127.0.0.1:{port}/")
        page.wait_for("document.getElementById('clock')?.textContent.includes('s of')")
        first._server.stop()
        page.wait_for("document.getElementById('badge').textContent.includes('trying again')")
        other = replace(seen.known, key="another", driver="fci://arm")
        second = LivePage(Onlooker(other), bind(port))
        second(Onlooker(other).look(seen.views[3]))
        page.wait_for("document.getElementById('badge').textContent === 'live'")
        page.wait_for("document.getElementById('who').textContent.includes('fci://arm')")
        page.wait_for("document.getElementById('headline').textContent.includes('Learning where')")
        second._server.stop()


def test_foxgloves_protocol(seen: Seen, course: list[Now]) -> None:
    """A client subscribes to every topic and decodes it by the definition that came along."""
    port = free_port(0)
    shown = FoxgloveView(seen.known, port)
    now = troubled(seen)
    got: dict[str, list] = {}
    place = f"ws://127.0.0.1:{port}"
    with connect(place, close_timeout=0.5, subprotocols=PROTOCOLS) as client:
        channels: dict[int, dict] = {}
        while len(channels) < len(foxglove_view.TOPICS):
            told = json.loads(client.recv(timeout=20))
            if told["op"] == "advertise":
                channels |= {channel["id"]: channel for channel in told["channels"]}
            else:
                assert told["op"] == "serverInfo" and told["capabilities"] == []
        wanted = [{"id": number, "channelId": number} for number in channels]
        client.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        decoders: dict[int, Callable[[bytes], Any]] = {}
        feed = threading.Thread(target=_feed, args=(shown, now))
        feed.start()
        while len(got) < len(channels):
            data = client.recv(timeout=20)
            if isinstance(data, str):
                continue
            opcode, number, stamp_ns = struct.unpack_from("<BIQ", data)
            channel = channels[number]
            assert opcode == 1 and channel["encoding"] == "cdr"
            if number not in decoders:
                made = generate_dynamic(channel["schemaName"], channel["schema"])
                decoders[number] = made[channel["schemaName"]]
            message = decoders[number](data[13:])
            got.setdefault(channel["topic"], []).append((stamp_ns, message))
        feed.join()
    assert got.keys() == foxglove_view.TOPICS.keys()
    stamp_ns, state = got["/joint_states"][-1]
    assert stamp_ns == now.stamp_ns and state.name == list(PANDA.tree.joint_names)
    np.testing.assert_array_equal(state.position, now.q)
    np.testing.assert_array_equal(got["/residuals"][-1][1].effort, now.residual)
    np.testing.assert_array_equal(got["/external_torques"][-1][1].effort, np.arange(7.0) + 10.0)
    told = got["/estimates"][-1][1]
    assert [body.value.m for body in told.bodies] == now.view.snapshot.theta[:, 0].tolist()
    assert (got["/load"][-1][1].mass, got["/load"][-1][1].mass_std) == (0.5231, 0.0112)
    assert got["/state"][-1][1].data == now.headline
    assert got["/findings"][-1][1].status[0].message == FOUND["line"]
    assert got["/timing"][-1][1].ticks >= now.view.timing.of("loop_us").count
    assert got["/robot_description"][-1][1].data.lstrip().startswith("<?xml")
    model = pin.buildModelFromUrdf(str(PANDA_URDF))  # both arms' hands stand where it puts them
    data = model.createData()
    pin.forwardKinematics(model, data, now.q)
    chain = {x.child_frame_id: x for x in got["/tf"][-1][1].transforms}
    assert {x.header.frame_id for x in got["/tf_static"][-1][1].transforms} >= {"world"}
    for prefix in ("documented/", "learned/"):
        place, name = pin.SE3.Identity(), prefix + PANDA.tree.link_names[-1]
        while name in chain:
            step = chain[name]
            turn, shift = step.transform.rotation, step.transform.translation
            turned = pin.Quaternion(turn.w, turn.x, turn.y, turn.z).matrix()
            place = pin.SE3(turned, np.array([shift.x, shift.y, shift.z])) * place
            name = step.header.frame_id
        assert name == prefix + PANDA.tree.base_name
        np.testing.assert_allclose(place.homogeneous, data.oMi[7].homogeneous, atol=1e-6)


def _feed(shown: FoxgloveView, now: Now) -> None:
    view = now.view
    for k in range(40):  # a subscription takes a moment
        view = replace(view, elapsed_s=view.elapsed_s + 3.0)
        new = [replace(part, version=100 + k) for part in (view.snapshot, view.push)]
        timing = replace(view.timing, bins=view.timing.bins + k)
        shown(replace(now, view=replace(view, snapshot=new[0], push=new[1], timing=timing)))
        time.sleep(0.05)
    shown._server.stop()


def test_a_port_of_foxglove_that_is_taken() -> None:
    taken = bind(0)
    port = taken.getsockname()[1]
    with pytest.raises(Exception, match=rf"port {port} .*--foxglove 0"):
        free_port(port)
    taken.close()
