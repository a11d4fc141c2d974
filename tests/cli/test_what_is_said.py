"""What commands print and how they end: names as they are, results apart, codes in one table."""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from adapter.cli.exit_codes import ExitCode
from adapter.cli.main import COMMANDS, build_parser, main
from adapter.effects.robots import read_robot
from adapter.model.model_file import load_model, save_model
from adapter.model.robots import documented
from adapter.model.self_model import SelfModel
from drivers.interface import DriverError, NotReady
from tests.helpers.pages import PAGES, ROOT

NAMES = ("[red]shoulder[/]", "[/]", "arm[1]", "[bold", ":smile:", "\\[x]", "[link=file:x]y")


def awkward(name: str = "[red]arm[/bold]") -> SelfModel:
    """The Panda with names that would be styles."""
    robot = documented("panda")
    return replace(robot, name=name, tree=replace(robot.tree, joint_names=NAMES), source=None)


def test_names_are_printed_as_they_are(tmp_path: Path, capsys, refused) -> None:
    """In results, tables, warnings and errors."""
    path = save_model(awkward(), tmp_path / "[bold]model[/x].json")
    heavier = awkward("b")
    heavier.theta[:, 0] *= 1.5
    other = save_model(heavier, tmp_path / "[green].json")
    assert main(["info", str(path)]) == 0
    said = capsys.readouterr().out
    assert "[red]arm[/bold]" in said and ", ".join(NAMES) in said
    assert main(["export", str(path), "--urdf", str(tmp_path / "[a].urdf")]) == 0
    assert str(tmp_path / "[a].urdf") in capsys.readouterr().out
    assert main(["diff", str(path), str(other)]) == 0
    said = capsys.readouterr().out
    assert any(name in said for name in NAMES)
    assert "[/gone].json" in refused("info", tmp_path / "[/gone].json")


def test_results_go_to_the_standard_output(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = save_model(documented("panda"), tmp_path / "m.json")
    for arguments in (["info", path], ["diff", path, path], ["export", path, "--urdf", "a.urdf"]):
        arguments = [str(tmp_path / x) if x == "a.urdf" else str(x) for x in arguments]
        assert main(arguments) == 0
        said = capsys.readouterr()
        assert (
            said.out and said.err.endswith(" ...\n") and said.err.count("\n") == 1
        )  # what it does
    assert main([]) == ExitCode.WRONG_USE
    assert "COMMAND" in capsys.readouterr().out  # the help
    assert main(["info", "gone.json"]) == ExitCode.WRONG_USE
    said = capsys.readouterr()
    assert said.err.startswith("error: ") and not said.out  # before anything is done


def test_a_reader_that_leaves_is_no_error(tmp_path: Path) -> None:
    """`adapter info FILE | head -0` ends as it would have, without a word on the pipe."""
    path = save_model(documented("panda"), tmp_path / "m.json")
    command = [sys.executable, "-m", "adapter", "info", str(path)]
    piped = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, text=True, **piped) as process:
        process.stdout.close()
        assert process.stderr.read() == "reading m.json ...\n"
        assert process.wait(60) == 0


def test_theta_that_has_not_converged_says_so_wherever_it_goes(tmp_path: Path, capsys) -> None:
    """In the model, its URDF, the report, `info`, `export` and the exit code; and what little data
    did not show is the documentation's, so that no link is of a mass that nobody saw."""
    log, out = ROOT / "recordings" / "panda_nominal_6s.mcap", tmp_path / "out"
    replay = ["replay", str(log), "--every", "1", "--quiet", "--out", str(out)]
    assert main([*replay, "--validate-from", "1.2"]) == ExitCode.NOT_CONVERGED
    why = "it had not converged: its torque error is"
    assert why in capsys.readouterr().err
    model, path = load_model(out / "model.json"), out / "model.json"
    assert not model.provenance["theta_converged"] and why in model.provenance["theta_note"]
    share = model.theta[:, 0] / documented("panda").theta[:, 0]
    assert (share < 1.1).all(), share
    page = (out / "report.html").read_text()
    assert why in page and "do not use this model yet" in page
    assert main(["info", str(path)]) == 0 and why in capsys.readouterr().out
    files = [tmp_path / "arm.urdf", tmp_path / "arm.xml"]
    for more in ([], ["--alone"]):
        line = ["export", str(path), "--urdf", str(files[0]), "--mjcf", str(files[1]), *more]
        assert main(line) == 0 and why in capsys.readouterr().err
        for file in (out / "model.urdf", *files):
            assert f"    θ: {why}" in file.read_text()
            assert read_robot(file).tree.n == 7
    assert main(replay) == 0 and why not in capsys.readouterr().err
    model = load_model(path)
    assert model.provenance["theta_converged"] and "theta_note" not in model.provenance
    assert "θ:" not in (out / "model.urdf").read_text()


def test_exit_codes_stand_in_the_pages_and_in_the_help() -> None:
    table = dict(re.findall(r"^\| (\d+) \| (.+?) \|$", PAGES["docs/commands.md"], re.M))
    assert table == {str(code.value): code.words for code in ExitCode}
    parts = next(a for a in build_parser()._actions if a.dest == "command").choices
    for name, command in COMMANDS.items():
        said = " ".join(parts[name].format_help().split())
        for code in command.may_end:
            assert f"{code.value} {code.words}" in said


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (NotReady("joint 4 is in a reflex"), ExitCode.NOT_READY),
        (DriverError("no [route]"), ExitCode.WRONG_USE),
        (MemoryError(), ExitCode.NO_MEANS),
    ],
)
def test_each_error_has_its_code(monkeypatch, capsys, error: Exception, code: ExitCode) -> None:
    def fail(args: object) -> int:
        raise error

    monkeypatch.setattr("adapter.cli.files.run_info", fail)
    assert main(["info", __file__]) == code
    assert str(error) in capsys.readouterr().err
