"""Mutated inputs into decoders and commands: `make trials`.

An input may be taken or refused in a sentence; a traceback, a crash, more than 5 s or more than
1 GB are faults, and the input is kept. Every decoder runs in a process of its own, whose memory is
limited. Inputs are good ones with bytes or words changed, cut, doubled or put in, drawn by seed.
"""

from __future__ import annotations

import contextlib
import io
import json
import resource
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tests.helpers.benchmark import options, write

LIMIT_S, LIMIT_BYTES = 5.0, 2**30
WORDS = (
    *(b"nan", b"inf", b"-1", b"0", b"1e999", b"-1e-999", b"9" * 40, b"null", b"true", b"[]", b"{}"),
    *(b"[" * 2000, b'{"a":' * 2000, b'"', b"'", b"\\ud800", b"\xff\xfe", b"\0", b"<!--", b"</"),
    *(b"<", b"&a;", b"[/bold]", b"%s", b"../..", b"\r\n", b",", b";", b"", b" "),
)
CELL = b"""[cell]
table = true
reach = 0.8
margin = 0.05
[[cell.box]]
name = "crate"
size = [0.4, 0.3, 0.2]
xyz = [0.6, 0.0, 0.1]
rpy = [0.0, 0.0, 0.5]
[[cell.cylinder]]
name = "post"
radius = 0.05
length = 1.0
xyz = [0.0, 0.7, 0.5]
[[cell.plane]]
name = "wall"
normal = [1.0, 0.0, 0.0]
offset = -0.6
[cell.hand]
length = 0.1
radius = 0.06
"""
MJCF = b"""<mujoco model="arm"><compiler angle="radian"/><worldbody><body name="base">
<geom type="box" size="0.1 0.1 0.1"/><body name="upper" pos="0 0.1 0.2" euler="0.2 0.3 0.5">
<inertial pos="0.01 0 0.1" mass="2" fullinertia="0.02 0.018 0.01 0.001 0 0.002"/>
<joint name="shoulder" axis="0 1 0" pos="0.02 0 -0.05" ref="0.2" range="-1.6 2" limited="true"/>
<body name="lower" pos="0 0 0.3"><geom type="capsule" size="0.03 0.1" pos="0 0 0.1"/>
<joint name="elbow" axis="0.6 0 0.8" armature="0.3" stiffness="2" damping="0.1"/></body></body>
</body></worldbody><actuator><motor joint="elbow" ctrlrange="-30 30"/></actuator></mujoco>
"""
LINK = """<link name="l{0}"><inertial><origin xyz="0 0.01 0.1"/><mass value="{1}"/>
<inertia ixx="0.02" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{0}" type="revolute"><parent link="l{1}"/>
<child link="l{2}"/><axis xyz="0 1 0"/>
<origin xyz="0 0 0.2" rpy="0.3 0 0.2"/>
<limit lower="-2" upper="2" velocity="3" effort="50"/></joint>"""
JOINTS = enumerate(("shoulder", "elbow", "wrist"), 1)  # of the recordings
PARTS = [LINK.format(0, 4), *(LINK.format(k, 3) + JOINT.format(x, k - 1, k) for k, x in JOINTS)]
URDF = ('<robot name="arm">' + "".join(PARTS) + "</robot>").encode()
CSV = b"time,q,dq,tau\n" + b"".join(b"%.3f,1.5,2e-3,-7\n" % (1e-3 * k) for k in range(20))
NUMBERS = (0, 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1)
Refusals = tuple[type[BaseException], ...]


class Decoder(NamedTuple):
    """Good inputs, what reads one, what it refuses with, and its share of the inputs."""

    seeds: list[bytes]
    read: Callable[[bytes], object]
    refuses: Refusals
    share: float
    text: bool = False


