"""Laws that people keep: found in one recording, named, looked for by that name in the next."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from adapter.effects.base import Template, Values
from adapter.effects.catalogue import CATALOGUE, registered
from adapter.effects.law import EXPRESSIONS, LAW, LAWS, Law
from adapter.errors import SettingsError
from drivers.errors import choices

NAME = re.compile(r"[a-z][a-z0-9_]*")


class KeptLaw(Law):
    """A law with a name, looked for as the effects of the catalogue are.

    Args:
        law: what it is; name, title: what people call it.
        values: its coefficient and setting as they were found: the search begins there, and
            another arm's is about as large.
    """

    def __init__(self, law: Law, name: str, title: str, values: Values) -> None:
        super().__init__(law.expression, law.by)
        self.in_files = law.name  # type: ignore[misc]
        self.name, self.title, self.log_odds = name, title, 0.0  # type: ignore[misc]
        self.values = {p.key: float(values.get(p.key, 0.0)) for p in self.parameters}

    def templates(self) -> tuple[Template, ...]:
        """At the setting that it was kept with."""
        setting = self.expression.setting
        template = self.at(self.values[setting.key] if setting else 1.0)
        std = abs(self.values["c"]) or 1.0
        return (replace(template, prior_std=(std,) * len(template.prior_std)),)

    def reshaped(self, values: Values, ratio: float) -> tuple[Template, ...]:
        """Another setting, of one that is no whole number."""
        setting = self.expression.setting
        if setting is None or setting.wave:
            return ()
        other = self.at(ratio * float(values[setting.key]))
        return (replace(other, prior_std=self.templates()[0].prior_std),)


def read_kept(path: Path) -> list[KeptLaw]:
    """The laws in a TOML file: a table each, its name being the law's.

    Raises:
        OSError: there is no such file.
        SettingsError: it is no TOML; names the table, the key and the choices.
    """
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path}: not TOML: {error}") from None
    if not tables:
        raise SettingsError(f"{path}: holds no law; `adapter effects keep` writes one")
    return [_law(f"{path}: [{name}]", name, table) for name, table in tables.items()]


def _law(where: str, name: str, table: Any) -> KeptLaw:
    _check_name(where, name)
    if not isinstance(table, Mapping) or "law" not in table:
        raise SettingsError(f'{where} needs law, as in law = "dq |dq|"')
    law = LAWS.get(f"{LAW}{table['law']}")
    if law is None:
        text = str(table["law"])
        raise SettingsError(f"{where}: no law '{text}'; {choices(text, EXPRESSIONS)}")
    setting = law.expression.setting
    for p in law.parameters:
        needed = p.key == "c" or (setting is not None and p.key == setting.key)
        if needed and not isinstance(table.get(p.key), int | float):
            raise SettingsError(f"{where} needs the number {p.key} ({p.unit or '1'})")
    return KeptLaw(law, name, str(table.get("title", name)), table)


def _check_name(where: str, name: str) -> None:
    if not NAME.fullmatch(name):
        raise SettingsError(f"{where}: a name has small letters, digits and _: hose_joint_3")
    if name in CATALOGUE:
        raise SettingsError(f"{where}: there is an effect '{name}' already")


@contextmanager
def with_kept(path: Path | str | None) -> Iterator[None]:
    """The catalogue with the laws of a file, as long as the block lasts.

    Args:
        path: of the file, as `keep_law` writes it; None for none.

    Raises:
        OSError, SettingsError: as `read_kept`.

    >>> import adapter
    >>> with adapter.with_kept(None):
    ...     result = adapter.find_gap("recordings/panda_nominal_6s.mcap")
    """
    with ExitStack() as stack:
        for law in read_kept(Path(path)) if path is not None else ():
            stack.enter_context(registered(law))
        yield


def keep(
    findings: Path | Sequence[Mapping[str, Any]], name: str, joint: int | None, path: Path
) -> str:
    """Add a law of a gap's result to a file under a name; returns the text that was added.

    Args:
        findings: of the result, or its gap.json, or the folder that holds it.
        joint: (from 1) of the law, where the result has several.

    Raises:
        OSError: a file that is not there.
        SettingsError: a result without such a law, a name that is taken; names the choices.
    """
    where = findings if isinstance(findings, Path) else "the result"
    if isinstance(findings, Path):
        try:
            kept = findings / "gap.json" if findings.is_dir() else findings
            findings = list(json.loads(kept.read_text(encoding="utf-8"))["findings"])
        except (ValueError, KeyError, TypeError):
            raise SettingsError(f"{where}: no result of `adapter gap`") from None
    laws = [f for f in findings if f["effect"] in LAWS]
    found = [f for f in laws if joint in (None, *f["joints"])]
    if len(found) != 1:
        have = "; ".join(f"joint {f['joints'][0]}: {f['effect'].removeprefix(LAW)}" for f in laws)
        one = "several laws, say --joint" if found else "no such law"
        raise SettingsError(f"{where}: {one}; have: {have or 'none'}")
    _check_name(str(path), name)
    if path.exists() and name in {law.name for law in read_kept(path)}:
        raise SettingsError(f"{path}: [{name}] is there already; choose another name")
    text = _as_toml(name, found[0])
    with path.open("a", encoding="utf-8") as file:
        file.write(text)
    return text


def _as_toml(name: str, finding: Mapping[str, Any]) -> str:
    lines = [f"[{name}]", f'title = "{name}"']
    text, joints = finding["effect"].removeprefix(LAW), list(finding["joints"])
    lines += [f'law = "{text}"', f"joints = {joints}"]
    for key, value in finding["parameters"].items():
        unit, std = finding["units"].get(key, ""), finding["std"].get(key) or 0.0
        lines.append(f"{key} = {float(value)!r}  # {unit}, ± {std:.2g}".replace("# ,", "#"))
    return "\n".join([*lines, "", ""])
