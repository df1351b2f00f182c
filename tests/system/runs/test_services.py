"""A user's service in a file is named by its path, as controllers are, and runs in every process layout."""

import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from snakesim_hal.model.files import SHIPPED_FILES_DIR
from snakesim_hal.wire import keys
from snakesim_operator.recording.message import RECORDING_FILENAME
from snakesim_operator.results.recording_contents import read_recording
from snakesim_operator.results.summary import RunSummary
from snakesim_operator.run.in_process import LOG_FILE
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.runs import in_process_command as in_process
from snakesim_testing.runs.command import (
    SNAKESIM_COMMAND,
    CompletedRun,
    make_environment,
    run_to_summary,
)
from snakesim_testing.runs.documents import REPOSITORY, parse_sections

pytestmark = pytest.mark.e2e

PAGE = REPOSITORY / "docs" / "how-to" / "write-a-service.md"
SERVICE_CODE = next(
    section.files["mocap.py"] for section in parse_sections(PAGE) if "mocap.py" in section.files
)
OTHER_CLASSES_CODE = """

class Another(MotionCapture):
    name = "another"


class Bare:
    name = "sensor"


class Empty(Service):
    name = "sensor"


from pathlib import Path
(Path(__file__).parent / "ran").touch()
"""
SERVICE_OPTION = "services.sensor.plugin=./lab/mocap.py:MotionCapture"


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """Provide a folder with a robot that has no pose sensor, and a service that publishes the pose."""
    robot = (SHIPPED_FILES_DIR / "robots" / "planar13.toml").read_text()
    (tmp_path / "bare.toml").write_text(remove_section(robot, "sensors.pose"))
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab" / "mocap.py").write_text(SERVICE_CODE + OTHER_CLASSES_CODE)
    return tmp_path


def remove_section(toml: str, name: str) -> str:
    """Return a TOML text without one of its sections."""
    return "\n[".join(part for part in toml.split("\n[") if not part.startswith(f"{name}]"))


SHORT_RUN = ["triplet", "--duration", "0.5", "--set", "robot=./bare.toml"]


def run_and_return_digest(
    home: Path, out: str, run: Callable[..., tuple[CompletedRun, RunSummary]]
) -> str | None:
    """Run with the pose of the service alone, and return the command digest."""
    result, summary = run(home / out, *SHORT_RUN, "--set", SERVICE_OPTION)
    assert result.code == 0, result.out + result.err
    recorded = read_recording(home / out / RECORDING_FILENAME, (keys.POSE, keys.WORLD))
    assert set(range(50)) <= recorded.messages_by_tick[keys.POSE].keys()
    assert recorded.streams[keys.WORLD]
    return summary.command_digest


@pytest.mark.heavy
def test_file_service_publishes_pose_in_all_process_layouts(home: Path) -> None:
    digest = run_and_return_digest(home, "many", run_to_summary)
    digest_in_process = run_and_return_digest(home, "one", in_process.run_to_summary)
    assert digest == digest_in_process


# For each case: the named class, and parts of the refusal.
REFUSED_CLASSES = {
    "no such class": (
        "MotionCaptuer",
        "no 'MotionCaptuer', as in",
        "classes in it are MotionCapture, Another, Bare, Empty",
    ),
    "another name": ("Another", "calls itself 'another'", "[services.another]"),
    "no service": ("Bare", "does not derive from Service", "snakesim_hal.service"),
    "no outputs": ("Empty", "has no `outputs`", "snakesim_hal.service"),
}


@pytest.mark.parametrize("case", REFUSED_CLASSES)
def test_file_service_of_wrong_class_is_refused_before_the_start(home: Path, case: str) -> None:
    class_name, *expected_parts = REFUSED_CLASSES[case]
    option = f"services.sensor.plugin=./lab/mocap.py:{class_name}"
    result = in_process.snakesim("run", *SHORT_RUN, "--set", option, "--out", "run", cwd=home)
    assert result.code == 2
    assert not (home / "run").exists()
    for part in ("./lab/mocap.py", *expected_parts):
        assert part in result.err


def test_config_command_runs_no_code_of_file_service(home: Path) -> None:
    result = in_process.snakesim("config", "triplet", "--set", SERVICE_OPTION, cwd=home)
    assert result.code == 0
    assert not (home / "lab" / "ran").exists()
    assert (
        "services.sensor: not checked, because that would run ./lab/mocap.py:MotionCapture"
        in result.out
    )


@pytest.mark.slow
def test_file_service_starts_alone_by_path_or_name(home: Path) -> None:
    """The service prints its name while it waits for a host, which the test does not start."""
    for name in ("./lab/mocap.py:MotionCapture", "sensor"):
        command = [
            *SNAKESIM_COMMAND,
            "start",
            "service",
            name,
            "triplet",
            "--set",
            SERVICE_OPTION,
            "--endpoint",
            find_free_endpoint(),
        ]
        with subprocess.Popen(
            command, cwd=home, env=make_environment(home), stderr=subprocess.PIPE, text=True
        ) as service:
            assert service.stderr is not None
            printed = service.stderr.readline()
            service.terminate()
        assert printed.startswith("sensor: waiting for the network")


