"""Parameters of the controller, changed while it runs: recorded with time and author, and changed in a replay too."""

from pathlib import Path

import msgspec
import pytest

from snakesim_hal.controller import load_controller
from snakesim_hal.model.fields.json_schema import make_schema
from snakesim_hal.model.plugins import CONTROLLERS, list_installed_plugins
from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_hal.programs.single_process import InProcessRun
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ControlParameters, ParametersRequest
from snakesim_operator.recording.message import RECORDING_FILENAME
from snakesim_operator.recording.writer import RecordingWriter
from snakesim_operator.robot_commands.parameters import RobotParameter, parse_parameters
from snakesim_testing.runs.in_process_command import snakesim

CHANGED_AT = 30  # turns


@pytest.fixture(scope="module")
def tuned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording in which ada changed two gains."""
    path = tmp_path_factory.mktemp("tuned") / RECORDING_FILENAME
    config = load_scenario("peg_row", [parse_set_option("duration_s=0.6")]).config
    with InProcessRun(config) as run:
        session, recording = run.network.create_session(), RecordingWriter(path)
        for row in keys.SPACE:
            session.on_latched_arrival(row.key, recording.write_arrival)
        request = ParametersRequest(
            requester="ada",
            controller=config.controller,
            parameters='{"propulsion_n": 20, "damping_nm_s_per_rad": 0.9}',
        )
        for turn, _ in enumerate(run.iterate_ticks()):
            if turn == CHANGED_AT:
                session.send_query(keys.PARAMETERS, request)
        recording.close({})
    return path


def test_a_replay_changes_them_in_the_same_tick(tuned: Path, tmp_path: Path) -> None:
    replayed = snakesim("replay", str(tuned), "--control", cwd=tmp_path)
    assert replayed.code == 0 and replayed.out == "60 commands, the same to the bit\n", (
        replayed.out + replayed.err
    )


def test_the_recording_names_who_set_what_and_when(tuned: Path, tmp_path: Path) -> None:
    said = snakesim("recording", "info", str(tuned), cwd=tmp_path).out
    row = next(line for line in said.splitlines() if line.startswith("  set "))
    assert row.endswith(
        " s by ada: control.propulsion_n: 35.0 -> 20.0, control.damping_nm_s_per_rad: 0.5 -> 0.9"
    )


def test_what_is_set_for_the_replay_stays(tuned: Path, tmp_path: Path) -> None:
    given = ["--set", "control.propulsion_n=20", "--set", "control.damping_nm_s_per_rad=0.9"]
    replayed = snakesim("replay", str(tuned), "--control", *given, cwd=tmp_path)
    assert "commands differ, the first answers tick " in replayed.out
    first = int(replayed.out.split("answers tick ")[1].split()[0])
    assert first < CHANGED_AT, "differs before the change, and not after it alone"


MUST_BE_SET = {"policy": {"model": "a.onnx"}}


@pytest.mark.parametrize("name", list_installed_plugins(CONTROLLERS))
def test_every_shipped_parameter_says_what_it_is(name: str) -> None:
    parameters_type = load_controller(name).Parameters
    in_force = ControlParameters(
        tick=0,
        timestamp_ns=0,
        controller=name,
        parameters=msgspec.json.encode(parameters_type(**MUST_BE_SET.get(name, {}))).decode(),
        schema=msgspec.json.encode(make_schema(parameters_type)).decode(),
    )
    found = parse_parameters(in_force)
    assert len(found) == len(msgspec.structs.fields(parameters_type))
    for one in found:
        needs_unit = not isinstance(one.value, bool) and one.name not in (
            "push_scale",
            "model",
            "slides",
        )
        assert one.description and one.range_text, one
        assert one.unit or not needs_unit, one


def test_ranges_are_told_in_words() -> None:
    assert RobotParameter("a", 1.0, "s", minimum=0.0, maximum=5.0).range_text == ">= 0, <= 5"
    assert RobotParameter("a", 1.0, "s", minimum=0.0, excludes_minimum=True).range_text == "> 0"
    assert RobotParameter("a", "x", choices=("x", "y")).range_text == "x or y"
    assert RobotParameter("a", False).range_text == "true or false"
    assert RobotParameter("a", 0.3, "N").value_with_unit == "0.3 N"
    assert RobotParameter("a", 0.3, "1").value_with_unit == "0.3"
