"""A custom sensor with its own message works in one file outside of the packages: examples/whisker.py."""

import csv
import json
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader

import snakesim
from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.wire import keys
from snakesim_operator.features.console.page.custom_sensors import format_sensor_table
from snakesim_operator.features.console.robot_data.live_robot import LiveRobot
from snakesim_operator.recording.mcap_format.decoder import DecoderFactory
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs import in_process_command as in_process
from snakesim_testing.runs.command import (
    CompletedRun,
    make_environment,
    run_program,
    running_snakesim,
)
from snakesim_testing.runs.command import snakesim as command
from snakesim_testing.runs.documents import REPOSITORY

pytestmark = pytest.mark.e2e

ROBOT = REPOSITORY / "examples" / "planar13_whiskers.toml"
CONTRACT_SUITE = (
    "-p",
    "no:cacheprovider",
    "-p",
    "snakesim_testing",
    "--pyargs",
    "snakesim_testing.contract",
    "--snakesim-backend",
    "sim",
)
LEFT_WHISKER = keys.custom_key("left")


@pytest.fixture
def robot_option(tmp_path: Path) -> str:
    """Copy the example into the folder of the test, and provide the option that selects its robot."""
    (tmp_path / "examples").mkdir()
    for name in ("whisker.py", ROBOT.name):
        (tmp_path / "examples" / name).write_text((REPOSITORY / "examples" / name).read_text())
    return f"robot=./examples/{ROBOT.name}"


@pytest.mark.quiet  # docs/tutorials/your-sensor.md is typed in verification/documents
def test_custom_sensor_is_published_displayed_recorded_and_exported(
    tmp_path: Path, robot_option: str
) -> None:
    run = (
        "peg_row",
        "--set",
        robot_option,
        "--duration",
        "600",
        "--stay",
        "--clock-mode",
        "realtime",
    )
    with running_snakesim(tmp_path / "run", *run) as started:
        started.wait_for(" of 600 s")  # the robot is armed and moves
        with snakesim.Robot.connect(started.endpoint) as live:
            wait_until(lambda: live.read(LEFT_WHISKER) is not None, "a sample of the whisker")
            sample = live.read(LEFT_WHISKER)
            assert type(sample).__name__ == "Whisker"
            assert sample.link == 13
            assert abs(sample.bend_rad) <= sample.bend_max_rad
            assert 0 <= live.age_s(sample) < 1.0
            namespace = live.description.robot
        with open_session(
            ConnectionSettings(endpoint=started.endpoint, namespace=namespace)
        ) as session:
            live_robot = LiveRobot(session)

            def has_both_whiskers() -> bool:
                snapshot = live_robot.take_snapshot()
                return (
                    snapshot is not None
                    and {LEFT_WHISKER, keys.custom_key("right")} <= snapshot.custom.keys()
                )

            wait_until(has_both_whiskers, "both whiskers on the console")
            snapshot = live_robot.take_snapshot()
            assert snapshot is not None
            text = format_sensor_table(snapshot)
            assert LEFT_WHISKER in text
            assert "Whisker on link 13" in text
            assert "bend_rad" in text
            assert " rad" in text
        echoed = started.run_tool("topic", "echo", LEFT_WHISKER, "--count", "1")
        assert json.loads(echoed.out)["message"]["bend_max_rad"] == 1.4, echoed.printed
        # An interrupted recorder stores all messages; a killed one would lose the last half second.
        started.interrupt()
    exported = command(
        "recording", "export", "run", "--format", "csv", "--out", "whiskers.csv", cwd=tmp_path
    )
    assert exported.code in (0, 3), exported.printed  # 3: the run was interrupted
    with (tmp_path / "whiskers.csv").open() as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    assert {"bend_rad.left", "bend_rad.right", "age_s.left"} <= rows[0].keys()
    assert all(abs(float(row["bend_rad.left"])) <= 1.4 for row in rows if row["bend_rad.left"])
    command("recording", "export", "run", "--format", "mcap", "--out", "whole.mcap", cwd=tmp_path)
    with (tmp_path / "whole.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        schema, _, _, whisker = next(reader.iter_decoded_messages([LEFT_WHISKER]))
        _, _, _, foxglove_message = next(
            reader.iter_decoded_messages([f"/{namespace}/custom/left"])
        )
    assert foxglove_message["bend_max_rad"] == 1.4
    assert schema is not None
    assert schema.name == "snakesim.custom.Whisker"
    assert "bend_rad" in json.loads(schema.data)["properties"]
    assert type(whisker).__name__ == "Whisker"
    assert whisker.bend_max_rad == 1.4


# Each key is code of the example; its value replaces it by code that makes an invalid sample.
BEND_CODE = "bend_rad=float(np.clip(bend_rad, -upper_rad, upper_rad))"
INVALID_CODE = {
    BEND_CODE: "bend_rad=7.0",
    "timestamp_ns=timestamp_ns": "timestamp_ns=timestamp_ns + 10**9",
    "link=self._mount.link": "link=99",
}
CLAUSE_FAILURES = {
    "every_sample_survives_the_wire": "sensor/custom/left: Whisker.bend_rad is 7.0",
    "no_sample_contradicts_itself": "sensor/custom/left: bent by 7.0 rad, and it bends no further than 1.4 rad",
    "other_sensors_are_stamped_when_they_were_read": "a sample of sensor/custom/left is -9",
    "every_sample_fits_the_robot": "Whisker.link is 99, must be 0 (tail) to 13 (head)",
}


def run_contract_suite(folder: Path, robot_option: str, clause: str) -> CompletedRun:
    """Run clauses of the contract suite, as in docs/hardware/contract-suite.md, on the simulator with whiskers."""
    arguments = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        *CONTRACT_SUITE,
        "--snakesim-set",
        robot_option,
        "-k",
        clause,
    ]
    return run_program(
        arguments, folder, make_environment(folder, PYTHONPATH=str(REPOSITORY)), 120.0
    )


