"""The model file: one readable, versioned JSON text; round trips are exact to the last bit.

Numbers are written so that they read back unchanged; what is unknown (NaN) is null, infinity is
the text "inf".
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from adapter.errors import ModelError
from adapter.model.posterior import Posterior
from adapter.model.self_model import LIMITS, MJCF, URDF, FixedFrame, Limits, SelfModel, Source, Tool
from adapter.model.tree import Tree
from drivers.files.bounded import parse_json, read_text

FORMAT = "panda-adapter/self-model"
VERSION = 1
_REQUIRED = ("name", "tree", "lambda", "theta")


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A file that is there whole or not at all: write to the path given, beside the final one."""
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        yield part
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def save_model(model: SelfModel, path: str | Path) -> Path:
    """Write `model` to `path`, whole or not at all."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as part:
        part.write_text(dumps(model), encoding="utf-8")
    return path


def load_model(path: str | Path) -> SelfModel:
    """Read a model file.

    Raises:
        ModelError: no such file, not JSON, another format or version, missing or wrong parts.
    """
    path = Path(path)
    try:
        text = read_text(path)
    except (OSError, ValueError) as error:
        raise ModelError(f"{path}: cannot be read as a model file ({error})") from None
    try:
        return loads(text)
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from None


def dumps(model: SelfModel) -> str:
    """The text of the model file."""
    return _text(_to_json(model), 0) + "\n"


def loads(text: str) -> SelfModel:
    """The model in a model file's text. Raises ModelError."""
    try:
        data = parse_json(text)
    except ValueError as error:
        raise ModelError(f"not a JSON model file ({error})") from None
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        found = data.get("format") if isinstance(data, dict) else None
        raise ModelError(f"format is {found!r}, expected '{FORMAT}'")
    if data.get("version") != VERSION:
        raise ModelError(f"version {data.get('version')!r} of the format; have: {VERSION}")
    missing = [key for key in _REQUIRED if key not in data]
    if missing:
        raise ModelError(f"'{missing[0]}' is missing; needed are {', '.join(_REQUIRED)}")
    return _from_json(data)


def _to_json(model: SelfModel) -> dict[str, Any]:
    tree, source, given = model.tree, None, model.source
    if given is not None:
        text = None if given.text is None else given.text.splitlines(keepends=True)
        lam = _numbers(given.lam)
        source = {"format": given.format, "file": given.file, "lambda": lam, "text": text}
    posterior: dict[str, Any] | None = None
    known = model.posterior
    if known is not None:  # of the lower triangle what is not zero by its shape
        root = [_numbers(row[: k + 1]) for k, row in enumerate(known.root)]
        posterior = {"effects": _plain(known.effects), "least": _numbers(known.least)}
        posterior |= {"root": root, "room": _numbers(known.room)}
        posterior["lambda_root"] = _numbers(known.lam_root)
    return {
        "format": FORMAT,
        "version": VERSION,
        "name": model.name,
        "lambda_source": model.lambda_source,
        "provenance": _plain(model.provenance),
        "tree": {
            "parent": list(tree.parent),
            "floating": tree.floating,
            "joint_names": list(tree.joint_names),
            "link_names": list(tree.link_names),
            "base_name": tree.base_name,
            **({"slides": list(tree.slides)} if any(tree.slides) else {}),
        },
        "lambda": _numbers(model.lam),
        "lambda_std": _numbers(model.lam_std),
        "lambda_identifiable": _plain(model.lam_identifiable),
        "theta": _numbers(model.theta),
        "theta_std": _numbers(model.theta_std),
        "theta_identifiable": _plain(model.theta_identifiable),
        "posterior": posterior,
        "base_theta": _numbers(model.base_theta),
        "effects": _plain(model.effects),
        "gravity": _numbers(model.gravity),
        "tool": None if model.tool is None else _plain(asdict(model.tool)),
        "limits": {key: _numbers(getattr(model.limits, key)) for key in LIMITS},
        "axis": _numbers(model.axis),
        "frames": [_plain(asdict(frame)) for frame in model.frames],
        "source": source,
    }


def _from_json(data: Mapping[str, Any]) -> SelfModel:
    tree = _tree(_part(data, "tree", dict))
    n, bodies = tree.n, tree.bodies
    optional: dict[str, Any] = {
        "axis": _array(data, "axis", (n, 3)),
        "lam_std": _array(data, "lambda_std", (n, 6)),
        "theta_std": _array(data, "theta_std", (bodies, 10)),
        "base_theta": _array(data, "base_theta", (10,)),
        "gravity": _array(data, "gravity", (3,)),
        "lam_identifiable": _bools(data, "lambda_identifiable", (n, 6)),
        "theta_identifiable": _bools(data, "theta_identifiable", (bodies, 10)),
    }
    lam, theta = _array(data, "lambda", (n, 6)), _array(data, "theta", (bodies, 10))
    if lam is None or theta is None:
        raise ModelError("'lambda' and 'theta' must hold numbers, not null")
    given = _part(data, "limits", dict) if data.get("limits") else {}
    limits = {key: _array(given, key, (n,)) for key in LIMITS}
    return SelfModel(
        name=_part(data, "name", str),
        tree=tree,
        lam=lam,
        theta=theta,
        limits=Limits(**{k: np.full(n, np.nan) if v is None else v for k, v in limits.items()}),
        posterior=_posterior(_part(data, "posterior", dict), n) if data.get("posterior") else None,
        frames=tuple(_frame(item) for item in _part(data, "frames", list, [])),
        tool=_tool(_part(data, "tool", dict)) if data.get("tool") else None,
        effects=tuple(_part(data, "effects", list, [])),
        lambda_source=_part(data, "lambda_source", str, "documentation"),
        source=_source(_part(data, "source", dict), n) if data.get("source") else None,
        provenance=_part(data, "provenance", dict, {}),
        **{key: value for key, value in optional.items() if value is not None},
    )