def mutated(rng: np.random.Generator, seed: bytes, text: bool) -> bytes:
    """A copy with one to four changes."""
    data = bytearray(seed)
    for _ in range(int(rng.integers(1, 5))):
        begin, end = sorted(rng.integers(len(data) + 1, size=2).tolist())
        kind = int(rng.integers(7))
        if kind == 0 and data:
            data[begin % len(data)] = int(rng.integers(256))
        elif kind == 1 and data:
            data[begin % len(data)] ^= 1 << int(rng.integers(8))
        elif kind == 2:
            del data[begin : min(end, begin + 64)]
        elif kind == 3 and rng.random() < 0.3:
            del data[begin:]
        elif kind == 4:
            data[begin:begin] = data[begin : min(end, begin + 256)]
        elif kind == 5 or text:
            end = _end_of_word(data, begin) if text else begin + 1
            data[begin:end] = WORDS[int(rng.integers(len(WORDS)))]
        else:
            data[begin : begin + 8] = struct.pack("<Q", NUMBERS[int(rng.integers(len(NUMBERS)))])
    return bytes(data)


def _end_of_word(data: bytearray, begin: int) -> int:
    """Behind the number or word at a place."""
    end = begin
    while end < len(data) and end < begin + 40 and data[end] not in b' ",:;[]{}<>=\n':
        end += 1
    return end


def wires() -> dict[str, Decoder]:
    """What arms send."""
    from can.interfaces.udp_multicast.utils import pack_message

    from drivers.damiao import codec as damiao
    from drivers.damiao.bus import message_for, unpack_datagram
    from drivers.damiao.settings import BusSettings
    from drivers.damiao.tables import troubles_of
    from drivers.fci import codec as fci
    from drivers.fci.codec import ReplyParser, StateDecoder, WireError, connect_reply, status_reply
    from sim.fci.codec import BadRequest, RequestReader, read_command
    from sim.fci.gripper import HEADER, GripperServer
    from tests.helpers import fci_peer
    from tests.helpers.damiao_tools import LIMITS, reply_bytes

    scales, good = damiao.Scales(*LIMITS[0]), reply_bytes(1, 1, LIMITS[0], 1.0, 2.0, 3.0)

    def states(protocol: int) -> Callable[[bytes], object]:
        decoder = StateDecoder(protocol)
        return lambda data: decoder.decode(memoryview(data))

    def replies(data: bytes) -> None:
        for reply in ReplyParser().feed(data):
            connect_reply(reply.payload)
            status_reply(reply.payload)

    hand = GripperServer(port=0)

    def to_hand(data: bytes) -> None:
        ours, theirs = socket.socketpair()
        with ours, theirs:
            theirs.setblocking(False)
            hand._tcp = theirs
            ours.sendall(data)
            for _ in range(4):
                hand.poll()
            hand._drop()

    grip = HEADER.pack(0, 1, HEADER.size + 4) + struct.pack("<HH", 3, 9000)
    grip += HEADER.pack(3, 2, HEADER.size + 16) + struct.pack("<2d", 0.04, 0.1)
    grip += HEADER.pack(2, 3, HEADER.size + 40) + struct.pack("<5d", 0.03, 0.01, 0.01, 0.1, 20.0)
    parts = ((0, struct.pack("<BH", 0, 5)), (1, b"\1\0\0"), (12, b"\2\0\0"))
    stream = b"".join(fci_peer.reply(c, k, payload) for k, (c, payload) in enumerate(parts))
    message = message_for(BusSettings("x"), 0x11, good)
    register = damiao.write_register(1, damiao.PMAX, 12.5)
    asked = fci.request(0, 1, struct.pack("<HH", 5, 4000)) + fci.request(2, 2) + fci.request(12, 3)
    found = {
        f"fci state {p}": Decoder(
            [fci_peer.state(p, 5, q=range(7), modes=(1, 2, 2))], states(p), (WireError,), 0.12
        )
        for p in (5, 10)
    }
    return {
        **found,
        "fci requests": Decoder(
            [asked, fci.request(1, 1, struct.pack("<II", 2, 1) + bytes(48))],
            lambda x: [a.move_modes() for a in RequestReader(5).feed(x) if a.name == "Move"],
            (BadRequest,),
            0.05,
        ),
        "gripper requests": Decoder([grip], to_hand, (), 0.02),
        "fci command": Decoder([bytes(370)], lambda x: read_command(x, 5), (), 0.05),
        "fci replies": Decoder([stream], replies, (WireError,), 0.12),
        "can reply": Decoder([good], lambda x: damiao.state(scales, x), (damiao.WireError,), 0.15),
        "can register": Decoder(
            [register],
            lambda x: damiao.register_reply(x, 1, damiao.WRITE, damiao.PMAX),
            (damiao.WireError,),
            0.12,
        ),
        "can datagram": Decoder(
            [pack_message(message)], lambda x: unpack_datagram(x, 1.0), (), 0.12
        ),
        "can error frame": Decoder(
            [b"\0" * 12], lambda x: troubles_of(int.from_bytes(x[:4]) >> 3, x[4:12], "c"), (), 0.08
        ),
    }


