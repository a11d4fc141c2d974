"""Settings from TOML: every key checked, every value of its kind, and back again."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adapter.errors import ModelError, SettingsError
from adapter.model.robots import documented
from adapter.runs.config import Config, config_from, config_recorded, config_table, read_config
from tests.helpers.robot_models import file_of

WHOLE = file_of("config.toml")


def written(folder: Path, text: str) -> Path:
    path = folder / "settings.toml"
    path.write_text(text)
    return path


def test_a_recording_of_another_version_keeps_what_this_one_knows():
    table = config_table(Config(gravity=(0.0, 9.81, 0.0)))
    table["pipeline"]["learner"]["schema"]["old_goal"] = 1e-3
    table["colour"] = "red"
    found, unknown = config_recorded(table, "configuration in the recording")
    assert found == Config(gravity=(0.0, 9.81, 0.0))
    assert unknown == ["colour", "pipeline.learner.schema.old_goal"]
    table["gravity"] = "down"
    with pytest.raises(SettingsError, match="in the recording: gravity needs"):
        config_recorded(table, "configuration in the recording")


def refusal(folder: Path, text: str) -> str:
    with pytest.raises(SettingsError) as refused:
        read_config(written(folder, text))
    said = str(refused.value)
    assert "settings.toml" in said and "\n" not in said
    return said


def test_no_file_means_the_defaults() -> None:
    assert read_config(None) == Config() == config_from({})


def test_every_value_arrives(tmp_path: Path) -> None:
    config = read_config(written(tmp_path, WHOLE))
    assert config.gravity == (9.81, 0.0, 0.0)
    assert config.tool is not None and config.tool.mass == 1.0
    learner = config.pipeline.learner
    assert config.pipeline.filter.bandwidth_hz == 8.0
    assert config.pipeline.front_end.rest_dq == 0.03
    assert (learner.mode, learner.seed, learner.wait_for_schema) == ("sample", 4, False)
    assert learner.effects == ("viscous_friction", "coulomb_friction")
    assert learner.schema.forget_s == 3.0 and learner.theta.forget_s is None
    assert learner.theta.betas == (0.9, 0.95) and learner.theta.restarts == (10, 20)
    assert not learner.change.enabled
    assert config.excitation.seed == 9
    assert config.excitation.rests == ((5.0, 8.0), (12.0, 15.0))


@pytest.mark.parametrize("text", ["", WHOLE])
def test_there_and_back(tmp_path: Path, text: str) -> None:
    config = read_config(written(tmp_path, text))
    table = config_table(config)
    assert config_from(table) == config
    plain = json.dumps(table)  # nothing but what JSON and TOML know, None left out
    assert json.loads(plain) == table and "null" not in plain


def sections(kind: type, where: str = "") -> list[tuple[str, type]]:
    """All tables there are, with their dotted names."""
    default = kind(mass=1.0) if kind.__name__ == "ToolSettings" else kind()
    found = [(where, kind)]
    for item in dataclasses.fields(kind):
        part = getattr(default, item.name)
        if dataclasses.is_dataclass(part):
            found += sections(type(part), f"{where}.{item.name}".strip("."))
    return found


@pytest.mark.parametrize(("where", "kind"), sections(Config), ids=lambda x: str(x))
def test_a_key_that_does_not_exist_is_named_with_the_choices(tmp_path, where, kind) -> None:
    text = f"[{where}]\nbandwith = 3.0\n" if where else "bandwith = 3.0\n"
    said = refusal(tmp_path, text)
    assert "no setting 'bandwith'" in said
    for item in dataclasses.fields(kind):
        assert item.name in said
    assert where.split(".")[-1] in said


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("gravity = 9.81", "gravity needs a list, got 9.81"),
        ("gravity = [0.0, 9.81]", "gravity needs 3 numbers, got 2"),
        ("gravity = [true, 0, 0]", "needs float, got True"),
        ("pipeline = 3", "pipeline: needs a table, got 3"),
        ("[pipeline.filter]\nbandwidth_hz = 'low'", "bandwidth_hz needs float, got 'low'"),
        ("[pipeline.filter]\nbandwidth_hz = 0", "bandwidth_hz must be above zero"),
        ("[pipeline.learner]\nmode = 'batch'", "no learner mode 'batch'; have: moments, sample"),
        ("[pipeline.learner.schema]\nforget_s = 0.001", "schema.forget_s must be at least 0.05"),
        ("[pipeline.learner.change]\nenabled = 1", "enabled needs bool, got 1"),
        ("[pipeline.learner.change]\nfast = 5000", "change.fast"),
        ("[excitation]\nlow_hz = 2.0", "low_hz"),
        ("[tool]\nmass = 0.0", "mass > 0"),
        ("[tool]\nmass = 1.0\ncom = [1.0]", "com of 3"),
        ("[tool]\ncom = [0.0, 0.0, 0.0]", "mass"),
        ("gravity = ", "not TOML"),
        # These would fail later, without a word.
        ("[pipeline.learner.theta]\nbetas = [0.9]", "betas"),
        ("[pipeline.learner.theta]\nbetas = [0.9, 1.5]", "betas"),
        ("[excitation]\nrests = [[1.0]]", "rests"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path: Path, text: str, said: str) -> None:
    assert said in refusal(tmp_path, text)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"nowhere\.toml: cannot be read: No such file"):
        read_config(tmp_path / "nowhere.toml")


def test_what_only_the_parts_know_is_refused_too() -> None:
    said = r"no effect 'stiction'; have: .*; did you mean bristle_friction"
    with pytest.raises(SettingsError, match=said):
        config_from({"pipeline": {"learner": {"effects": ["stiction"]}}})
    with pytest.raises(ModelError, match="gravity holds a value that is not finite"):
        config_from({"gravity": [0.0, 0.0, np.nan]}).apply(documented("panda"))


def test_gravity_and_tool_reach_the_model() -> None:
    panda = documented("panda")
    config = config_from({"gravity": [0.0, 9.81, 0.0], "tool": {"mass": 2.0, "com": [0, 0, 0.1]}})
    model = config.apply(panda)
    assert model.gravity.tolist() == [0.0, 9.81, 0.0]
    assert model.tool is not None
    assert np.allclose(model.tool.theta()[:4], [2.0, 0.0, 0.0, 0.2])
    assert Config().apply(panda).gravity.tolist() == panda.gravity.tolist()


VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5)),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=6,
)
NAMES = sorted({item.name for _, kind in sections(Config) for item in dataclasses.fields(kind)})


@settings(max_examples=300, deadline=None, derandomize=True)
@given(
    where=st.sampled_from([w for w, _ in sections(Config)]),
    key=st.sampled_from(NAMES),
    value=VALUES,
)
def test_nonsense_is_refused_in_one_sentence_or_taken(where: str, key: str, value: object) -> None:
    table: dict = {}
    inner = table
    for name in where.split(".") if where else []:
        inner = inner.setdefault(name, {})
    inner[key] = value
    try:
        config = config_from(table)
    except SettingsError as error:
        assert str(error).startswith("configuration")
    else:
        assert config_from(config_table(config)) == config or value != value
