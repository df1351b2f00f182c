"""Sensors replayed into guidance, navigation and control: the recorded commands come out, to the bit."""

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
QUICK = ("mamba_hills", "peg_row")  # between them they have all of the rest


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("recorded") / "run"
    simulate(load_scenario("peg_row", [parse_set_option("duration_s=0.8")]).config, out)
    return out


@pytest.mark.parametrize(
    "scenario",
    [
        pytest.param(name, marks=() if name in QUICK else pytest.mark.slow)
        for name in list_shipped_names("scenarios")
    ],
)
def test_every_shipped_scenario_replays_to_the_bit(tmp_path: Path, scenario: str) -> None:
    ended, _ = run_to_summary(
        tmp_path / "run", scenario, "--duration", str(DURATION_S), "--clock-mode", "lockstep"
    )
    assert ended.code == 0, ended.printed
    replayed = snakesim("replay", "run", "--control", cwd=tmp_path)
    ticks = round(DURATION_S * load_scenario(scenario).config.rate_hz)
    assert replayed.code == 0
    assert replayed.out == f"{ticks} commands, the same to the bit\n"


def test_the_replay_of_the_same_is_the_same_run(recorded: Path, tmp_path: Path) -> None:
    ended = snakesim("replay", str(recorded), "--control", "--out", "again", cwd=tmp_path)
    assert ended.code == 0, ended.err
    before, again = (
        RunRecord.load(recorded),
        RunRecord.load(tmp_path / "again" / RECORDING_FILENAME),
    )
    assert again.host.command_digest == before.host.command_digest
    assert again.control_states == before.control_states
    assert again.worlds == before.worlds


def test_replay_allows_only_last_answer_to_be_missing(recorded: Path) -> None:
    comparison = ControlReplay(recorded / RECORDING_FILENAME, []).run()
    last = max(comparison.recorded)
    del comparison.recorded[last], comparison.recorded[last - 5]
    comparison.ignore_last_if_unanswered(last)
    assert comparison.differing_ticks == [last - 5]


def test_a_changed_gain_shows_in_compare(recorded: Path, tmp_path: Path) -> None:
    changed = ["--set", "control.propulsion_n=20", "--out", "weaker"]
    ended = snakesim("replay", str(recorded), "--control", *changed, cwd=tmp_path)
    assert ended.code == 0
    assert "commands differ, the first answers tick " in ended.out
    before, weaker = RunRecord.load(recorded), RunRecord.load(tmp_path / "weaker")
    assert np.array_equal(before.angle_rad, weaker.angle_rad)  # the robot moved as it did
    assert not np.array_equal(before.target, weaker.target)
    compared = snakesim("study", "compare", str(recorded), "weaker", cwd=tmp_path)
    assert compared.code == 0
    assert "propulsion_n" in compared.out
    assert "torque target" in compared.out
    assert "B is a replay: its robot moves as in" in compared.out


def test_changes_that_need_the_services_are_refused_without_them(
    recorded: Path, tmp_path: Path
) -> None:
    ended = snakesim("replay", str(recorded), "--set", "control.propulsion_n=20", cwd=tmp_path)
    assert ended.code == 2
    assert "--set, --controller, --run-recorded-code and --out are for --control" in ended.err
