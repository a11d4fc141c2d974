"""The plan is shown before it is a motion, and somebody has to agree."""

from __future__ import annotations

import io

import pytest

from adapter.cli import agreement
from adapter.cli.main import main
from adapter.errors import SettingsError

pytest.importorskip("coal")


class Reading:
    """An arm whose samples wait for nobody."""

    paced, period_ns, reads = True, 1_000_000, 0

    def read(self) -> None:
        self.reads += 1


def test_plan_writes_lines_and_a_page_and_moves_nothing(tmp_path, capsys):
    box = '[[cell.box]]\nname = "shelf <b>"\nsize = [0.3, 0.3, 0.3]\nxyz = [0.0, 0.9, 0.9]\n'
    (tmp_path / "cell.toml").write_text(box + "[cell.hand]\nlength = 0.2\nradius = 0.08\n")
    command = ["plan", "--duration", "3", "--speed", "0.3", "--move", "panda_joint1,panda_joint6"]
    assert main([*command, "--config", str(tmp_path / "cell.toml"), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "This moves 2 joints" in said and "Nearest on the way: 0." in said
    assert "N m on a joint that the model does not expect" in said and "Once stopped" in said
    assert "then 0.000 rad/s (0% of" in said or "up to 0.000 rad/s (0% of" in said
    page = (tmp_path / "plan.html").read_text()
    assert page.count("<svg") == 5 and "margin 0.05 m" in page and "NaN" not in page


def test_without_a_terminal_nothing_moves_unless_yes_is_said(refused):
    """Before anything is connected: there is no robot behind this address."""
    said = refused("run", "--driver", "fci://127.0.0.1:9", "--allow-motion")
    assert "no terminal to ask on; give --yes" in said
    agreement.need_somebody(True)


@pytest.mark.parametrize(("answer", "moves"), [("yes\n", True), ("n\n", False), ("\n", False)])
def test_only_a_yes_moves_the_arm(answer, moves, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO(answer))
    looks = iter([False, False, True])
    monkeypatch.setattr(
        agreement.select, "select", lambda *files: (["stdin"] if next(looks) else [], [], [])
    )
    arm = Reading()
    if moves:
        agreement._ask(arm, lambda: False)
    else:
        with pytest.raises(SettingsError, match="nobody agreed"):
            agreement._ask(arm, lambda: False)
    assert arm.reads == 2  # none waited while somebody thought
    with pytest.raises(SettingsError, match="nobody agreed"):
        agreement._ask(arm, lambda: True)  # Ctrl-C


def test_a_can_arm_is_moved_as_a_named_robot_only(refused):
    said = refused("run", "--driver", "can://can0?interface=socketcan", "--allow-motion")
    assert "--robot must, before it may be moved: fr3, panda" in said
