"""What tests of several rooms share: commands that refuse what they are given."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from adapter.cli.exit_codes import ExitCode
from adapter.cli.main import main

Refused = Callable[..., str]


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Refused:
    """Gives a command that must refuse, with the code of wrong use and one line; that line."""

    def refusal(*words: object, warned: bool = False) -> str:
        capsys.readouterr()
        try:
            code = main([str(word) for word in words])
        except SystemExit as end:
            code = int(end.code or 0)
        said = capsys.readouterr().err
        usual = (" ...", "; locked at zero")  # what it does, and what it does without
        lines = [line for line in said.splitlines() if not line.endswith(usual)]
        lines = [line for line in lines if not (warned and line.startswith("warning: "))]
        assert code == ExitCode.WRONG_USE, f"{code}: {said}"
        assert len(lines) == 1 and lines[0].startswith("error: "), said
        assert "Errno" not in lines[0] and "object at 0x" not in lines[0]
        return lines[0]

    return refusal
