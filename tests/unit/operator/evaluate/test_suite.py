"""Suite files: rows and cases that they stand for, and what a wrong one is told. Wrong flags are in refusals.toml."""

from pathlib import Path

import msgspec
import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import list_shipped_names
from snakesim_hal.model.scenario import RunConfig
from snakesim_operator.cli import main
from snakesim_operator.features.evaluate.case import EvaluationCase
from snakesim_operator.features.evaluate.suite import (
    EvaluationSuite,
    make_cases,
    make_suite_settings,
    read_suite,
)
from snakesim_testing.messages import raises_error

ROWS = """
scenario = "surveyed_clutter"
[set]
duration_s = 20
[vary]
"scene.random_field.0.density_per_m2" = [4, 8]
"scene.ground.friction" = "0.1:0.3:3"
[[row]]
name = "as shipped"
[[row]]
name = "pegs only"
[[row.set.scene.random_field]]
min_corner_m = [2, -1]
max_corner_m = [3, 1]
density_per_m2 = 1
radius_m = [0.03, 0.03]
clearance_m = 0.1
seed = 1
"""


def read(folder: Path, text: str) -> tuple[EvaluationSuite, str]:
    path = folder / "mine.toml"
    path.write_text(text)
    return read_suite(str(path))


def config(case: EvaluationCase) -> RunConfig:
    return msgspec.json.decode(case.config, type=RunConfig)


def test_suite_contains_every_row_in_every_combination(tmp_path: Path) -> None:
    suite, source = read(tmp_path, ROWS)
    names = [setting.name for setting in make_suite_settings(suite, source)]
    assert len(names) == 12
    assert names[0] == "as shipped, density_per_m2 4, friction 0.1"
    assert names[-1] == "pegs only, density_per_m2 8, friction 0.3"
    cases = make_cases(suite, source, ["hold", "path_following"], 2, first_field=7)
    assert len(cases) == 12 * 2 * 2
    assert len({case.id for case in cases}) == len(cases)
    last = config(cases[-1])
    assert last.duration_s == 20
    assert last.clock_mode == "lockstep"
    assert last.controller == "path_following"
    assert last.scene.ground.friction == pytest.approx(0.3)
    assert last.seed == 8
    assert last.scene.random_field[0].seed == 8
    assert last.scene.random_field[0].density_per_m2 == 8
    assert last.scene.random_field[0].box_fraction == 0


def test_a_case_is_known_again_by_what_it_runs(tmp_path: Path) -> None:
    suite, source = read(tmp_path, ROWS)
    few, more = (
        make_cases(suite, source, ["hold"], fields, seed) for fields, seed in ((1, 8), (2, 7))
    )
    assert {case.id for case in few} < {case.id for case in more}
    renamed = msgspec.structs.replace(suite, title="another", row=[])
    assert {case.id for case in make_cases(renamed, "elsewhere", ["hold"], 1, 8)} < {
        case.id for case in few
    }


QUICK = {"pushing"}  # the others are tried by `make verify`


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in QUICK else pytest.mark.slow)
        for name in list_shipped_names("suites")
    ],
)
def test_shipped_suites_can_be_run(name: str) -> None:
    suite, source = read_suite(name)
    assert suite.title
    assert len(make_cases(suite, source, suite.controllers[:1], 1, first_field=1)) >= 1


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ("", ["mine.toml", "scenario", "missing"]),
        ('scenario = "nowhere"', ["no scenario called 'nowhere'", "triplet"]),
        ('scenario = "jam"\nfield = 3', ["mine.toml", "`field`", "did you mean `fields`"]),
        ('scenario = "jam"\nfields = 0', ["mine.toml", "`fields` = 0", ">= 1"]),
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
        ('scenario = "jam"\n[[row]]\nname = "a"\n[[row]]\nname = "a"', ["two rows are called 'a'"]),
        (
            'scenario = "jam"\n[set]\nscene.random_field.0.density_per_m2 = 3',
            ["[set]", "`scene.random_field`", "expected a list"],
        ),
        (
            'scenario = "surveyed_clutter"\n[set]\nscene.random_field.0.density_per_m2 = 150',
            ["row 1", "1380 pegs"],
        ),
        ('scenario = "jam"\n[set]\nbackend = "nobody"', ["no backend called 'nobody'"]),
    ],
)
def test_a_wrong_suite_is_told_what_and_where(
    text: str, reported: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.toml").write_text(text)
    assert (
        main(["study", "evaluate", str(tmp_path / "mine.toml"), "--out", str(tmp_path / "out")])
        == 2
    )
    said = capsys.readouterr().err
    assert all(part in said for part in reported), said
    assert not (tmp_path / "out").exists()


def test_suite_has_a_maximum_number_of_cases(tmp_path: Path) -> None:
    suite, source = read(tmp_path, 'scenario = "jam"\n[vary]\nseed = "1:1000:1000"')
    with raises_error(ConfigError, code="command/invalid-option"):
        make_cases(suite, source, [], 300, 1)


LAB = """
scenario = "surveyed_clutter"
[[randomize]]
set = ["scene.random_field.0.friction", "scene.pegs_along_route.0.friction"]
low = 0.1
high = 0.3
[[row]]
name = "as drawn"
[[row]]
name = "a launch row of ice"
without = ["scene.pegs_along_route.0.friction"]
"""


def test_a_field_has_its_own_draw_whoever_crosses_it(tmp_path: Path) -> None:
    suite, source = read(tmp_path, LAB)
    cases = make_cases(suite, source, ["hold", "path_following"], 3, first_field=7)
    drawn = [(case.field, config(case).scene) for case in cases]
    of_field = {field: scene.random_field[0].friction for field, scene in drawn}
    assert len(set(of_field.values())) == 3
    assert all(0.1 <= one <= 0.3 for one in of_field.values())
    assert all(scene.random_field[0].friction == of_field[field] for field, scene in drawn)
    launch = [scene.pegs_along_route[0].friction for _, scene in drawn]
    assert launch == [of_field[field] for field, _ in drawn[:6]] + [0.0] * 6
    wrong, source = read(tmp_path, LAB.replace('without = ["scene.pegs', 'without = ["pegs'))
    with raises_error(ConfigError, code="command/invalid-option"):
        make_suite_settings(wrong, source)
    with raises_error(ConfigError, code="config/invalid-value", field="low", value=0.1):
        read(tmp_path, LAB.replace("high = 0.3", "high = 0.03"))
