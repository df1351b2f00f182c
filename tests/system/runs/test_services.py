"""Services of one's own, in a file: named by path as controllers are, in processes and in one."""

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
SERVICE = next(
    section.files["mocap.py"] for section in parse_sections(PAGE) if "mocap.py" in section.files
)
MORE = """

class Another(MotionCapture):
    name = "another"


class Bare:
    name = "sensor"


class Empty(Service):
    name = "sensor"


from pathlib import Path
(Path(__file__).parent / "ran").touch()
"""
NAMED = "services.sensor.plugin=./lab/mocap.py:MotionCapture"


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A robot without a pose sensor, and a service that has one."""
    robot = (SHIPPED_FILES_DIR / "robots" / "planar13.toml").read_text()
    bare = "\n[".join(part for part in robot.split("\n[") if not part.startswith("sensors.pose]"))
    (tmp_path / "bare.toml").write_text(bare)
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab" / "mocap.py").write_text(SERVICE + MORE)
    return tmp_path


SHORT = ["triplet", "--duration", "0.5", "--set", "robot=./bare.toml"]


def digest_of(
    home: Path, out: str, run: Callable[..., tuple[CompletedRun, RunSummary]]
) -> str | None:
    """Of a run in which guidance knows the pose from the service alone."""
    ended, summary = run(home / out, *SHORT, "--set", NAMED)
    assert ended.code == 0, ended.out + ended.err
    recorded = read_recording(home / out / RECORDING_FILENAME, (keys.POSE, keys.WORLD))
    assert set(range(50)) <= recorded.messages_by_tick[keys.POSE].keys()
    assert recorded.streams[keys.WORLD]
    return summary.command_digest


def test_file_service_publishes_pose_in_all_process_layouts(home: Path) -> None:
    assert digest_of(home, "many", run_to_summary) == digest_of(
        home, "one", in_process.run_to_summary
    )


WRONG = {
    "no such class": (
        "MotionCaptuer",
        "no 'MotionCaptuer', as in",
        "classes in it are MotionCapture, Another, Bare, Empty",
    ),
    "another name": ("Another", "calls itself 'another'", "[services.another]"),
    "no service": ("Bare", "does not derive from Service", "snakesim_hal.service"),
    "no outputs": ("Empty", "has no `outputs`", "snakesim_hal.service"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_file_without_that_service_is_refused_before_anything_starts(
    home: Path, wrong: str
) -> None:
    name, *words = WRONG[wrong]
    code = f"services.sensor.plugin=./lab/mocap.py:{name}"
    ended = in_process.snakesim("run", *SHORT, "--set", code, "--out", "run", cwd=home)
    assert ended.code == 2
    assert not (home / "run").exists()
    assert all(word in ended.err for word in ("./lab/mocap.py", *words)), ended.err


def test_showing_a_configuration_runs_none_of_its_services(home: Path) -> None:
    shown = in_process.snakesim("config", "triplet", "--set", NAMED, cwd=home)
    assert shown.code == 0
    assert not (home / "lab" / "ran").exists()
    assert (
        "services.sensor: not checked, because that would run ./lab/mocap.py:MotionCapture"
        in shown.out
    )


@pytest.mark.slow
def test_file_service_starts_alone_by_path_or_name(home: Path) -> None:
    """It waits for a host, of which there is none, and says under which name."""
    for name in ("./lab/mocap.py:MotionCapture", "sensor"):
        command = [
            *SNAKESIM_COMMAND,
            "start",
            "service",
            name,
            "triplet",
            "--set",
            NAMED,
            "--endpoint",
            find_free_endpoint(),
        ]
        with subprocess.Popen(
            command, cwd=home, env=make_environment(home), stderr=subprocess.PIPE, text=True
        ) as service:
            assert service.stderr is not None
            said = service.stderr.readline()
            service.terminate()
        assert said.startswith("sensor: waiting for the network")


MALFORMED = {
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
LOST = """

class Lost(MotionCapture):
    def outputs(self, clock):
        said = super().outputs(clock)
        if said is None or clock.lifecycle != "armed":
            return said
        return [(key, msgspec.structs.replace(pose, {})) for key, pose in said]
