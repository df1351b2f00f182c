"""A replay of the recorded sensors into guidance, navigation and control gives bit-identical commands."""

from pathlib import Path

import numpy as np
import pytest

from snakesim_hal.model.files import list_shipped_names
from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_operator.playback.control import ControlReplay
from snakesim_operator.recording.message import RECORDING_FILENAME
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.run.in_process import simulate
from snakesim_testing.runs.in_process_command import run_to_summary, snakesim

DURATION_S = 0.4
QUICK_SCENARIOS = ("mamba_hills", "peg_row")  # together they contain the features of all others


@pytest.fixture(scope="module")
def recorded_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("recorded") / "run"
    simulate(load_scenario("peg_row", [parse_set_option("duration_s=0.8")]).config, out)
    return out


@pytest.mark.heavy
@pytest.mark.parametrize(
    "scenario",
    [
        pytest.param(name, marks=() if name in QUICK_SCENARIOS else pytest.mark.slow)
        for name in list_shipped_names("scenarios")
    ],
)
def test_replay_of_shipped_scenario_gives_bit_identical_commands(
    tmp_path: Path, scenario: str
) -> None:
    result, _ = run_to_summary(
        tmp_path / "run", scenario, "--duration", str(DURATION_S), "--clock-mode", "lockstep"
    )
    assert result.code == 0, result.printed
    replayed = snakesim("replay", "run", "--control", cwd=tmp_path)
    ticks = round(DURATION_S * load_scenario(scenario).config.rate_hz)
    assert replayed.code == 0
    assert replayed.out == f"{ticks} commands, the same to the bit\n"


@pytest.mark.heavy
def test_replay_without_changes_stores_the_same_run(recorded_run: Path, tmp_path: Path) -> None:
    result = snakesim("replay", str(recorded_run), "--control", "--out", "again", cwd=tmp_path)
    assert result.code == 0, result.err
    original = RunRecord.load(recorded_run)
    replay = RunRecord.load(tmp_path / "again" / RECORDING_FILENAME)
    assert replay.host.command_digest == original.host.command_digest
    assert replay.control_states == original.control_states
    assert replay.worlds == original.worlds


def test_replay_allows_only_last_answer_to_be_missing(recorded_run: Path) -> None:
    comparison = ControlReplay(recorded_run / RECORDING_FILENAME, []).run()
    last_tick = max(comparison.recorded)
    del comparison.recorded[last_tick]
    del comparison.recorded[last_tick - 5]
    comparison.ignore_last_if_unanswered(last_tick)
    assert comparison.differing_ticks == [last_tick - 5]


def test_replay_with_changed_gain_differs_in_compare(recorded_run: Path, tmp_path: Path) -> None:
    options = ["--set", "control.propulsion_n=20", "--out", "weaker"]
    result = snakesim("replay", str(recorded_run), "--control", *options, cwd=tmp_path)
    assert result.code == 0
    assert "commands differ, the first answers tick " in result.out
    original = RunRecord.load(recorded_run)
    weaker = RunRecord.load(tmp_path / "weaker")
    assert np.array_equal(original.angle_rad, weaker.angle_rad)  # a replay does not move the robot
    assert not np.array_equal(original.target, weaker.target)
    compared = snakesim("study", "compare", str(recorded_run), "weaker", cwd=tmp_path)
    assert compared.code == 0
    assert "propulsion_n" in compared.out
    assert "torque target" in compared.out
    assert "B is a replay: its robot moves as in" in compared.out


def test_replay_without_control_refuses_options_of_services(
    recorded_run: Path, tmp_path: Path
) -> None:
    result = snakesim("replay", str(recorded_run), "--set", "control.propulsion_n=20", cwd=tmp_path)
    assert result.code == 2
    assert "--set, --controller, --run-recorded-code and --out are for --control" in result.err
