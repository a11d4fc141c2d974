"""What a run leaves behind: a folder that a report can be made from at any time.

`model.json` (learned) and `documented.json` are model files, `figures.json` the figures as in
`--json`, `traces.npz` plain arrays over time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from adapter.errors import ModelError
from adapter.model.model_file import load_model, save_model, whole_file
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.runs.outcome import Outcome, learned_model, told_parameters
from adapter.runs.score import Reference, ScoreRows, course_errors, stamps_s
from adapter.runs.terminal import json_text
from drivers.files.bounded import parse_json, read_arrays, read_text

VERSION = 2
MODEL, DOCUMENTED = "model.json", "documented.json"
FIGURES, TRACES = "figures.json", "traces.npz"
FILES = (MODEL, DOCUMENTED, FIGURES, TRACES)


class RunFolderError(ModelError):
    """A run folder cannot be read or written; the message names the file and what is wrong."""


@dataclass(frozen=True)
class RunData:
    """Everything a report shows, n joints, P = 10 (n + 1) + effects x n flat parameters.

    A base that floats is in the models alone.

    Attributes:
        figures: the JSON of `run` and `replay`. Beside the keys of `score.figures` a report
            shows `warnings` (sentences), `fault`, `timing` (`TimingReport.as_dict()`, and in it
            `histograms`: {name: {"edges_us": [..], "counts": [..]}}), `granted` (sentences),
            `tracking` (name -> {"samples", "rms_rad", "max_rad"}), `feedforward` (which model),
            `gaps` (one entry each), `times_real_time`.
        model: learned; its `provenance` is the report's footer.
        documented: what the arm's maker says.
        reference: (n, 6) λ that errors are against; None where there is none.
        start_lam: (n, 6) λ at first.
        schema_errors: (2, k, n) of the rows of schema_trace: rad and m against the reference, in
            what the data had shown by then; zeros where there is no reference.
        schema_trace: rows [stamp ns, λ]; theta_trace: rows [stamp ns, θ, spare body, effects].
        score_trace: rows [stamp ns, q, dq, ddq, tau, torque error before learning].
        fit, batch: (k, n) torque of the learned model and of the final batch least squares on
            the rows of `score_trace`, N m; zero rows where θ was not learned.
        noise: (n,) standard deviation of the residual torque, N m.
        lam_shown: (n, 6) share of each turn and shift that lies in the directions data showed.
        theta_shown: (n, 10) share of each parameter that torques can show.
        delay_s: age of a filtered state against the sample that completed it.
        first_moving_ns: stamp of the first moving sample; None where nothing moved.

    Raises:
        RunFolderError: figures or arrays that do not fit together.
    """

    figures: dict[str, Any]
    model: SelfModel
    documented: SelfModel
    reference: Array | None
    start_lam: Array
    schema_trace: Array
    schema_errors: Array
    theta_trace: Array
    score_trace: Array
    fit: Array
    batch: Array
    noise: Array
    lam_shown: Array
    theta_shown: Array
    delay_s: float
    first_moving_ns: int | None

    def __post_init__(self) -> None:
        n = self.n
        needed = "samples", "learned", "refused", "lambda", "theta"
        missing = [key for key in needed if key not in self.figures]
        if missing:
            raise RunFolderError(f"the figures lack '{missing[0]}'")
        if self.model.tree.n != n:
            raise RunFolderError(f"model has {self.model.tree.n} joints, documented has {n}")
        rows = len(self.score_trace)
        shapes: dict[str, tuple[int, ...]] = {
            "start_lam": (n, 6),
            "schema_trace": (len(self.schema_trace), 1 + 6 * n),
            "schema_errors": (2, len(self.schema_trace), n),
            "score_trace": (rows, 1 + 5 * n),
            "fit": (rows, n),
            "batch": (rows, n),
            "noise": (n,),
            "lam_shown": (n, 6),
            "theta_shown": (n, 10),
        }
        if self.reference is not None:
            shapes["reference"] = (n, 6)
        for key, shape in shapes.items():
            if getattr(self, key).shape != shape:
                found = getattr(self, key).shape
                raise RunFolderError(f"'{key}' must have shape {shape}, got {found}")
        if self.theta_trace.ndim != 2 or self.theta_trace.shape[1] < 1 + 10 * (n + 1):
            raise RunFolderError(f"'theta_trace' has shape {self.theta_trace.shape}")

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.documented.tree.n

    @property
    def start_s(self) -> float:
        """Stamp that times count from, s: the filtered instant of the first moving sample."""
        if self.first_moving_ns is not None:
            return 1e-9 * self.first_moving_ns - self.delay_s
        return float(stamps_s(self.schema_trace)[0]) if len(self.schema_trace) else 0.0

    def times(self, trace: Array) -> Array:
        """(k,) s after the first motion of the rows of a trace."""
        return stamps_s(trace) - self.start_s

    def converged_s(self, which: str) -> float | None:
        """When `lambda` or `theta` had converged, s after the first motion."""
        at = self.figures[which].get("converged_s")
        return None if at is None else float(at + self.figures.get("slow_s", 0.0))

    def score_signals(self) -> tuple[Array, Array, Array, Array, Array]:
        """q, dq, ddq, tau and prequential torque error, (k, n) each."""
        q, dq, ddq, tau, error = np.split(self.score_trace[:, 1:], 5, axis=1)
        return q, dq, ddq, tau, error


TRACE_ARRAYS = tuple(x.name for x in fields(RunData) if x.type == "Array")


def run_data(
    outcome: Outcome,
    documented: SelfModel,
    figures: Mapping[str, Any],
    reference: Reference | None,
    /,
    *,
    delay_s: float,
    first_moving_ns: int | None,
    **provenance: Any,
) -> RunData:
    """What a run leaves behind, from what its learner told.

    Args:
        figures: of `score.figures`, with whatever the caller added.
        reference: as given to `score.figures`.
        provenance: JSON values for the model file and the report's footer, such as version,
            command, recording, settings.
    """
    n = documented.tree.n
    fit = batch = np.zeros((len(outcome.score_trace), n))
    if len(outcome.score_trace):
        rows = ScoreRows(outcome, documented)
        fit = rows.torque(outcome.theta, outcome.effects)
        batch = rows.batch_torque()
    errors = np.zeros((2, len(outcome.schema_trace), n))
    if reference is not None:
        errors[:] = course_errors(outcome, documented, reference)
    model = learned_model(outcome, documented)
    basis = told_parameters(outcome, documented).basis
    shown, first = np.einsum("ab,ab->a", basis, basis), int(documented.tree.floating)
    return RunData(
        figures=dict(figures),
        model=replace(model, provenance={**provenance, **model.provenance}),
        documented=documented,
        reference=None if reference is None else reference.lam,
        start_lam=outcome.start_lam,
        schema_trace=outcome.schema_trace,
        schema_errors=errors,
        theta_trace=np.delete(outcome.theta_trace, np.s_[1 : 1 + 10 * first], axis=1),
        score_trace=outcome.score_trace[:, : 1 + 5 * n],
        fit=fit,
        batch=batch,
        noise=np.sqrt(outcome.variance),
        lam_shown=np.clip(np.einsum("jaa->ja", outcome.lam_identifiable), 0.0, 1.0),
        theta_shown=np.clip(shown.reshape(-1, 10)[first:], 0.0, 1.0),
        delay_s=delay_s,
        first_moving_ns=first_moving_ns,
    )


def save_run(folder: str | Path, data: RunData) -> Path:
    """Write the four files, each whole or not at all. Returns the folder.

    Raises:
        RunFolderError: the folder cannot be written.
    """
    folder = Path(folder)
    arrays: dict[str, Any] = {key: getattr(data, key) for key in TRACE_ARRAYS}
    arrays["version"] = np.array(VERSION)
    arrays["delay_s"] = np.array(data.delay_s)
    if data.first_moving_ns is not None:
        arrays["first_moving_ns"] = np.array(data.first_moving_ns, dtype=np.int64)
    if data.reference is not None:
        arrays["reference"] = data.reference
    try:
        save_model(data.model, folder / MODEL)
        save_model(data.documented, folder / DOCUMENTED)
        with whole_file(folder / FIGURES) as part:
            part.write_text(json_text(data.figures), encoding="utf-8")
        with whole_file(folder / TRACES) as part, part.open("wb") as file:
            np.savez_compressed(file, **arrays)
    except OSError as error:
        raise RunFolderError(f"{folder}: cannot be written: {error.strerror}") from error
    return folder


def load_run(folder: str | Path) -> RunData:
    """Read what `save_run` wrote.

    Raises:
        RunFolderError: no such folder, a file missing, cut or of another version.
        ModelError: one of the two model files is wrong.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise RunFolderError(f"{folder}: no such run folder; `run` and `replay` write one")
    missing = [name for name in FILES if not (folder / name).is_file()]
    if missing:
        raise RunFolderError(f"{folder}: lacks {', '.join(missing)}; a run has {', '.join(FILES)}")
    path = folder / TRACES
    try:
        arrays = read_arrays(path)
    except (OSError, ValueError) as error:
        raise RunFolderError(f"{path}: cannot be read as traces ({error})") from None
    version = arrays.get("version")
    if version is None or version.shape != () or int(version) != VERSION:
        raise RunFolderError(f"{path}: version {version} of the traces; have: {VERSION}")
    missing = [key for key in (*TRACE_ARRAYS, "delay_s") if key not in arrays]
    if missing:
        raise RunFolderError(f"{path}: lacks the array '{missing[0]}'")
    moving = arrays.get("first_moving_ns")
    try:
        return RunData(
            figures=_read_figures(folder / FIGURES),
            model=load_model(folder / MODEL),
            documented=load_model(folder / DOCUMENTED),
            reference=arrays.get("reference"),
            delay_s=float(arrays["delay_s"]),
            first_moving_ns=None if moving is None else int(moving),
            **{key: arrays[key] for key in TRACE_ARRAYS},
        )
    except RunFolderError as error:
        where = "" if str(error).startswith(str(folder)) else f"{folder}: "
        raise RunFolderError(f"{where}{error}") from None


def _read_figures(path: Path) -> dict[str, Any]:
    try:
        figures = parse_json(read_text(path))
    except (OSError, ValueError) as error:
        raise RunFolderError(f"{path}: cannot be read as figures ({error})") from None
    if not isinstance(figures, dict):
        raise RunFolderError(f"{path}: needs a JSON object, got {type(figures).__name__}")
    return figures