"""


@pytest.mark.slow  # the decoders' errors: tests/unit/hal/wire
@pytest.mark.parametrize(
    ("clock_mode", "wrong"),
    [
        ("lockstep", "array"),
        ("one", "number"),
        *(
            pytest.param(*row, marks=pytest.mark.slow)
            for row in (("realtime", "number"), ("one", "rotation"))
        ),
    ],
)
def test_malformed_message_is_named_in_log_and_run(home: Path, clock_mode: str, wrong: str) -> None:
    field, words = MALFORMED[wrong]
    lost = LOST.replace("{}", field)
    (home / "lab" / "lost.py").write_text(f"import msgspec\nimport numpy as np\n{SERVICE}{lost}")
    code = [*SHORT, "--duration", "60", "--set", "services.sensor.plugin=./lab/lost.py:Lost"]
    if clock_mode == "one":
        ended, summary = in_process.run_to_summary(home / "run", *code)
        log = (home / "run" / LOG_FILE).read_text()
    else:
        ended, summary = run_to_summary(home / "run", *code, "--clock-mode", clock_mode)
        log = (home / "run" / "sensor.log").read_text()
    assert ended.code == 1
    assert summary.duration_s < 5.0  # it ends at once
    said = re.compile(
        r"service ./lab/lost.py:Lost \(class Lost\): sensor/pose of tick \d+ cannot be published: .*"
        + re.escape(words)
    )
    assert all(said.search(text) for text in (log, summary.ended, ended.out)), (
        f"{log}\n{summary.ended}\n{ended.out}"
    )


@pytest.mark.slow
def test_a_service_that_raises_ends_the_run_with_its_name(home: Path) -> None:
    lost = LOST.replace("{}", "position_w=1 / 0")
    (home / "lab" / "lost.py").write_text(f"import msgspec\n{SERVICE}{lost}")
    code = [*SHORT, "--set", "services.sensor.plugin=./lab/lost.py:Lost"]
    ended, summary = in_process.run_to_summary(home / "run", *code)
    said = "(class Lost): outputs() raised ZeroDivisionError: division by zero (lost.py line "
    assert ended.code == 1
    assert said in summary.ended
    assert said in (home / "run" / LOG_FILE).read_text()


SILENT = """

class Silent(MotionCapture):
    def outputs(self, clock):
        return []
"""


@pytest.mark.slow
def test_run_names_missing_stream_and_stops_after_stated_time(home: Path) -> None:
    (home / "lab" / "silent.py").write_text(SERVICE + SILENT)
    flags = [
        *SHORT,
        "--set",
        "services.sensor.plugin=./lab/silent.py:Silent",
        "--set",
        "start_limit_s=3",
    ]
    ended, summary = run_to_summary(home / "run", *flags)
    why = "waiting for guidance, which has no sensor/pose yet (mission.localization=dead_reckoning does without"
    given_up = "not ready to arm within 3 s"
    for said in (summary.ended, ended.out):
        assert f"{given_up} (start_limit_s) with every service there: " in said and why in said, (
            ended.out
        )
    assert ended.code == 1
    assert summary.duration_s == 0.0
    alone = in_process.snakesim("run", *flags, "--in-process", "--out", "one", cwd=home)
    assert alone.code != 0 and given_up in alone.err and why in alone.err, alone


FROZEN = """

class Frozen(MotionCapture):
    def outputs(self, clock):
        if clock.tick <= 50:
            self.last = super().outputs(clock)[0][1]
        return [(keys.POSE, msgspec.structs.replace(self.last, tick=clock.tick))]
"""


def test_control_holds_while_service_repeats_an_old_pose(home: Path) -> None:
    (home / "lab" / "frozen.py").write_text("import msgspec\n" + SERVICE + FROZEN)
    code = ["--set", "services.sensor.plugin=./lab/frozen.py:Frozen", "--duration", "1"]
    ended, summary = in_process.run_to_summary(home / "run", *SHORT, *code)
    assert ended.code == 0 and summary.pose_from == "sensor", ended.out
    assert summary.reported_state == "NotLocomoting"
    assert re.search(r"sensor/pose is 0\.\d+ s old", summary.reported_reason or "")


def test_pose_service_alone_makes_no_one_wait_for_contacts(home: Path) -> None:
    """On a robot whose file has no contact sensors."""
    robot = (home / "bare.toml").read_text()
    bare = "\n[".join(
        part for part in robot.split("\n[") if not part.startswith("sensors.contacts]")
    )
    (home / "bare.toml").write_text(bare)
    ended, _ = in_process.run_to_summary(home / "run", *SHORT, "--set", NAMED)
    assert ended.code == 0, ended.out
