"""Parameter changes of a running controller are recorded with time and requester, and repeated in a replay."""

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

CHANGE_TICK = 30


@pytest.fixture(scope="module")
def tuned_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Provide a recording in which ada changed two gains."""
    path = tmp_path_factory.mktemp("tuned") / RECORDING_FILENAME
    config = load_scenario("peg_row", [parse_set_option("duration_s=0.6")]).config
    with InProcessRun(config) as run:
        session = run.network.create_session()
        recording = RecordingWriter(path)
        for entry in keys.SPACE:
            session.on_latched_arrival(entry.key, recording.write_arrival)
        request = ParametersRequest(
            requester="ada",
            controller=config.controller,
            parameters='{"propulsion_n": 20, "damping_nm_s_per_rad": 0.9}',
        )
        for tick, _ in enumerate(run.iterate_ticks()):
            if tick == CHANGE_TICK:
                session.send_query(keys.PARAMETERS, request)
        recording.close({})
    return path


def test_replay_changes_parameters_in_the_same_tick(tuned_recording: Path, tmp_path: Path) -> None:
    replayed = snakesim("replay", str(tuned_recording), "--control", cwd=tmp_path)
    assert replayed.code == 0, replayed.err
    assert replayed.out == "60 commands, the same to the bit\n"


def test_recording_info_names_requester_and_changed_parameters(
    tuned_recording: Path, tmp_path: Path
) -> None:
    info = snakesim("recording", "info", str(tuned_recording), cwd=tmp_path).out
    change_line = next(line for line in info.splitlines() if line.startswith("  set "))
    assert change_line.endswith(
        " s by ada: control.propulsion_n: 35.0 -> 20.0, control.damping_nm_s_per_rad: 0.5 -> 0.9"
    )


def test_replay_with_set_option_uses_it_before_recorded_change(
    tuned_recording: Path, tmp_path: Path
) -> None:
    options = ["--set", "control.propulsion_n=20", "--set", "control.damping_nm_s_per_rad=0.9"]
    replayed = snakesim("replay", str(tuned_recording), "--control", *options, cwd=tmp_path)
    assert "commands differ, the first answers tick " in replayed.out
    first_different_tick = int(replayed.out.split("answers tick ")[1].split()[0])
    assert first_different_tick < CHANGE_TICK, "the commands differ only after the recorded change"


REQUIRED_PARAMETERS = {"policy": {"model": "a.onnx"}}
UNITLESS_PARAMETERS = ("push_scale", "model", "slides")


@pytest.mark.parametrize("name", list_installed_plugins(CONTROLLERS))
def test_shipped_parameter_has_description_range_and_unit(name: str) -> None:
    parameters_type = load_controller(name).Parameters
    values = parameters_type(**REQUIRED_PARAMETERS.get(name, {}))
    published = ControlParameters(
        tick=0,
        timestamp_ns=0,
        controller=name,
        parameters=msgspec.json.encode(values).decode(),
        schema=msgspec.json.encode(make_schema(parameters_type)).decode(),
    )
    parameters = parse_parameters(published)
    assert len(parameters) == len(msgspec.structs.fields(parameters_type))
    for parameter in parameters:
        assert parameter.description, parameter
        assert parameter.range_text, parameter
        is_boolean = isinstance(parameter.value, bool)
        needs_unit = not is_boolean and parameter.name not in UNITLESS_PARAMETERS
        assert parameter.unit or not needs_unit, parameter


def test_parameter_range_is_described_as_text() -> None:
    assert RobotParameter("a", 1.0, "s", minimum=0.0, maximum=5.0).range_text == ">= 0, <= 5"
    assert RobotParameter("a", 1.0, "s", minimum=0.0, excludes_minimum=True).range_text == "> 0"
    assert RobotParameter("a", "x", choices=("x", "y")).range_text == "x or y"
    assert RobotParameter("a", False).range_text == "true or false"
    assert RobotParameter("a", 0.3, "N").value_with_unit == "0.3 N"
    assert RobotParameter("a", 0.3, "1").value_with_unit == "0.3"
