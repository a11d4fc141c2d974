"""Source distribution and wheel: made of the repository's files, complete, working elsewhere."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

from tests.benchmarks.licences import UNKNOWN, core

ROOT = Path(__file__).parents[2]
LOG = ROOT / "recordings" / "panda_nominal_6s.mcap"
LESSER = {"python-can"}  # LGPL: used as a library, as its licence wants it
BUILD = "import sys; from setuptools import build_meta as b; getattr(b, sys.argv[1])(sys.argv[2])"


def clean(**more: str) -> dict[str, str]:
    """The environment without what points at this checkout."""
    return {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | more


def given(*words: object, folder: Path, **more: str) -> str:
    """The standard output of a program that must work."""
    command = [str(word) for word in words]
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=500, env=clean(**more)
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel, made of a source distribution, made of what git knows, where there is no git."""
    folder = tmp_path_factory.mktemp("release")
    source, out = folder / "source", folder / "out"
    try:
        listed = given("git", "ls-files", "--", "adapter", "drivers", "sim", "*.*", folder=ROOT)
    except (AssertionError, FileNotFoundError):
        pytest.skip("needs a checkout of git")
    for name in filter(lambda name: (ROOT / name).is_file(), [*listed.splitlines(), "LICENSE"]):
        if name.startswith(("adapter", "drivers", "sim")) or "/" not in name:
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, source / name)
    out.mkdir()
    given(sys.executable, "-c", BUILD, "build_sdist", out, folder=source)
    (packed,) = out.glob("*.tar.gz")
    with tarfile.open(packed) as archive:
        archive.extractall(folder / "unpacked", filter="data")
    (unpacked,) = (folder / "unpacked").iterdir()
    given(sys.executable, "-c", BUILD, "build_wheel", out, folder=unpacked)
    (built,) = out.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment with the wheel, and all it needs from the one that runs this."""
    place = tmp_path_factory.mktemp("elsewhere") / "venv"
    venv.create(place, with_pip=False)
    pip = [sys.executable, "-m", "pip", "--python", place / "bin" / "python"]
    given(*pip, "install", "--no-deps", "--no-index", "--no-compile", wheel, folder=place)
    (packages,) = place.glob("lib/python*/site-packages")
    here = Path(pytest.__file__).parents[1]
    (packages / "needed.pth").write_text(f"{here}\n")  # its own .pth files do not count there
    return place


def test_the_wheel_holds_what_git_knows_of_the_packages(wheel: Path) -> None:
    listed = given("git", "ls-files", "--", "adapter", "drivers", "sim", folder=ROOT).splitlines()
    wanted = {name for name in listed if not name.endswith(".md") and (ROOT / name).is_file()}
    with zipfile.ZipFile(wheel) as archive:
        inside = {name for name in archive.namelist() if ".dist-info/" not in name}
        (listing,) = (n for n in archive.namelist() if n.endswith("METADATA"))
        told = archive.read(listing).decode()
    assert wanted <= inside, f"not in the wheel: {sorted(wanted - inside)}"
    assert {name.split("/")[0] for name in inside} == {"adapter", "drivers", "sim"}
    table = tomllib.loads((ROOT / "pyproject.toml").read_text())
    fallback = table["tool"]["setuptools_scm"]["fallback_version"]
    assert f"Version: {fallback}\n" in told and "License-File: LICENSE\n" in told


def test_it_works_elsewhere(installed: Path, tmp_path: Path) -> None:
    adapter = installed / "bin" / "adapter"
    assert "COMMAND" in given(adapter, "--help", folder=tmp_path)
    assert re.fullmatch(r"\d+\.\d+.*\n", given(adapter, "--version", folder=tmp_path))
    told = given(adapter, "info", LOG, folder=tmp_path, NUMBA_DISABLE_JIT="1")  # compiles elsewhere
    assert "samples" in told
    code = (
        "import adapter, sim.truth\n"
        "assert 'site-packages' in adapter.__file__ and 'site-packages' in sim.__file__\n"
        "assert sim.truth.documented('panda').n == 7\n"
        "adapter.export(adapter.load_model('fr3'), 'fr3.urdf')\n"
    )
    given(installed / "bin" / "python", "-c", code, folder=tmp_path)
    assert (tmp_path / "fr3.urdf").read_text().startswith("<?xml")


@pytest.mark.slow
def test_it_learns_elsewhere(installed: Path, tmp_path: Path) -> None:
    """Compiles everything anew, and makes the page."""
    words = ["replay", LOG, "--every", "20", "--out", "out"]
    assert "θ" in given(installed / "bin" / "adapter", *words, folder=tmp_path)
    assert (tmp_path / "out" / "report.html").stat().st_size > 10_000


def test_nothing_without_extras_is_under_the_gpl() -> None:
    licences = core()
    assert len(licences) > 20 and "numpy" in licences
    assert not [name for name, told in licences.items() if told in (UNKNOWN, "not stated")]
    found = {name for name, told in licences.items() if "GPL" in told.upper()}
    assert found <= LESSER and all("LGPL" in licences[name].upper() for name in found)
