"""A driver starts its own emulators in a child process, checks their settings, and ends the process with the run."""

import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from snakesim_can_backend.driver.own_emulators import EmulatorProcess, validate_emulator_settings
from snakesim_can_backend.settings import CanSettings
from snakesim_drivers.emulation import emulator_child
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.model.fault_kinds import FaultInjection
from snakesim_testing.can.driver_loop import make_can_config
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.messages import raises_error

RUN_CONFIG = make_can_config()
VCAN = ["vcan0"]

# --- refused settings --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "settings",
    [
        CanSettings(emulators="here", channels=VCAN),
        CanSettings(emulators="none"),
        CanSettings(emulators="process"),
        CanSettings(channels=VCAN, faults=["mute:joint_1@1"]),
        CanSettings(faults=["mute:joint_5@1"]),
        CanSettings(faults=["melt:joint_1@1"]),
        CanSettings(channels=VCAN, emulators="process", faults=["mute:joint_9@1"]),
        CanSettings(channels=VCAN, emulators="firmware"),
        CanSettings(emulators="firmware", faults=["mute:joint_1@1"]),
    ],
)
def test_own_emulators_with_impossible_settings_are_refused(settings: CanSettings) -> None:
    with raises_error(
        ConfigError,
        code=(
            "bus/not-virtual",
            "injection/not-supported",
            "injection/unknown-fault",
            "injection/unknown-target",
        ),
    ):
        validate_emulator_settings(RUN_CONFIG, settings)


# --- the child ---------------------------------------------------------------------------------------------------


