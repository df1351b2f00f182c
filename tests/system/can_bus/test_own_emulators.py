"""The emulators that a driver starts for itself: what is refused, and a child process from its start to its end."""

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

RUN = make_can_config()
VCAN = ["vcan0"]

# --- what is refused ---------------------------------------------------------------------------------------


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
def test_twins_that_cannot_be_are_refused(settings: CanSettings) -> None:
    with raises_error(
        ConfigError,
        code=(
            "bus/not-virtual",
            "injection/not-supported",
            "injection/unknown-fault",
            "injection/unknown-target",
        ),
    ):
        validate_emulator_settings(RUN, settings)


# --- the child ---------------------------------------------------------------------------------------------


class Child:
    """Instead of `snakesim drive emulate can` runs a program that notes how it was started, and does as told."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self._noted, self._program = folder / "noted.json", folder / "python"
        self._patch = monkeypatch

    def does(self, *lines: str) -> None:
        noting = "{'arguments': sys.argv[1:], 'pid': os.getpid(), 'session': os.getsid(0), 'config': config}"
        self._program.write_text(
            f"#!{sys.executable}\n"
            "import json, os, pathlib, signal, sys, time\n"
            "config = json.loads(pathlib.Path(sys.argv[4]).read_text())\n"
            f"pathlib.Path({str(self._noted)!r}).write_text(json.dumps({noting}))\n"
            + "\n".join(lines)
        )
        self._program.chmod(0o755)
        self._patch.setattr(sys, "executable", str(self._program))

    def noted(self) -> dict[str, Any]:
        return json.loads(self._noted.read_text())

    def must_be_gone(self) -> None:
        """The process, and the configuration that was written for it."""
        noted = self.noted()
        with pytest.raises(ProcessLookupError):
            os.kill(noted["pid"], 0)
        assert not Path(noted["arguments"][3]).exists()


@pytest.fixture
def child(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Child:
    return Child(tmp_path, monkeypatch)


READY, SERVE = "print('modules ready: 4 on vcan0', flush=True)", "time.sleep(60)"
ON_VCAN = CanSettings(channels=VCAN, emulators="process", physics_model="inertia")


def test_a_child_is_told_everything_and_ends_when_asked(
    child: Child, capsys: pytest.CaptureFixture[str]
) -> None:
    end = "signal.signal(signal.SIGTERM, lambda *_: (print('last words', flush=True), sys.exit(0)))"
    child.does(end, "print('a warning')", READY, SERVE)
    settings = CanSettings(
        channels=["vcan0", "vcan1"],
        emulators="process",
        physics_model="inertia",
        faults=["mute:joint_1@2"],
    )
    emulators = EmulatorProcess(RUN, settings, "127.0.0.1:5000", is_stepped=True)
    noted = child.noted()
    arguments = noted["arguments"]
    assert arguments[:3] == ["-P", "-m", "snakesim_can_backend.emulator.command"]
    assert "--stepped" in arguments
    assert [arguments[i + 1] for i, word in enumerate(arguments) if word == "--channel"] == [
        "vcan0",
        "vcan1",
    ]
    assert arguments[arguments.index("--pose") + 1] == "127.0.0.1:5000"
    assert arguments[arguments.index("--parent") + 1] == str(os.getpid())
    assert noted["session"] == noted["pid"], "Ctrl-C is not for it"
    assert noted["config"]["backends"]["can"]["physics_model"] == "inertia"
    assert noted["config"]["backends"]["can"]["faults"] == ["mute:joint_1@2"]
    emulators.stop()
    child.must_be_gone()
    said = capsys.readouterr().err
    assert "a warning" in said
    assert "last words" in said


def test_a_child_that_will_not_end_is_killed(child: Child, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(emulator_child, "STOP_TIMEOUT_S", 0.2)
    child.does("signal.signal(signal.SIGTERM, signal.SIG_IGN)", READY, SERVE)
    emulators = EmulatorProcess(RUN, ON_VCAN, None, is_stepped=False)
    began = time.monotonic()
    emulators.stop()
    assert time.monotonic() - began < 5.0
    child.must_be_gone()


@pytest.mark.parametrize("ending", ["sys.exit(2)", SERVE])
def test_emulator_process_that_never_becomes_ready_is_reported_and_removed(
    ending: str, child: Child, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(emulator_child, "SERVICE_START_LIMIT_S", 5.0)
    child.does("print('no such physics_model', flush=True)", ending)
    with raises_error(BackendError, code="emulator/not-started"):
        EmulatorProcess(RUN, ON_VCAN, None, is_stepped=False)
    child.must_be_gone()
    assert "no such physics_model" in capsys.readouterr().err


def test_the_real_command_says_why_it_does_not_start(capsys: pytest.CaptureFixture[str]) -> None:
    with raises_error(BackendError, code="emulator/not-started"):
        EmulatorProcess(
            RUN,
            CanSettings(channels=["vcan77"], emulators="process", physics_model="inertia"),
            None,
            is_stepped=False,
        )
    assert "vcan77" in capsys.readouterr().err


def test_emulator_process_exit_is_noticed_without_its_log(child: Child) -> None:
    child.does(READY, "time.sleep(0.3)", "sys.exit(3)")
    emulators = EmulatorProcess(RUN, ON_VCAN, None, is_stepped=False)
    assert emulators.describe_exit() is None
    emulators._child.output_path.unlink()
    wait_until(emulators.describe_exit, "the end of the child")
    assert emulators.describe_exit() == "the emulated joint modules have ended, with exit code 3"
    emulators.stop()


def test_emulator_process_error_is_reported_as_in_a_terminal(child: Child, tmp_path: Path) -> None:
    heard = tmp_path / "heard"
    child.does(
        READY, "for line in sys.stdin:", f"    pathlib.Path({str(heard)!r}).open('a').write(line)"
    )
    emulators = EmulatorProcess(RUN, ON_VCAN, None, is_stepped=False)
    arguments = child.noted()["arguments"]
    assert "--interactive" in arguments
    assert "--stepped" not in arguments
    assert arguments[arguments.index("--pose") + 1] == "none"
    emulators.inject(FaultInjection("mute", "joint_3", 1.0, 2.0), begins=True)
    emulators.inject(FaultInjection("mute", "joint_3", 1.0, 2.0), begins=False)
    wait_until(
        lambda: heard.exists() and heard.read_text().endswith("off\n"), "the end told to the child"
    )
    assert heard.read_text() == "mute joint_3\nmute joint_3 off\n"
    emulators.stop()
    with raises_error(BackendError, code="injection/not-supported", field="joint_1"):
        for _ in range(100):  # until the pipe is known to be broken
            emulators.inject(FaultInjection("leak", "joint_1"), begins=True)


def test_emulator_process_that_cannot_start_is_a_backend_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", str(tmp_path / "no python"))
    with raises_error(BackendError, code="emulator/not-started"):
        EmulatorProcess(RUN, ON_VCAN, None, is_stepped=True)
