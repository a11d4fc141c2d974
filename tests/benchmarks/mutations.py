"""Which small errors the tests notice: one line of the core is changed at a time. `make trials`.

Each entry of `mutations.toml` names a file, a text that stands in it exactly once, what takes its
place, and the tests that should fail then. They run on a copy of the tree. A mutation that no
test notices is a hole in the tests; one whose text is not found any more is an error of the list
(`tests/house/test_mutations.py` holds the list to the code).
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from tests.helpers.benchmark import options, write

ROOT = Path(__file__).parents[2]
LIST = Path(__file__).with_name("mutations.toml")
KERNELS = ("adapter", "sim")  # rooms with compiled kernels
COPIED = ("adapter", "drivers", "sim", "tests", "recordings", "docs", "pyproject.toml", "README.md")


@dataclass(frozen=True)
class Mutation:
    """One changed line.

    Attributes:
        file: path inside the project.
        was, now: the text, which stands in the file exactly once, and its replacement.
        tests: paths inside the project (with `::name` or without) that should notice.
    """

    file: str
    was: str
    now: str
    tests: tuple[str, ...]

    def applied(self, text: str) -> str:
        """The file's text with the error in it.

        Raises:
            ValueError: the text to change is missing or stands more than once.
        """
        if text.count(self.was) != 1:
            raise ValueError(f"{self.file}: '{self.was}' stands there {text.count(self.was)} times")
        return text.replace(self.was, self.now)


def mutations() -> list[Mutation]:
    """The list."""
    entries = tomllib.loads(LIST.read_text("utf-8"))["mutation"]
    return [Mutation(e["file"], e["was"], e["now"], tuple(e["tests"])) for e in entries]


def forget_compiled(house: Path, changed: Path) -> None:
    """Drop the compiled kernels of all files that call those of a changed one.

    Numba compiles a file anew when it has changed, not when a kernel it calls from another has.
    """
    texts = {
        path: path.read_text("utf-8") for room in KERNELS for path in (house / room).rglob("*.py")
    }
    compiled = {path: text for path, text in texts.items() if "\n@jit" in text or "\n@njit" in text}
    waiting, stale = [changed], set()
    while waiting:
        path = waiting.pop()
        if path in stale or path not in compiled:
            continue
        stale.add(path)
        for cached in (path.parent / "__pycache__").glob(f"{path.stem}.*.nbi"):
            cached.unlink()
        module = ".".join(path.relative_to(house).with_suffix("").parts)
        waiting += [other for other, text in compiled.items() if f"from {module} import" in text]


def noticed(mutation: Mutation, limit_s: float) -> str:
    """'caught', 'survived', or 'time ran out', after the tests ran on a changed copy."""
    with tempfile.TemporaryDirectory() as folder:
        house = Path(folder) / "house"
        house.mkdir()
        for name in COPIED:
            source = ROOT / name
            copy = shutil.copytree if source.is_dir() else shutil.copy2
            copy(source, house / name)
        shared = ROOT.parent / "shared"
        if shared.exists():
            (Path(folder) / "shared").symlink_to(shared)
        path = house / mutation.file
        text = path.read_text("utf-8")
        path.write_text(mutation.applied(text), "utf-8")
        forget_compiled(house, path)
        command = [sys.executable, "-m", "pytest", "-q", "-x", "--no-header", *mutation.tests]
        environment = {**os.environ, "PYTHONPATH": str(house), "OMP_NUM_THREADS": "1"}
        try:
            done = subprocess.run(
                command, cwd=house, env=environment, capture_output=True, timeout=limit_s
            )
        except subprocess.TimeoutExpired:
            return "time ran out"  # on a busy machine, too: nothing was noticed
    if done.returncode == 0:
        return "survived"
    if done.returncode != 1:
        raise RuntimeError(f"{mutation.file}: pytest ended with {done.returncode}: {done.stdout!r}")
    return "caught"


def main() -> int:
    """Run the list; exit code 1 where fewer than nine in ten are noticed."""
    parser = options(__doc__, processes=2)
    parser.add_argument("--first", type=int, default=0, help="number of the first mutation")
    parser.add_argument("--trials", type=int, help="how many (all)")
    parser.add_argument("--limit", type=float, default=600.0, metavar="S", help="for one mutation")
    wanted = parser.parse_args()
    chosen = mutations()[wanted.first :][: wanted.trials]
    rows = []
    begun = time.perf_counter()
    with ThreadPoolExecutor(wanted.processes) as pool:
        verdicts = pool.map(lambda mutation: noticed(mutation, wanted.limit), chosen)
        for k, (mutation, verdict) in enumerate(zip(chosen, verdicts, strict=True), wanted.first):
            print(f"{k} {verdict}: {mutation.file}: {mutation.was} -> {mutation.now}", flush=True)
            rows.append({"file": mutation.file, "was": mutation.was, "verdict": verdict})
    caught = sum(row["verdict"] == "caught" for row in rows)
    print(f"{caught} of {len(rows)} noticed, {time.perf_counter() - begun:.0f} s")
    write(wanted.json, {"noticed": caught, "rows": rows})
    return 0 if 10 * caught >= 9 * len(rows) else 1


if __name__ == "__main__":
    raise SystemExit(main())
