"""Suite files: the conditions and trials that they describe, and errors of wrong ones. Wrong options: refusals.toml."""

from pathlib import Path

import msgspec
import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import list_shipped_names
from snakesim_hal.model.scenario import RunConfig
from snakesim_operator.cli import main
from snakesim_operator.features.evaluate.conditions import make_conditions
from snakesim_operator.features.evaluate.suite import EvaluationSuite, read_suite
from snakesim_operator.features.evaluate.trial import EvaluationTrial
from snakesim_operator.features.evaluate.trial_list import make_trials
from snakesim_testing.messages import raises_error

# Two named conditions, each with 2 densities and 3 friction coefficients.
TWELVE_CONDITIONS = """
scenario = "surveyed_clutter"
[set]
duration_s = 20
[vary]
"scene.random_field.0.density_per_m2" = [4, 8]
"scene.ground.friction" = "0.1:0.3:3"
[[condition]]
name = "as shipped"
[[condition]]
name = "pegs only"
[[condition.set.scene.random_field]]
min_corner_m = [2, -1]
max_corner_m = [3, 1]
density_per_m2 = 1
radius_m = [0.03, 0.03]
clearance_m = 0.1
seed = 1
"""


def read_suite_text(folder: Path, text: str) -> tuple[EvaluationSuite, str]:
    """Write a suite file into a folder, and read it. Return the suite and its path."""
    path = folder / "mine.toml"
    path.write_text(text)
    return read_suite(str(path))


def decode_config(trial: EvaluationTrial) -> RunConfig:
    return msgspec.json.decode(trial.config, type=RunConfig)


def test_suite_contains_every_condition_in_every_combination(tmp_path: Path) -> None:
    suite, source = read_suite_text(tmp_path, TWELVE_CONDITIONS)
    names = [condition.name for condition in make_conditions(suite, source)]
    assert len(names) == 12
    assert names[0] == "as shipped, density_per_m2 4, friction 0.1"
    assert names[-1] == "pegs only, density_per_m2 8, friction 0.3"
    trials = make_trials(suite, source, ["hold", "path_following"], 2, first_seed=7)
    assert len(trials) == 12 * 2 * 2
    assert len({trial.id for trial in trials}) == len(trials)
    last_config = decode_config(trials[-1])
    assert last_config.duration_s == 20
    assert last_config.clock_mode == "lockstep"
    assert last_config.controller == "path_following"
    assert last_config.scene.ground.friction == pytest.approx(0.3)
    assert last_config.seed == 8
    assert last_config.scene.random_field[0].seed == 8
    assert last_config.scene.random_field[0].density_per_m2 == 8
    assert last_config.scene.random_field[0].box_fraction == 0


def test_trial_id_depends_only_on_what_the_trial_runs(tmp_path: Path) -> None:
    suite, source = read_suite_text(tmp_path, TWELVE_CONDITIONS)
    few_trials = make_trials(suite, source, ["hold"], 1, first_seed=8)
    more_trials = make_trials(suite, source, ["hold"], 2, first_seed=7)
    few_ids = {trial.id for trial in few_trials}
    assert few_ids < {trial.id for trial in more_trials}

    renamed = msgspec.structs.replace(suite, title="another", condition=[])
    renamed_trials = make_trials(renamed, "elsewhere", ["hold"], 1, first_seed=8)
    assert {trial.id for trial in renamed_trials} < few_ids