# For each case: a field of the pose that the service publishes, and the error.
MALFORMED_FIELDS = {
    "number": (
        "position_w=(0.0, float('nan'), 0.0)",
        "Pose.position_w[1] is nan, must be `float` >= -",
    ),
    "array": (
        "position_w=np.zeros(3)",
        "Pose.position_w is array([0., 0., 0.]), must be plain Python numbers, ",
    ),
    "rotation": (
        "orientation_wxyz=(0.5, 0.0, 0.0, 0.0)",
        "(0.5, 0.0, 0.0, 0.0) of norm 0.5, must be a rotation",
    ),
}
# The field replaces `{}`.
LOST_CODE = """

class Lost(MotionCapture):
    def outputs(self, clock):
        outputs = super().outputs(clock)
        if outputs is None or clock.lifecycle != "armed":
            return outputs
        return [(key, msgspec.structs.replace(pose, {})) for key, pose in outputs]
"""


@pytest.mark.slow  # the decoders' errors: tests/unit/hal/wire
@pytest.mark.parametrize(
    ("clock_mode", "case"),
    [
        ("lockstep", "array"),
        ("one", "number"),
        *(
            pytest.param(*row, marks=pytest.mark.slow)
            for row in (("realtime", "number"), ("one", "rotation"))
        ),
    ],
)
def test_file_service_with_malformed_message_is_named_in_log(
    home: Path, clock_mode: str, case: str
) -> None:
    """The clock mode `one` means a run in one process."""
    field, error = MALFORMED_FIELDS[case]
    service_code = LOST_CODE.replace("{}", field)
    (home / "lab" / "lost.py").write_text(
        f"import msgspec\nimport numpy as np\n{SERVICE_CODE}{service_code}"
    )
    arguments = [
        *SHORT_RUN,
        "--duration",
        "60",
        "--set",
        "services.sensor.plugin=./lab/lost.py:Lost",
    ]
    if clock_mode == "one":
        result, summary = in_process.run_to_summary(home / "run", *arguments)
        log = (home / "run" / LOG_FILE).read_text()
    else:
        result, summary = run_to_summary(home / "run", *arguments, "--clock-mode", clock_mode)
        log = (home / "run" / "sensor.log").read_text()
    assert result.code == 1
    assert summary.duration_s < 5.0  # the run ends at once
    message = re.compile(
        r"service ./lab/lost.py:Lost \(class Lost\): sensor/pose of tick \d+ cannot be published: .*"
        + re.escape(error)
    )
    assert message.search(log), log
    assert message.search(summary.ended), summary.ended
    assert message.search(result.out), result.out


@pytest.mark.slow
def test_file_service_that_raises_ends_run_with_its_name(home: Path) -> None:
    service_code = LOST_CODE.replace("{}", "position_w=1 / 0")
    (home / "lab" / "lost.py").write_text(f"import msgspec\n{SERVICE_CODE}{service_code}")
    arguments = [*SHORT_RUN, "--set", "services.sensor.plugin=./lab/lost.py:Lost"]
    result, summary = in_process.run_to_summary(home / "run", *arguments)
    message = "(class Lost): outputs() raised ZeroDivisionError: division by zero (lost.py line "
    assert result.code == 1
    assert message in summary.ended
    assert message in (home / "run" / LOG_FILE).read_text()


SILENT_CODE = """

class Silent(MotionCapture):
    def outputs(self, clock):
        return []
"""


@pytest.mark.slow
def test_run_names_missing_stream_and_stops_after_stated_time(home: Path) -> None:
    (home / "lab" / "silent.py").write_text(SERVICE_CODE + SILENT_CODE)
    arguments = [
        *SHORT_RUN,
        "--set",
        "services.sensor.plugin=./lab/silent.py:Silent",
        "--set",
        "start_limit_s=3",
    ]
    result, summary = run_to_summary(home / "run", *arguments)
    reason = (
        "waiting for guidance, which has no sensor/pose yet "
        "(mission.localization=dead_reckoning does without"
    )
    timeout = "not ready to arm within 3 s"
    for text in (summary.ended, result.out):
        assert f"{timeout} (start_limit_s) with every service there: " in text, result.out
        assert reason in text, result.out
    assert result.code == 1
    assert summary.duration_s == 0.0
    one_process = in_process.snakesim("run", *arguments, "--in-process", "--out", "one", cwd=home)
    assert one_process.code != 0, one_process
    assert timeout in one_process.err, one_process
    assert reason in one_process.err, one_process


FROZEN_CODE = """

class Frozen(MotionCapture):
    def outputs(self, clock):
        if clock.tick <= 50:
            self.last = super().outputs(clock)[0][1]
        return [(keys.POSE, msgspec.structs.replace(self.last, tick=clock.tick))]
"""


def test_control_holds_while_file_service_repeats_old_pose(home: Path) -> None:
    (home / "lab" / "frozen.py").write_text("import msgspec\n" + SERVICE_CODE + FROZEN_CODE)
    options = ["--set", "services.sensor.plugin=./lab/frozen.py:Frozen", "--duration", "1"]
    result, summary = in_process.run_to_summary(home / "run", *SHORT_RUN, *options)
    assert result.code == 0, result.out
    assert summary.pose_from == "sensor", result.out
    assert summary.reported_state == "NotLocomoting"
    assert re.search(r"sensor/pose is 0\.\d+ s old", summary.reported_reason or "")


def test_run_without_contact_sensors_does_not_wait_for_contacts(home: Path) -> None:
    robot_file = home / "bare.toml"
    robot_file.write_text(remove_section(robot_file.read_text(), "sensors.contacts"))
    result, _ = in_process.run_to_summary(home / "run", *SHORT_RUN, "--set", SERVICE_OPTION)
    assert result.code == 0, result.out
