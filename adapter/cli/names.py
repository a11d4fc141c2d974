"""Names on a command line and in a settings file that other rooms know; light to load."""

from __future__ import annotations

import argparse
from pathlib import Path

from adapter.effects.catalogue import REAL_ARM_EFFECTS, effects_by_name
from adapter.effects.kept import read_kept
from adapter.effects.law import LAW
from adapter.errors import SettingsError
from adapter.runs.config import read_config
from drivers.faults.spec import Faults
from sim.options import DEFAULT_SCENARIO, options_of
from sim.options import check as check_scenario


def check_run(args: argparse.Namespace) -> None:
    """Scenario and faults of `run`. Raises ValueError, DriverError with the choices."""
    if args.scenario or args.set:
        check_scenario(args.scenario or DEFAULT_SCENARIO, options_of(args.set))
    if args.fault is not None:
        Faults.parse(args.fault)


def effects_named(text: str) -> tuple[str, ...]:
    """Names of the effects to learn: none, or a list with commas between, real being several.

    A file of kept laws (.toml) stands for those that it holds.

    Raises:
        SettingsError: no such effect, with the choices; a law that is not learned online.
        OSError: no such file.
    """
    if text == "none":
        return ()
    names: dict[str, None] = {}
    for name in (name.strip() for name in text.split(",") if name.strip()):
        if name.endswith(".toml"):
            for law in read_kept(Path(name)):
                own = law.learned_from(law.values)
                if not own:
                    raise SettingsError(
                        f"{name}: [{law.name}] is c {law.in_files.removeprefix(LAW)}: what follows "
                        "the load is not learned online; a model that has it, from adapter gap, "
                        "keeps it as it is"
                    )
                names |= dict.fromkeys(own)
        else:
            known = effects_by_name(REAL_ARM_EFFECTS if name == "real" else (name,))
            names |= dict.fromkeys(effect.name for effect in known)
    return tuple(names)


def check_learning(args: argparse.Namespace) -> None:
    """`--effects` and what `--config` says. Raises SettingsError."""
    if args.effects is not None:
        effects_named(args.effects)
    read_config(args.config)