@pytest.mark.slow
def test_contract_suite_accepts_custom_sensor_and_refuses_invalid_one(
    tmp_path: Path, robot_option: str
) -> None:
    clauses = " or ".join([*CLAUSE_FAILURES, "sensor_listed", "description"])
    valid_result = run_contract_suite(tmp_path, robot_option, clauses)
    assert valid_result.code == 0, valid_result.out[-3000:]
    whisker_file = tmp_path / "examples" / "whisker.py"
    code = whisker_file.read_text()
    for valid_code, invalid_code in INVALID_CODE.items():
        assert valid_code in code
        code = code.replace(valid_code, invalid_code)
    whisker_file.write_text(code)
    invalid_result = run_contract_suite(tmp_path, robot_option, clauses)
    assert invalid_result.code == 1, invalid_result.out[-3000:]
    assert f"{len(CLAUSE_FAILURES)} failed" in invalid_result.out, invalid_result.out[-3000:]
    for failure in CLAUSE_FAILURES.values():
        assert failure in invalid_result.out, invalid_result.out[-5000:]


def test_custom_sensor_with_invalid_sample_stops_robot_and_is_named(
    tmp_path: Path, robot_option: str
) -> None:
    whisker_file = tmp_path / "examples" / "whisker.py"
    invalid_after_tick_30 = "bend_rad=7.0 if tick > 30 else 0.0"
    whisker_file.write_text(whisker_file.read_text().replace(BEND_CODE, invalid_after_tick_30))
    result = in_process.snakesim(
        "run", "peg_row", "--in-process", "--set", robot_option, "--duration", "5", cwd=tmp_path
    )
    assert result.code != 0, result.printed
    assert "sensor/custom/left cannot be published: Whisker.bend_rad is 7.0" in result.printed