def files(folder: Path) -> dict[str, Decoder]:
    """What disks hold."""
    from adapter.effects.robots import read_robot
    from adapter.errors import ModelError, SettingsError
    from adapter.learning.checkpoint import load_checkpoint, save_checkpoint
    from adapter.model.model_file import dumps, loads
    from adapter.model.robots import documented
    from adapter.model.urdf import model_from_urdf
    from adapter.runs.config import read_config
    from adapter.runs.score import reference_from
    from adapter.signals.source_table import read_npz, read_table
    from drivers.files.bounded import parse_json
    from drivers.files.mcap import read_log, recover, survey
    from drivers.interface import DriverError
    from tests.helpers.arm_data import learner_for
    from tests.helpers.mcap_tools import foreign, payloads, record, samples
    from tests.helpers.robot_models import PANDA

    robot = documented("panda")
    model = dumps(robot).encode()
    ours = record(folder / "a.mcap", samples(30, links=True), every=10).read_bytes()
    other = foreign(folder / "b.mcap", payloads(samples(40))).read_bytes()
    table = folder / "t.npz"
    np.savez_compressed(table, time=np.arange(20.0), q=np.ones((20, 3)), dq=np.zeros((20, 3)))
    np.savez(folder / "u.npz", time=np.arange(20.0), q=np.ones((20, 3)))
    save_checkpoint(learner_for(), folder / "c.npz")
    toml = b"gravity = [9.81, 0.0, 0.0]\n[tool]\nmass = 0.73\ncom = [0.0, 0.0, 0.06]\n"
    toml += b"[pipeline.filter]\nbandwidth_hz = 6.0\n[excitation]\nseed = 3\n"

    def at(name: str, read: Callable[[Path], object]) -> Callable[[bytes], object]:
        def from_file(data: bytes) -> object:
            path = folder / name
            path.write_bytes(data)
            return read(path)

        return from_file

    def mended(path: Path) -> object:
        (folder / "mended.mcap").unlink(missing_ok=True)
        return recover(path, folder / "mended.mcap")

    def text(parse: Callable[[str], object]) -> Callable[[bytes], object]:
        return lambda data: parse(data.decode("utf-8", "replace"))

    driver, wrong = (DriverError,), (ModelError,)
    return {
        "mcap": Decoder([ours, other], at("x.mcap", read_log), driver, 0.03),
        "mcap survey": Decoder([ours, other], at("y.mcap", survey), driver, 0.02),
        "mcap recover": Decoder([ours, other], at("z.mcap", mended), driver, 0.005),
        "json": Decoder([model], parse_json, (ValueError,), 0.06, True),
        "model.json": Decoder([model], text(loads), wrong, 0.01, True),
        "urdf": Decoder([PANDA.read_bytes()], text(model_from_urdf), wrong, 0.005, True),
        "toml": Decoder([toml], at("x.toml", read_config), (SettingsError,), 0.03, True),
        "mjcf": Decoder([MJCF], at("x.xml", read_robot), wrong, 0.003, True),
        "cell": Decoder([CELL], at("c.toml", read_config), (SettingsError,), 0.03, True),
        "csv": Decoder([CSV], at("x.csv", read_table), driver, 0.03, True),
        "npz": Decoder(
            [table.read_bytes(), (folder / "u.npz").read_bytes()],
            at("x.npz", read_npz),
            driver,
            0.02,
        ),
        "checkpoint": Decoder(
            [(folder / "c.npz").read_bytes()],
            at("x.npz", lambda path: load_checkpoint(learner_for(), path)),
            (SettingsError,),
            0.0005,
        ),
        "truth": Decoder(
            [model], at("t.json", lambda path: reference_from(path, robot)), wrong, 0.002, True
        ),
    }


