"""What to do next after a run: one sentence and one command each, the most useful first."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from adapter.model.self_model import MJCF
from adapter.report.learned_panels import refusal, theta_started
from adapter.report.words import is_live, not_learned
from adapter.report.worth import SLOW, Worth, slow_share
from adapter.runs.run_folder import RunData

MOST = 4
LONGER = 2.0  # times the duration of a run that was too short
SIMULATED = "pybullet"
# Options that make a recording readable, which whoever reads it next needs, too
HOW_READ = (
    *("--topic", "--turn", "--zero", "--tau", "--tau-gain", "--gear", "--known-load", "--loaded"),
    "--trust-log",
)
# Options of a run that the next one does not repeat
ITS_OWN = (
    *("--out", "--json", "--duration", "--excitation", "--feedforward", "--passive", "--yes"),
    *("--allow-motion", "--quiet", "--no-report", "--checkpoint", "--resume", "--view"),
    *("--foxglove", "--fault", "--record", "--overwrite", "--motion"),
)


@dataclass(frozen=True)
class Step:
    """What to do, why, and the command that does it; "" where no command does."""

    why: str
    command: str = ""


def next_steps(data: RunData, worth: Worth) -> list[Step]:
    """At most `MOST` steps; never none."""
    files = _Files(data)
    if refusal(data.figures):
        why = "Mend it in the driver or the model; a log is taken with what the sentence names"
        return [files.read(why, "replay", files.logs)]
    started = theta_started(data)
    found: list[Step | None] = []
    fall, slow = worth.torque, slow_share(data) if started else None
    lacks = fall is not None and (fall.before is None or fall.better)
    left = slow is not None and float(slow.max()) > SLOW
    if lacks or left or worth.loads or not_learned(data.figures):
        found.append(files.gap("Name what the documented model lacks, with its evidence"))
    if not started or data.figures["theta"].get("converged_s") is None:
        found.append(_longer(data, files))
    if started:
        found += [_feedforward(data, worth), _held_out(data, files), *_use(data, files)]
    steps = [step for step in found if step is not None]
    return steps[:MOST] or [files.gap("Look for what the documented model lacks")]


def command(*words: Any) -> str:
    """A line of the shell."""
    return shlex.join(["adapter", *map(str, words)])


def _told(data: RunData) -> list[str]:
    """Words of the command that the run was begun by; none where it is no command."""
    try:
        return shlex.split(str(data.model.provenance.get("command") or ""))
    except ValueError:
        return []


class _Files:
    """Names of what the run left, and how commands take them."""

    def __init__(self, data: RunData) -> None:
        self.model = str(data.figures.get("model") or "model.json")
        self.documented = str(Path(self.model).with_name("documented.json"))
        logs = data.figures.get("recordings")
        self.logs: list[str] = [str(log) for log in logs] if logs else []
        self.read_as: list[str] = []
        keep = False
        for word in _told(data):
            option = word.startswith("--")
            keep = word.partition("=")[0] in HOW_READ if option else keep and word not in self.logs
            self.read_as += [word] if keep else []

    def gap(self, why: str) -> Step:
        return self.read(why, "gap", self.logs, "--robot", self.documented)

    def read(self, why: str, name: str, logs: Sequence[str], *more: str) -> Step:
        """A command that reads recordings as this run did."""
        return Step(why, command(name, *(logs or ["LOG"]), *more, *self.read_as))


def _longer(data: RunData, files: _Files) -> Step:
    """More motion, or a better one."""
    if is_live(data.figures):
        span_s = LONGER * (_seconds(data) or 30.0)
        why = "The learner had not settled: run for longer, with a motion designed to teach most"
        words = [*_again(data), "--duration", f"{span_s:.0f}"]
        if not data.figures.get("tracking"):  # somebody else moved the arm
            why = "The learner had not settled: listen for longer, to more motion of every joint"
            return Step(why, command(*words, "--passive"))
        return Step(why, command(*words, "--excitation", "designed", *_leave(data)))
    why = "The learner had not settled: see what this motion lacks"
    return files.read(why, "info", files.logs[:1], "--robot", files.documented)


def _again(data: RunData) -> list[str]:
    """Words of a run of the same arm: those of this one, but what it was to do and to leave."""
    told = _told(data)
    if told[:2] != ["adapter", "run"]:  # it was begun from Python
        scenario = data.figures.get("scenario")
        more = ["--scenario", str(scenario)] if scenario else []
        return ["run", "--driver", _driver(data), *more]
    return ["run", *without(told[2:], ITS_OWN)]


def without(words: Sequence[str], options: Sequence[str]) -> list[str]:
    """Words of a command without some of its options and what these were given."""
    kept: list[str] = []
    keep = True
    for word in words:
        keep = word.partition("=")[0] not in options if word.startswith("--") else keep
        kept += [word] if keep else []
    return kept


def _driver(data: RunData) -> str:
    return str(data.figures.get("driver") or "ADDRESS")


def _leave(data: RunData) -> list[str]:
    """What an arm that may be real needs to be moved."""
    return [] if _driver(data).startswith(SIMULATED) else ["--allow-motion"]


def _seconds(data: RunData) -> float | None:
    """How long the run moved, s."""
    trace = data.schema_trace if len(data.schema_trace) > 1 else data.score_trace
    return float(data.times(trace)[-1]) if len(trace) > 1 else None


def _feedforward(data: RunData, worth: Worth) -> Step | None:
    """The learned model has not helped the controller yet."""
    figures = data.figures
    moved = (figures.get("tracking") or {}).get("feedback") or {}
    if worth.tracking is not None or not moved.get("rms_rad"):
        return None
    span_s = max(LONGER * (_seconds(data) or 30.0), 30.0)
    words = [*_again(data), "--feedforward", "learned", "--duration", f"{span_s:.0f}"]
    why = "Let the learned model help the controller; the next report says what that is worth"
    if figures.get("feedforward") == "learned":
        why = "Run for longer, so that the learned model gets to help the controller"
    return Step(why, command(*words, *_leave(data)))


def _held_out(data: RunData, files: _Files) -> Step | None:
    """Nothing was held out."""
    span_s, held_out = _seconds(data), data.figures["theta"].get("validation_torque_rmse_nm")
    if held_out or len(files.logs) != 1 or not span_s:
        return None
    at = f"{0.7 * span_s:.3g}"  # seven tenths are learned from
    why = "Judge the model on data that it never saw"
    return files.read(why, "replay", files.logs, "--validate-from", at)


def _use(data: RunData, files: _Files) -> list[Step]:
    """What the learned model is for."""
    mjcf = data.model.source is not None and data.model.source.format == MJCF
    target = ("--mjcf", "learned.xml") if mjcf else ("--urdf", "learned.urdf")
    see = "See joint by joint what differs from the documentation"
    use = "Use it in a simulator or planner: the robot's file with what was learned"
    both = command("diff", files.model), command("export", files.model, *target)
    return [Step(see, both[0]), Step(use, both[1])]
