"""A custom sensor with its own message, in one file outside of the packages: examples/whisker.py."""

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
PYTEST = (
    "-p",
    "no:cacheprovider",
    "-p",
    "snakesim_testing",
    "--pyargs",
    "snakesim_testing.contract",
    "--snakesim-backend",
    "sim",
)
LEFT = keys.custom_key("left")


@pytest.fixture
def robot(tmp_path: Path) -> str:
    """The example, copied to where a user would have it."""
    (tmp_path / "examples").mkdir()
    for name in ("whisker.py", ROBOT.name):
        (tmp_path / "examples" / name).write_text((REPOSITORY / "examples" / name).read_text())
    return f"robot=./examples/{ROBOT.name}"


@pytest.mark.slow  # docs/tutorials/your-sensor.md is typed in verification/documents
def test_a_whisker_is_published_shown_recorded_and_exported(tmp_path: Path, robot: str) -> None:
    run = ("peg_row", "--set", robot, "--duration", "600", "--stay", "--clock-mode", "realtime")
    with running_snakesim(tmp_path / "run", *run) as started:
        started.wait_for(" of 600 s")  # armed, and moving
        with snakesim.Robot.connect(started.endpoint) as live:
            wait_until(lambda: live.read(LEFT) is not None, "a whisker")
            bent = live.read(LEFT)
            assert type(bent).__name__ == "Whisker"
            assert bent.link == 13
            assert abs(bent.bend_rad) <= bent.bend_max_rad
            assert 0 <= live.age_s(bent) < 1.0
            namespace = live.description.robot
        with open_session(
            ConnectionSettings(endpoint=started.endpoint, namespace=namespace)
        ) as session:
            watch = LiveRobot(session)

            def shown() -> bool:
                snapshot = watch.take_snapshot()
                return (
                    snapshot is not None
                    and {LEFT, keys.custom_key("right")} <= snapshot.custom.keys()
                )

            wait_until(shown, "whiskers on the console")
            snapshot = watch.take_snapshot()
            assert snapshot is not None
            text = format_sensor_table(snapshot)
            assert LEFT in text
            assert "Whisker on link 13" in text
            assert "bend_rad" in text
            assert " rad" in text
        echoed = started.run_tool("topic", "echo", LEFT, "--count", "1")
        assert json.loads(echoed.out)["message"]["bend_max_rad"] == 1.4, echoed.printed
        started.interrupt()  # in order: a killed recorder lacks its last half second, here that is all
    done = command(
        "recording", "export", "run", "--format", "csv", "--out", "whiskers.csv", cwd=tmp_path
    )
    assert done.code in (0, 3), done.printed  # 3: the run was ended from outside
    with (tmp_path / "whiskers.csv").open() as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    assert {"bend_rad.left", "bend_rad.right", "age_s.left"} <= rows[0].keys()
    assert all(abs(float(row["bend_rad.left"])) <= 1.4 for row in rows if row["bend_rad.left"])
    command("recording", "export", "run", "--format", "mcap", "--out", "whole.mcap", cwd=tmp_path)
    with (tmp_path / "whole.mcap").open("rb") as file:
        found = make_reader(file, decoder_factories=[DecoderFactory()])
        schema, _, _, whisker = next(found.iter_decoded_messages([LEFT]))
        _, _, _, plotted = next(found.iter_decoded_messages([f"/{namespace}/custom/left"]))
    assert plotted["bend_max_rad"] == 1.4
    assert schema is not None
    assert schema.name == "snakesim.custom.Whisker"
    assert "bend_rad" in json.loads(schema.data)["properties"]
    assert type(whisker).__name__ == "Whisker"
    assert whisker.bend_max_rad == 1.4


BENT = "bend_rad=float(np.clip(bend_rad, -upper_rad, upper_rad))"
LIES = {
    BENT: "bend_rad=7.0",
    "timestamp_ns=timestamp_ns": "timestamp_ns=timestamp_ns + 10**9",
    "link=self._mount.link": "link=99",
}
SAID = {
    "every_sample_survives_the_wire": "sensor/custom/left: Whisker.bend_rad is 7.0",
    "no_sample_contradicts_itself": "sensor/custom/left: bent by 7.0 rad, and it bends no further than 1.4 rad",
    "other_sensors_are_stamped_when_they_were_read": "sensor/custom/left: -",
    "every_sample_fits_the_robot": "Whisker.link is 99, must be 0 (tail) to 13 (head)",
}


def suite(folder: Path, robot: str, clause: str) -> CompletedRun:
    """The contract suite, as docs/hardware/contract-suite.md has it, on the simulator with the whiskers."""
    typed = [sys.executable, "-m", "pytest", "-q", *PYTEST, "--snakesim-set", robot, "-k", clause]
    return run_program(typed, folder, make_environment(folder, PYTHONPATH=str(REPOSITORY)), 120.0)


@pytest.mark.slow
def test_contract_suite_accepts_custom_sensor_and_refuses_false_one(
    tmp_path: Path, robot: str
) -> None:
    clauses = " or ".join([*SAID, "sensor_listed", "description"])
    honest = suite(tmp_path, robot, clauses)
    assert honest.code == 0, honest.out[-3000:]
    whisker = tmp_path / "examples" / "whisker.py"
    told = whisker.read_text()
    for truth, lie in LIES.items():
        assert truth in told
        told = told.replace(truth, lie)
    whisker.write_text(told)
    refused = suite(tmp_path, robot, clauses)
    assert refused.code == 1 and f"{len(SAID)} failed" in refused.out, refused.out[-3000:]
    assert not [said for said in SAID.values() if said not in refused.out], refused.out[-5000:]


def test_a_lying_whisker_stops_the_robot_and_is_named(tmp_path: Path, robot: str) -> None:
    whisker = tmp_path / "examples" / "whisker.py"
    late = "bend_rad=7.0 if tick > 30 else 0.0"
    whisker.write_text(whisker.read_text().replace(BENT, late))
    done = in_process.snakesim(
        "run", "peg_row", "--in-process", "--set", robot, "--duration", "5", cwd=tmp_path
    )
    assert done.code != 0, done.printed
    assert "sensor/custom/left cannot be published: Whisker.bend_rad is 7.0" in done.printed