def _posterior(data: Mapping[str, Any], n: int) -> Posterior:
    try:
        effects = tuple((str(e), int(joint), str(key)) for e, joint, key in data["effects"])
        least, rows = np.array(data["least"], dtype=float), data["root"]
        root = np.array([[*row, *[0.0] * (len(rows[-1]) - len(row))] for row in rows], dtype=float)
    except (IndexError, KeyError, TypeError, ValueError):
        raise ModelError("'posterior' must hold effects, least and root") from None
    lam_root = _needed(data, "lambda_root", (n, 6, 6), "posterior")
    return Posterior(effects, least, root, _needed(data, "room", (n, 10), "posterior"), lam_root)


def _part(data: Mapping[str, Any], key: str, kind: type, default: Any = None) -> Any:
    value = data.get(key, default)
    if not isinstance(value, kind):
        raise ModelError(f"'{key}' must be a {kind.__name__}, got {type(value).__name__}")
    return value


def _tree(data: Mapping[str, Any]) -> Tree:
    parent, floating = _part(data, "parent", list), _part(data, "floating", bool, False)
    if not all(isinstance(i, int) for i in parent):
        raise ModelError("'parent' must be a list of integers")
    joints, links = _part(data, "joint_names", list, []), _part(data, "link_names", list, [])
    base, slides = _part(data, "base_name", str, "base"), _part(data, "slides", list, [])
    if not all(isinstance(x, bool) for x in slides):
        raise ModelError("'slides' must be a list of true and false")
    names = tuple(map(str, joints)), tuple(map(str, links))
    return Tree(tuple(parent), floating, *names, base, tuple(slides))


def _frame(data: Any) -> FixedFrame:
    if not isinstance(data, dict):
        raise ModelError(f"an entry of 'frames' must be a dict, got {type(data).__name__}")
    name, joint, parent = (_part(data, key, str) for key in ("name", "joint", "parent"))
    rotation = _needed(data, "rotation", (3, 3), "frames")
    return FixedFrame(name, joint, parent, rotation, _needed(data, "position", (3,), "frames"))


def _tool(data: Mapping[str, Any]) -> Tool:
    mass = float(_needed(data, "mass", (), "tool"))
    com, inertia = _needed(data, "com", (3,), "tool"), _needed(data, "inertia", (3, 3), "tool")
    return Tool(mass, com, inertia, data.get("link"))


def _source(data: Mapping[str, Any], n: int) -> Source:
    kind, file = _part(data, "format", str), _part(data, "file", str)
    if kind not in (URDF, MJCF):
        raise ModelError(f"no source format '{kind}'; have: {URDF}, {MJCF}")
    lines = _part(data, "text", list) if data.get("text") is not None else []
    if not all(isinstance(line, str) for line in lines):
        raise ModelError("'text' in 'source' must be a list of lines")
    return Source(kind, file, "".join(lines) or None, _needed(data, "lambda", (n, 6), "source"))


def _needed(data: Mapping[str, Any], key: str, shape: tuple[int, ...], where: str) -> Any:
    value = _array(data, key, shape)
    if value is None or not np.all(np.isfinite(value)):
        raise ModelError(f"'{key}' in '{where}' must hold finite numbers")
    return value


def _array(data: Mapping[str, Any], key: str, shape: tuple[int, ...]) -> Any:
    """Numbers of a given shape, null read as NaN; None where the key is absent or null."""
    if data.get(key) is None:
        return None
    try:
        value = np.array(data[key], dtype=object).astype(np.float64)
    except (TypeError, ValueError):
        raise ModelError(f"'{key}' must hold numbers (or null) in shape {shape}") from None
    if value.shape != shape:
        raise ModelError(f"'{key}' must have shape {shape}, got {value.shape}")
    return value


def _bools(data: Mapping[str, Any], key: str, shape: tuple[int, ...]) -> Any:
    if data.get(key) is None:
        return None
    value = np.array(data[key])
    if value.shape != shape or value.dtype != bool:
        raise ModelError(f"'{key}' must hold true and false in shape {shape}")
    return value


def _numbers(array: Any) -> Any:
    """Nested lists of floats, NaN as None, infinity as the text "inf" (JSON has neither)."""
    if np.ndim(array) > 0:
        return [_numbers(row) for row in array]
    value = float(array)
    if math.isnan(value):
        return None
    return str(value) if math.isinf(value) else value


def _plain(value: Any) -> Any:
    """Effects and provenance as JSON holds them: numpy's types made Python's, NaN as None."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return _numbers(value) if isinstance(value, float) else value


def _text(value: Any, indent: int) -> str:
    """JSON with one line for each list of numbers or names, so that λ and θ read as tables."""
    pad = " " * (indent + 1)
    if isinstance(value, Mapping) and value:
        items = [f"{pad}{json.dumps(str(k))}: {_text(v, indent + 1)}" for k, v in value.items()]
        return "{\n" + ",\n".join(items) + "\n" + " " * indent + "}"
    if isinstance(value, list | tuple) and any(
        isinstance(v, list | tuple | dict) or str(v).endswith("\n") for v in value
    ):
        rows = [f"{pad}{_text(v, indent + 1)}" for v in value]
        return "[\n" + ",\n".join(rows) + "\n" + " " * indent + "]"
    return json.dumps(value, ensure_ascii=False, allow_nan=False)