def memory() -> dict[str, Decoder]:
    """The published estimate."""
    from adapter.realtime import SnapshotError, SnapshotReader, SnapshotWriter

    writer = SnapshotWriter.create(("a", "b", "c"), ("viscous_friction",), name=None)
    raw = writer._block._memory
    assert raw is not None and raw.buf is not None
    seed = bytes(raw.buf)
    writer.close()
    writer.unlink()
    block = SharedMemory(create=True, size=len(seed))

    def read(data: bytes) -> None:
        assert block.buf is not None
        block.buf[:] = data[: len(seed)].ljust(len(seed), b"\0")
        reader = SnapshotReader(block.name)
        try:
            reader.read(timeout_s=0.0)
            reader.read_external(timeout_s=0.0)
        finally:
            reader.close()

    return {"snapshot": Decoder([seed], read, (SnapshotError,), 0.02)}


def commands(folder: Path) -> dict[str, Decoder]:
    """Commands on mutated files; their exit code is one of the table's."""
    from adapter.cli.exit_codes import ExitCode
    from adapter.cli.main import main
    from adapter.model.model_file import dumps
    from adapter.model.robots import documented
    from tests.helpers.mcap_tools import foreign, payloads, samples
    from tests.helpers.robot_models import PANDA

    model, urdf = dumps(documented("panda")).encode(), PANDA.read_bytes()
    (folder / "a.urdf").write_bytes(URDF)
    arm, kept = str(folder / "a.urdf"), ("--no-report", "--quiet", "--out", str(folder / "out"))
    log = foreign(folder / "b.mcap", payloads(samples(40))).read_bytes()
    columns = ("--columns", "time=0,q=1,dq=2,tau=3", "--to", str(folder / "to.mcap"))

    def answered(*words: str) -> int:
        said = io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            code = main(list(words))
        assert code in tuple(ExitCode) and "Traceback" not in said.getvalue()
        return code

    def given(name: str, *words: str) -> Callable[[bytes], object]:
        path = folder / name

        def run(data: bytes) -> int:
            path.write_bytes(data)
            for old in ("to.mcap", "mended.mcap"):
                (folder / old).unlink(missing_ok=True)
            return answered(*(word.replace("FILE", str(path)) for word in words))

        return run

    out, mended = str(folder / "out.urdf"), ("--to", str(folder / "mended.mcap"))
    lines: dict[str, tuple[bytes, Callable[[bytes], object], bool]] = {
        "info LOG": (log, given("x.mcap", "info", "FILE"), False),
        "info MODEL": (model, given("x.json", "info", "FILE"), True),
        "export": (model, given("x.json", "export", "FILE", "--urdf", out), True),
        "diff": (urdf, given("x.urdf", "diff", "panda", "FILE"), True),
        "import": (CSV, given("x.csv", "import", "FILE", *columns, "--joints", "a"), True),
        "recover": (log, given("x.mcap", "recover", "FILE", *mended), False),
        "gap ROBOT": (URDF, given("x.urdf", "gap", str(folder / "b.mcap"), "--robot", "FILE",
                                  "--quiet", "--out", str(folder / "gap")), True),
        "gap LOG": (log, given("x.mcap", "gap", "FILE", "--robot", arm, "--quiet",
                               "--out", str(folder / "gap")), False),
        "replay LOG": (log, given("x.mcap", "replay", "FILE", "--robot", arm, *kept), False),
        "replay ROBOT": (URDF, given("x.urdf", "replay", str(folder / "b.mcap"), "--robot", "FILE",
                                     *kept), True),
        "discover": (log, given("x.mcap", "discover", "FILE"), False),
        "load": (log, given("x.mcap", "load", "FILE"), False),
    }  # fmt: skip
    results = folder / "results"
    given("x.mcap", "replay", "FILE", "--robot", arm, "--no-report", "--out", str(results))(log)
    good = {path.name: path.read_bytes() for path in results.iterdir() if path.is_file()}

    def reported(name: str, data: bytes) -> int:
        for other, content in good.items():
            (results / other).write_bytes(data if other == name else content)
        return answered("report", str(results))

    for name, data in good.items():
        lines[f"report {name}"] = data, partial(reported, name), name.endswith("json")
    return {
        f"adapter {name}": Decoder([seed], run, (), 0.0005, text)
        for name, (seed, run, text) in lines.items()
    }