QUICK_SUITES = {"pushing"}  # `make verify` tries the others


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in QUICK_SUITES else pytest.mark.slow)
        for name in list_shipped_names("suites")
    ],
)
def test_shipped_suites_can_be_run(name: str) -> None:
    suite, source = read_suite(name)
    assert suite.title
    assert len(make_trials(suite, source, suite.controllers[:1], 1, first_seed=1)) >= 1


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ("", ["mine.toml", "scenario", "missing"]),
        ('scenario = "nowhere"', ["no scenario called 'nowhere'", "triplet"]),
        ('scenario = "jam"\nseed = 3', ["mine.toml", "`seed`", "did you mean `seeds`"]),
        ('scenario = "jam"\nseeds = 0', ["mine.toml", "`seeds` = 0", ">= 1"]),
        (
            'scenario = "jam"\ncontrollers = ["wave"]',
            ["no controller called 'wave'", "obstacle_triplet"],
        ),
        (
            'scenario = "jam"\n[set]\nscene.ground.frictoin = 1',
            ["mine.toml: [set]", "did you mean `friction`"],
        ),
        (
            'scenario = "jam"\n[set]\nscene.ground.friction = 9',
            ["[set]: `scene.ground.friction` = 9", "<= 5"],
        ),
        ('scenario = "jam"\n[vary]\nseed = []', ["mine.toml", "`vary.seed` is empty"]),
        ('scenario = "jam"\n[vary]\nrate_hz = "1:2"', ["`vary.rate_hz` = '1:2'", "low:high:count"]),
        (
            'scenario = "jam"\n[vary]\nrate_hz = "1:2:1"',
            ["`vary.rate_hz` = '1:2:1'", "count of 2 to 1000"],
        ),
        (
            'scenario = "jam"\n[vary]\nrate_hz = [100, 1]',
            ["mine.toml: [vary]", "`rate_hz` = 1", "Hz", ">= 20"],
        ),
        (
            'scenario = "jam"\n[[condition]]\nname = "a"\n[[condition]]\nname = "a"',
            ["two conditions are called 'a'"],
        ),
        ('scenario = "jam"\nfields = 3', ["mine.toml", "`fields` is now called `seeds`"]),
        (
            'scenario = "jam"\n[[row]]\nname = "a"',
            ["mine.toml", "`row` is now called `condition`"],
        ),
        (
            'scenario = "jam"\n[set]\nscene.random_field.0.density_per_m2 = 3',
            ["[set]", "`scene.random_field`", "expected a list"],
        ),
        (
            'scenario = "surveyed_clutter"\n[set]\nscene.random_field.0.density_per_m2 = 150',
            ["condition 1", "1380 pegs"],
        ),
        ('scenario = "jam"\n[set]\nbackend = "nobody"', ["no backend called 'nobody'"]),
    ],
)
def test_wrong_suite_is_refused_with_place_and_reason(
    text: str, reported: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.toml").write_text(text)
    assert (
        main(["study", "evaluate", str(tmp_path / "mine.toml"), "--out", str(tmp_path / "out")])
        == 2
    )
    error_text = capsys.readouterr().err
    assert all(part in error_text for part in reported), error_text
    assert not (tmp_path / "out").exists()


def test_suite_with_too_many_trials_is_refused(tmp_path: Path) -> None:
    suite, source = read_suite_text(tmp_path, 'scenario = "jam"\n[vary]\nseed = "1:1000:1000"')
    with raises_error(ConfigError, code="command/invalid-option"):
        make_trials(suite, source, [], 300, 1)


RANDOM_FRICTION = """
scenario = "surveyed_clutter"
[[randomize]]
set = ["scene.random_field.0.friction", "scene.pegs_along_route.0.friction"]
low = 0.1
high = 0.3
[[condition]]
name = "random friction"
[[condition]]
name = "a launch row of ice"
not_randomized = ["scene.pegs_along_route.0.friction"]
"""


def test_random_value_is_the_same_for_all_trials_of_a_seed(tmp_path: Path) -> None:
    suite, source = read_suite_text(tmp_path, RANDOM_FRICTION)
    trials = make_trials(suite, source, ["hold", "path_following"], 3, first_seed=7)
    seeds_and_scenes = [(trial.seed, decode_config(trial).scene) for trial in trials]
    friction_by_seed = {seed: scene.random_field[0].friction for seed, scene in seeds_and_scenes}
    assert len(set(friction_by_seed.values())) == 3
    assert all(0.1 <= friction <= 0.3 for friction in friction_by_seed.values())
    assert all(
        scene.random_field[0].friction == friction_by_seed[seed] for seed, scene in seeds_and_scenes
    )
    # The first 6 trials have the condition "random friction", the others "a launch row of ice".
    launch_frictions = [scene.pegs_along_route[0].friction for _, scene in seeds_and_scenes]
    random_frictions = [friction_by_seed[seed] for seed, _ in seeds_and_scenes[:6]]
    assert launch_frictions == random_frictions + [0.0] * 6


def test_not_randomized_key_that_no_entry_randomizes_is_refused(tmp_path: Path) -> None:
    text = RANDOM_FRICTION.replace('not_randomized = ["scene.pegs', 'not_randomized = ["pegs')
    suite, source = read_suite_text(tmp_path, text)
    with raises_error(ConfigError, code="command/invalid-option"):
        make_conditions(suite, source)


def test_randomize_with_bounds_in_wrong_order_is_refused(tmp_path: Path) -> None:
    text = RANDOM_FRICTION.replace("high = 0.3", "high = 0.03")
    with raises_error(ConfigError, code="config/invalid-value", field="low", value=0.1):
        read_suite_text(tmp_path, text)