class ReplacedChild:
    """Replaces `snakesim drive emulate can` by a program that stores how it was started, and then runs given code."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self._start_info_file = folder / "start_info.json"
        self._program = folder / "python"
        self._patch = monkeypatch

    def install(self, *lines: str) -> None:
        """Use a program with these lines of code as the interpreter of the child process."""
        start_info = "{'arguments': sys.argv[1:], 'pid': os.getpid(), 'session': os.getsid(0), 'config': config}"
        self._program.write_text(
            f"#!{sys.executable}\n"
            "import json, os, pathlib, signal, sys, time\n"
            "config = json.loads(pathlib.Path(sys.argv[4]).read_text())\n"
            f"pathlib.Path({str(self._start_info_file)!r}).write_text(json.dumps({start_info}))\n"
            + "\n".join(lines)
        )
        self._program.chmod(0o755)
        self._patch.setattr(sys, "executable", str(self._program))

    def read_start_info(self) -> dict[str, Any]:
        """Return arguments, process id, session and configuration of the child."""
        return json.loads(self._start_info_file.read_text())

    def assert_removed(self) -> None:
        """Check that the process and the file with its configuration do not exist any more."""
        start_info = self.read_start_info()
        with pytest.raises(ProcessLookupError):
            os.kill(start_info["pid"], 0)
        assert not Path(start_info["arguments"][3]).exists()


@pytest.fixture
def child(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ReplacedChild:
    """Provide a child process whose program the test selects."""
    return ReplacedChild(tmp_path, monkeypatch)


READY = "print('modules ready: 4 on vcan0', flush=True)"
SERVE = "time.sleep(60)"
ON_VCAN = CanSettings(channels=VCAN, emulators="process", physics_model="inertia")


def test_emulator_process_receives_its_settings_and_ends_on_request(
    child: ReplacedChild, capsys: pytest.CaptureFixture[str]
) -> None:
    end = "signal.signal(signal.SIGTERM, lambda *_: (print('last words', flush=True), sys.exit(0)))"
    child.install(end, "print('a warning')", READY, SERVE)
    settings = CanSettings(
        channels=["vcan0", "vcan1"],
        emulators="process",
        physics_model="inertia",
        faults=["mute:joint_1@2"],
    )
    emulators = EmulatorProcess(RUN_CONFIG, settings, "127.0.0.1:5000", is_stepped=True)
    start_info = child.read_start_info()
    arguments = start_info["arguments"]
    assert arguments[:3] == ["-P", "-m", "snakesim_can_backend.emulator.command"]
    assert "--stepped" in arguments
    channels = [
        arguments[index + 1] for index, argument in enumerate(arguments) if argument == "--channel"
    ]
    assert channels == ["vcan0", "vcan1"]
    assert arguments[arguments.index("--pose") + 1] == "127.0.0.1:5000"
    assert arguments[arguments.index("--parent") + 1] == str(os.getpid())
    assert start_info["session"] == start_info["pid"], "Ctrl-C would end the child"
    settings_of_child = start_info["config"]["backends"]["can"]
    assert settings_of_child["physics_model"] == "inertia"
    assert settings_of_child["faults"] == ["mute:joint_1@2"]
    emulators.stop()
    child.assert_removed()
    printed = capsys.readouterr().err
    assert "a warning" in printed
    assert "last words" in printed


def test_emulator_process_that_ignores_sigterm_is_killed(
    child: ReplacedChild, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(emulator_child, "STOP_TIMEOUT_S", 0.2)
    child.install("signal.signal(signal.SIGTERM, signal.SIG_IGN)", READY, SERVE)
    emulators = EmulatorProcess(RUN_CONFIG, ON_VCAN, None, is_stepped=False)
    start_s = time.monotonic()
    emulators.stop()
    assert time.monotonic() - start_s < 5.0
    child.assert_removed()


@pytest.mark.parametrize("ending", ["sys.exit(2)", SERVE])
def test_emulator_process_that_never_becomes_ready_is_reported_and_removed(
    ending: str,
    child: ReplacedChild,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(emulator_child, "SERVICE_START_LIMIT_S", 5.0)
    child.install("print('no such physics_model', flush=True)", ending)
    with raises_error(BackendError, code="emulator/not-started"):
        EmulatorProcess(RUN_CONFIG, ON_VCAN, None, is_stepped=False)
    child.assert_removed()
    assert "no such physics_model" in capsys.readouterr().err


def test_emulator_command_without_interface_reports_its_name(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with raises_error(BackendError, code="emulator/not-started"):
        EmulatorProcess(
            RUN_CONFIG,
            CanSettings(channels=["vcan77"], emulators="process", physics_model="inertia"),
            None,
            is_stepped=False,
        )
    assert "vcan77" in capsys.readouterr().err


def test_emulator_process_exit_is_noticed_without_its_log(child: ReplacedChild) -> None:
    child.install(READY, "time.sleep(0.3)", "sys.exit(3)")
    emulators = EmulatorProcess(RUN_CONFIG, ON_VCAN, None, is_stepped=False)
    assert emulators.describe_exit() is None
    emulators._child.output_path.unlink()
    wait_until(emulators.describe_exit, "the end of the child")
    assert emulators.describe_exit() == "the emulated joint modules have ended, with exit code 3"
    emulators.stop()


def test_emulator_process_receives_faults_as_from_a_terminal(
    child: ReplacedChild, tmp_path: Path
) -> None:
    received = tmp_path / "received"
    child.install(
        READY,
        "for line in sys.stdin:",
        f"    pathlib.Path({str(received)!r}).open('a').write(line)",
    )
    emulators = EmulatorProcess(RUN_CONFIG, ON_VCAN, None, is_stepped=False)
    arguments = child.read_start_info()["arguments"]
    assert "--interactive" in arguments
    assert "--stepped" not in arguments
    assert arguments[arguments.index("--pose") + 1] == "none"
    emulators.inject(FaultInjection("mute", "joint_3", 1.0, 2.0), begins=True)
    emulators.inject(FaultInjection("mute", "joint_3", 1.0, 2.0), begins=False)
    wait_until(
        lambda: received.exists() and received.read_text().endswith("off\n"),
        "the child receives the end of the fault",
    )
    assert received.read_text() == "mute joint_3\nmute joint_3 off\n"
    emulators.stop()
    with raises_error(BackendError, code="injection/not-supported", field="joint_1"):
        for _ in range(100):  # the first writes to a broken pipe may raise no error
            emulators.inject(FaultInjection("leak", "joint_1"), begins=True)


def test_emulator_process_that_cannot_start_is_a_backend_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", str(tmp_path / "no python"))
    with raises_error(BackendError, code="emulator/not-started"):
        EmulatorProcess(RUN_CONFIG, ON_VCAN, None, is_stepped=True)