def everything(folder: Path) -> Iterator[tuple[str, Decoder]]:
    """All decoders by name."""
    for group in (wires(), files(folder), memory(), commands(folder)):
        yield from group.items()


def hear_alarm(*about: Any) -> None:
    """5 s are over."""
    raise TimeoutError(f"more than {LIMIT_S} s")


def try_one(name: str, count: int, seconds: float, seed: int, keep: Path) -> dict[str, Any]:
    """A decoder's account, in this process."""
    said: dict[str, Any] = {"tried": 0, "taken": 0, "refused": 0, "faults": [], "worst_s": 0.0}
    with tempfile.TemporaryDirectory() as place, contextlib.chdir(place):  # MuJoCo leaves a log
        decoder = next(found for key, found in everything(Path(place)) if key == name)
        for good in decoder.seeds:
            decoder.read(good)  # one that is refused would be no seed
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * resource.getpagesize() + LIMIT_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        signal.signal(signal.SIGALRM, hear_alarm)
        rng, until = np.random.default_rng(seed), time.monotonic() + seconds
        while said["tried"] < count and time.monotonic() < until:
            good = decoder.seeds[int(rng.integers(len(decoder.seeds)))]
            data, began = mutated(rng, good, decoder.text), time.monotonic()
            said["tried"] += 1
            signal.setitimer(signal.ITIMER_REAL, LIMIT_S)
            try:
                decoder.read(data)
                said["taken"] += 1
            except decoder.refuses:
                said["refused"] += 1
            except BaseException:
                told = traceback.format_exc(limit=-3)
                (keep / f"{name.replace(' ', '_')}-{said['tried']}").write_bytes(data)
                said["faults"].append(told)
            finally:
                signal.setitimer(signal.ITIMER_REAL, 0.0)
            said["worst_s"] = max(said["worst_s"], time.monotonic() - began)
    peak = next(x for x in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in x)
    return {**said, "peak_mb": round(int(peak.split()[1]) / 1024)}


def main_trials() -> int:
    """All decoders, each in a process of its own; 1 where there was a fault."""
    parser = options(__doc__, seed=0)
    add = parser.add_argument
    add("--count", type=int, default=1_000_000, help="inputs altogether")
    add("--seconds", type=float, default=600.0, help="at most, for each decoder")
    add("--only", help="one decoder, in this process")
    add("--keep", type=Path, default=Path("runs/mutated"), help="where inputs at fault go")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    args.keep = args.keep.resolve()
    args.keep.mkdir(parents=True, exist_ok=True)
    if args.only is not None:
        print(json.dumps(try_one(args.only, args.count, args.seconds, args.seed, args.keep)))
        return 0
    with tempfile.TemporaryDirectory() as place:
        shares = {name: decoder.share for name, decoder in everything(Path(place))}
    account: dict[str, Any] = {}
    for name, share in shares.items():
        count = max(round(args.count * share / sum(shares.values())), 1)
        words = ["--only", name, "--count", str(count), "--seconds", str(args.seconds)]
        words += ["--seed", str(args.seed), "--keep", str(args.keep)]
        done = subprocess.run([sys.executable, __file__, *words], capture_output=True, text=True)
        lines = done.stdout.splitlines()
        crash: dict[str, Any] = {"tried": 0, "taken": 0, "refused": 0, "worst_s": 0.0, "peak_mb": 0}
        crash["faults"] = [f"ended with {done.returncode}: {done.stderr[-800:]}"]
        found = account[name] = json.loads(lines[-1]) if done.returncode == 0 and lines else crash
        print(
            f"{name:18} {found['tried']:>8} tried, {found['taken']} taken, "
            f"{found['refused']} refused, {len(found['faults'])} faults; "
            f"worst {found['worst_s']:.2f} s, {found['peak_mb']} MB",
            flush=True,
        )
        for fault in dict.fromkeys(found["faults"]):
            print(fault, flush=True)
    print(f"{sum(x['tried'] for x in account.values())} inputs")
    write(args.json, account)
    return int(any(x["faults"] for x in account.values()))


if __name__ == "__main__":
    sys.exit(main_trials())
