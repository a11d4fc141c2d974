"""The arm as its clients get it: a model library in protocol 5, URDF in protocol 10.

The library's source is C with one arm's numbers, built with the machine's own compiler. It has
thirty functions by name (libfranka 0.9.2): `Ji_J_Jk` and `O_J_Jk`, Jacobians in the frame's own and
in base axes; `O_T_Jk`, poses; k = 1..7 joints, 8 flange, 9 end effector; `M_NE`, `c_NE`, `g_NE`,
mass matrix, Coriolis and gravity torques with a load. Matrices are column-major.

libfranka 0.21 demands of the URDF seven movable joints with `joint1` to `joint7` in their names,
each with its limits and with `position_based_velocity_limits`, and a link that is called exactly
`link8`, the flange.
"""

from __future__ import annotations

import platform
import shutil
import subprocess
import tempfile
from collections.abc import Iterable
from functools import cache
from importlib import resources
from pathlib import Path

import numpy as np

from sim.truth import FLANGE_M, Truth, body_of
from sim.urdf_writer import joint_text, limit_text, link_text

_HEAD = """#include <math.h>
#include <string.h>
#define N 7
"""
COMPILER = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
OPTIONS = ("-O2", "-shared", "-fPIC", "-x", "c", "-", "-lm")
TIMEOUT_S = 60.0


def model_source(truth: Truth) -> str:
    """The whole source for one arm."""
    tables = (
        _table("R0[N][3][3]", truth.R.ravel()),
        _table("P0[N][3]", truth.p.ravel()),
        _table("THETA[N][10]", truth.theta.ravel()),
    )
    body = (resources.files(__package__) / "model.c").read_text("utf-8")
    return "".join((_HEAD, f"#define FLANGE {FLANGE_M!r}\n", *tables, body, *_frames()))


def _table(name: str, values: Iterable[float]) -> str:
    return f"static const double {name} = {{{', '.join(repr(float(x)) for x in values)}}};\n"


def _frames() -> list[str]:
    """The functions that differ only in the frame; the first joint's Jacobians take no posture."""
    out = ["static const double ZERO[N];\n"]
    for k in range(1, 10):
        tool, given = ("tool", "const double *tool, ") if k == 9 else ("0", "")
        q, posture = ("ZERO", "") if k == 1 else ("q", "const double *q, ")
        count = min(k, 8)
        for name, body in (("Ji_J_J", 1), ("O_J_J", 0)):
            call = f"jacobian({q}, {count}, {tool}, {body}, out)"
            out.append(f"void {name}{k}({posture}{given}double *out) {{ {call}; }}\n")
        call = f"pose(q, {count}, {tool}, out)"
        out.append(f"void O_T_J{k}(const double *q, {given}double *out) {{ {call}; }}\n")
    return out


def model_library(truth: Truth) -> bytes | None:
    """The library's bytes; None without a C compiler, or where it does not build for x64 Linux."""
    return _built(model_source(truth))


@cache
def _built(source: str) -> bytes | None:
    if COMPILER is None or (platform.system(), platform.machine()) != ("Linux", "x86_64"):
        return None
    with tempfile.TemporaryDirectory() as work:
        built = Path(work) / "model.so"
        try:
            subprocess.run(
                [COMPILER, *OPTIONS, "-o", str(built)],
                input=source.encode(),
                capture_output=True,
                timeout=TIMEOUT_S,
                check=True,
            )
        except (OSError, subprocess.SubprocessError):
            return None
        return built.read_bytes()


def robot_urdf(truth: Truth) -> str:
    """The arm without payloads and losses."""
    parts = ['<robot name="simulated_arm">', '<link name="link0"/>']
    slowing, offset = truth.limits.acceleration, np.zeros(truth.n)
    if truth.limits.slowing is not None:
        slowing, offset = truth.limits.slowing.deceleration, truth.limits.slowing.offset
    for j in range(truth.n):
        limits = (
            f"{limit_text(truth.limits, j)}<position_based_velocity_limits "
            f'velocity_offset="{float(offset[j])!r}" deceleration_limit="{float(slowing[j])!r}"/>'
        )
        links, place = (f"link{j}", f"link{j + 1}"), (truth.p[j], truth.R[j])
        parts.append(link_text(links[1], *body_of(truth.theta[j])))
        parts.append(joint_text(f"joint{j + 1}", links, place, limits))
    parts.append('<link name="link8"/>')
    parts.append(
        f'<joint name="joint8" type="fixed"><origin xyz="0 0 {FLANGE_M!r}" rpy="0 0 0"/>'
        '<parent link="link7"/><child link="link8"/></joint>'
    )
    return "\n".join([*parts, "</robot>"])
