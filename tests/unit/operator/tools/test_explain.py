"""Every key of every file has a description on the configuration page and in `snakesim config --explain`."""

import json
from pathlib import Path

import pytest

from docs.site.configuration_page import (
    PAGE,
    documented_structs,
    fields_without_description,
    make_page,
)
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.scenario import LoadedScenario, load_scenario, parse_set_option
from snakesim_operator.this_computer.explain import explain_key
from snakesim_operator.this_computer.scenario_files import collect_values
from snakesim_operator.this_computer.scenario_keys import collect_keys

SCENARIOS = ("triplet", "peg_row", "surveyed_clutter")


def explain(loaded: LoadedScenario, key: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Return what the command prints about a key."""
    assert explain_key(loaded, key, as_json=False) == 0
    return capsys.readouterr().out


def explain_as_json(
    loaded: LoadedScenario, key: str, capsys: pytest.CaptureFixture[str]
) -> dict[str, object]:
    """Return what the command prints about a key for scripts."""
    assert explain_key(loaded, key, as_json=True) == 0
    return json.loads(capsys.readouterr().out)


# --- all files -------------------------------------------------------------------------------------------------


def test_explain_page_describes_every_field_of_every_file() -> None:
    assert fields_without_description() == []


def test_explain_page_is_current() -> None:
    assert PAGE.read_text(encoding="utf-8") == make_page(), (
        "run `make schemas` and commit what it changes"
    )


def test_explain_page_contains_all_kinds_of_files_and_plugins() -> None:
    page = PAGE.read_text(encoding="utf-8")
    structs = documented_structs()
    assert {"Robot file", "Scene file", "Scenario file", "Suite file", "Lab file"} <= set(structs)
    for heading in structs:
        assert heading.split(".")[-1].strip("[]") in page


# --- one key of a scenario -------------------------------------------------------------------------------------


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_explain_knows_every_key_of_a_scenario(
    scenario: str, capsys: pytest.CaptureFixture[str]
) -> None:
    loaded = load_scenario(scenario)
    keys = collect_keys(loaded)
    for name, value, origin in collect_values(loaded):
        key = keys[name]
        assert key.doc.description, name
        if name != "robot.joints":  # each joint has a separate key
            assert (key.value, key.origin) == (value, origin), name
    for name in ("seed", "robot.limits.torque_nm", "control", "robot", "scene.route.kind"):
        assert explain(loaded, name, capsys)


def test_explain_value_has_documentation_and_origin(
    capsys: pytest.CaptureFixture[str],
) -> None:
    loaded = load_scenario("triplet", [parse_set_option("control.propulsion_n=20")])
    lines = explain(loaded, "control.propulsion_n", capsys).splitlines()
    assert lines[0] == "controllers.obstacle_triplet.propulsion_n"
    assert lines[1].startswith("  Maximum propulsion force")
    rows = {line.split()[0]: line.strip().partition(" ")[2].strip() for line in lines[2:]}
    assert rows == {
        "type": "number",
        "unit": "N",
        "range": "> 0, <= 10000",
        "default": "35.0",
        "value": "20.0",
        "from": "--set control.propulsion_n=20",
    }


def test_explain_json_has_the_same_content(capsys: pytest.CaptureFixture[str]) -> None:
    key = explain_as_json(load_scenario("triplet"), "rate_hz", capsys)
    assert key["unit"] == "Hz"
    assert key["value"] == 100.0
    assert str(key["origin"]).endswith("triplet.toml")
    table = explain_as_json(load_scenario("triplet"), "robot.module", capsys)
    assert isinstance(table["keys"], dict)
    assert list(table["keys"]) == ["length_m", "radius_m", "mass_kg"]


def test_explain_table_has_one_line_for_each_key(capsys: pytest.CaptureFixture[str]) -> None:
    lines = explain(load_scenario("triplet"), "robot.module", capsys).splitlines()
    first_key_line = lines.index("keys") + 2
    assert [line.split()[0] for line in lines[first_key_line:]] == [
        "length_m",
        "radius_m",
        "mass_kg",
    ]


@pytest.mark.parametrize(
    "key",
    [
        "scene.cylinder",
        "scene.cylinder.radius_m",  # of every entry
        "robot.joints.joint_3.torque_nm",  # an exception that the file does not have
        "mission.goal.points_m",  # of a goal that the scenario does not have
        "controllers.rolling.bend_rad",  # of a controller that the scenario does not use
        "backends.can.physics_model_settings.timestep_s",
        "backends.can.mounted.backlash_rad",
        "controllers.policy.model",
    ],
)
def test_explain_knows_keys_that_the_scenario_does_not_set(
    key: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert explain(load_scenario("triplet"), key, capsys).startswith(key)


def test_explain_lists_plugin_values_without_running_its_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "wave.py").write_text("class Wave: ...\nraise SystemExit")
    overrides = [
        parse_set_option(f"controller={tmp_path}/wave.py:Wave"),
        parse_set_option("control.lag_rad=0.5"),
    ]
    lines = explain(load_scenario("triplet", overrides), "control.lag_rad", capsys).splitlines()
    assert lines[:2] == ["controllers.Wave.lag_rad", "  Checked by the code of its plugin."]
    assert "  value    0.5" in lines


@pytest.mark.parametrize(
    ("key", "hint"),
    [
        ("robot.limits.torqe_nm", "did you mean `robot.limits.torque_nm`"),
        ("torque_nm", "did you mean `robot.limits.torque_nm`"),
        ("control.propulsion", "did you mean `controllers.obstacle_triplet.propulsion_n`"),
        ("robt.limits", "did you mean `robot.limits`"),
        ("robot.module.zzz", "`robot.module` has length_m, radius_m, mass_kg"),
        ("zzz", "are name, title, robot"),
        ("scene.cylinder.99", "there is no such key"),
        ("robot..", "there is no such key"),
    ],
)
def test_explain_unknown_key_is_error_with_suggestion(key: str, hint: str) -> None:
    with pytest.raises(ConfigError, match="there is no such key") as caught:
        explain_key(load_scenario("triplet"), key, as_json=False)
    assert hint in str(caught.value)
