"""How long every command takes to say what it does, to explain itself, and to refuse.

    PYTHONPATH=. python tests/benchmarks/first_output.py [--json FILE] [--cold]

Wall time from pressing enter to the first byte on the standard output or error, and the processor
time used until then. `--cold`: the files of Python's and this package's code are first put out of
the system's memory, as after a start of the machine. A command that goes on is ended then.
"""

from __future__ import annotations

import os
import select
import site
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import adapter
from adapter.cli.main import COMMANDS
from adapter.model.model_file import dumps
from tests.helpers.benchmark import options, processor_s, write

ROOT = Path(__file__).parents[2]
LOG = str(ROOT / "recordings" / "panda_nominal_6s.mcap")
LONGEST_S = 120.0


def lines(folder: Path) -> dict[str, list[str]]:
    """A real command line of each command, and a wrong one."""
    model, table = str(folder / "model.json"), folder / "log.csv"
    table.write_text("0,0\n")
    run = folder / "run"
    run.mkdir()
    Path(model).write_text(dumps(adapter.load_model("panda")))
    real: dict[str, list[str]] = {
        "run": ["run", "--out", str(run)],
        "plan": ["plan", "--out", str(run)],
        "excite": ["excite", "--out", str(run)],
        "replay": ["replay", LOG, "--out", str(run)],
        "gap": ["gap", LOG, "--robot", "panda", "--out", str(run)],
        "fleet": ["fleet", LOG, "--robot", "panda", "--out", str(run)],
        "load": ["load", LOG],
        "diff": ["diff", "panda", model],
        "discover": ["discover", LOG],
        "effects": ["effects"],
        "sim": ["sim", "fci", "--port", "0"],
        "import": ["import", str(table), "--to", str(folder / "new.mcap")],
        "export": ["export", model, "--urdf", str(folder / "new.urdf")],
        "report": ["report", str(run)],
        "recover": ["recover", LOG, "--to", str(folder / "mended.mcap")],
        "info": ["info", LOG],
        "experiment": ["experiment", "panda", "--out", str(run)],
        "bench": ["bench"],
        "completion": ["completion", "bash"],
    }
    assert set(real) == set(COMMANDS)
    wrong = {f"{name} --nonsense": [*words, "--nonsense"] for name, words in real.items()}
    shown = {f"{name} --help": [name, "--help"] for name in real}
    return {"--help": ["--help"], **real, **shown, **wrong}


def first_output(words: list[str]) -> dict[str, Any]:
    """Wall and processor time until a command says something, s, and what it said."""
    begun = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "adapter", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )
    assert process.stdout is not None
    heard = select.select([process.stdout], [], [], LONGEST_S)[0]
    wall_s = time.perf_counter() - begun
    used_s = processor_s([process.pid])
    said = os.read(process.stdout.fileno(), 200).decode(errors="replace") if heard else ""
    process.terminate()
    try:
        process.wait(10.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    process.stdout.close()
    return {"wall_s": wall_s, "processor_s": used_s, "said": said.partition("\n")[0][:70]}


def forget_files() -> None:
    """Put code out of the system's memory; what a running program has mapped stays."""
    folders = [ROOT, *map(Path, site.getsitepackages()), Path(os.__file__).parent]
    for path in (p for folder in folders for p in folder.rglob("*") if p.is_file()):
        if path.suffix in (".py", ".pyc", ".so", ".toml", ".urdf") or ".so." in path.name:
            with path.open("rb") as file:
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def main() -> None:
    """Measure and print a table."""
    parser = options(__doc__)
    parser.add_argument("--cold", action="store_true")
    args = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as name:
        for what, words in lines(Path(name)).items():
            if args.cold:
                forget_files()
            row = {"command": what, **first_output(words)}
            rows.append(row)
            times = f"{row['wall_s']:6.2f} {row['processor_s']:9.2f}"
            print(f"{what:24} {times}  {row['said']}", flush=True)
    worst = max(rows, key=lambda row: row["wall_s"])
    print(
        f"slowest: {worst['command']}, {worst['wall_s']:.2f} s; 1-minute load {os.getloadavg()[0]}"
    )
    write(args.json, rows)


if __name__ == "__main__":
    main()
