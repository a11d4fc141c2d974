"""The pages' commands for hardware, word for word, with simulated hardware behind the wire."""

import json
import re
import shlex
import subprocess
from pathlib import Path

import pytest

from tests.helpers.pages import PATIENCE_S, environment, give, given
from tests.helpers.stalls import Stalls

pytestmark = [pytest.mark.alone, pytest.mark.timeout(2 * PATIENCE_S)]

PORT = 14337  # instead of the usual ones, which something else may use
HELD_UP_S = 2e-3  # a process or core that stands still for so long was held up by the machine
BY_THE_MACHINE = (
    r"missed 20 commands|silent for|answers? on|not answer|no usable joint reading|no state|"
    r"communication lost|no joint can move to|too fast|samples broke off|"
    r"between the plan and the start"
)


def served(line: str, folder: Path) -> subprocess.Popen[str]:
    """A simulated arm started as the pages say, on a port of its own, once it is ready."""
    arm = subprocess.Popen(
        [*shlex.split(line), "--port", str(PORT), "--json", "arm.json"],
        cwd=folder,
        env={**environment(folder), "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert arm.stdout is not None
    for said in arm.stdout:
        if str(PORT) in said:
            return arm
    raise AssertionError(f"{line} ended with {arm.wait()}")


@pytest.mark.parametrize("kind", ["fci", "can"])
def test_simulated_hardware(kind: str, tmp_path: Path) -> None:
    """Its accounts balance; an arm that stopped says so, and only where processors were away."""
    serve = next(line for line in given(wire=True) if line == f"adapter sim {kind}")
    run = next(line for line in given(wire=True) if re.search(f"{kind}://(127|239)", line))
    run = run.replace("127.0.0.1", f"127.0.0.1:{PORT}").replace("163.2?", f"163.2:{PORT}?")
    arm = served(serve, tmp_path)
    with Stalls() as stalls:
        try:
            options = "--duration 2 --out run --json run.json"
            code, said = give(f"{run} {options}", tmp_path, codes=(0, 2, 3, 9))
        finally:
            arm.terminate()
            arm.communicate(timeout=30)
    if code == 2:  # before the loop had its priority: the motors' replies came too late
        assert re.search(f"error: .*({BY_THE_MACHINE})", said) and stalls.worst_s > HELD_UP_S
        return
    figures, seen = (json.loads((tmp_path / f"{name}.json").read_text()) for name in ("run", "arm"))
    intake = figures["intake"]
    assert intake["received"] == intake["used"] + sum(intake["refused"].values()) > 0
    assert figures["samples"] == figures["learned"] + sum(figures["refused"].values())
    assert figures["recorded"] + figures["unrecorded"] == figures["samples"]
    if kind == "fci":  # none that the robot does not know of
        assert intake["received"] <= seen["states_sent"]
    if code in (0, 9):  # 2 s are few to learn in
        assert figures["fault"] is None and figures["ended"] == "duration"
        assert figures["samples"] > 3000
        return
    assert figures["ended"] == "driver_error" and "\n" not in figures["fault"]
    assert re.search(BY_THE_MACHINE, figures["fault"]), figures["fault"]
    simulator_s = 1e-3 * (seen["stalled_ms"] if kind == "fci" else seen["slipped_ms"])
    loop_s = 1e-6 * figures["timing"]["period_us"]["max"]
    assert max(stalls.worst_s, simulator_s, loop_s) > HELD_UP_S
