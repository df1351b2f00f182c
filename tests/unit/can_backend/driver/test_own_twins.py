"""The twins that a driver starts for itself: what is refused, and a child process from its start to its end."""

import json
import os
import sys
import time
from pathlib import Path

import pytest

from snakesim_can_backend.driver import own_twins
from snakesim_can_backend.driver.own_twins import TwinProcess, check_twins
from snakesim_can_backend.settings import CanSettings
from snakesim_hal.errors import BackendError, ConfigError
from snakesim_hal.injection import Injection
from tests.harness.wait import wait_until
from tests.unit.can_backend.loop import config

RUN = config()
VCAN = ["vcan0"]

# --- what is refused ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (
            CanSettings(twins="here", channels=VCAN),
            r'"here" is a virtual bus .* leave `channels` empty, or .*"process"',
        ),
        (CanSettings(twins="none"), r'"none" needs a bus: name it in `backends\.can\.channels`'),
        (CanSettings(twins="process"), r'"process" needs a bus'),
        (CanSettings(channels=VCAN, faults=["mute:joint_1@1"]), r"`backends\.can\.faults` are for twins"),
        (CanSettings(faults=["mute:joint_5@1"]), "joint_5"),
        (CanSettings(faults=["melt:joint_1@1"]), "melt"),
        (CanSettings(channels=VCAN, twins="process", faults=["mute:joint_9@1"]), "joint_9"),
    ],
)
def test_twins_that_cannot_be_are_refused(settings: CanSettings, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        check_twins(RUN, settings)


# --- the child ---------------------------------------------------------------------------------------------


def child(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str) -> Path:
    """Instead of `snakesim modules` runs a program that notes its arguments and does as told; where it notes them."""
    noted = tmp_path / "noted.json"
    program = tmp_path / "python"
    program.write_text(
        f"#!{sys.executable}\n"
        "import json, os, pathlib, signal, sys, time\n"
        "config = pathlib.Path(sys.argv[3])\n"
        f"noted = pathlib.Path({str(noted)!r})\n"
        "noted.write_text(json.dumps({'arguments': sys.argv[1:], 'pid': os.getpid(), 'session': os.getsid(0),"
        " 'config': json.loads(config.read_text())}))\n" + body
    )
    program.chmod(0o755)
    monkeypatch.setattr(own_twins.sys, "executable", str(program))
    return noted


def gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


SERVE = "print('modules ready: 4 on vcan0', flush=True)\ntime.sleep(60)\n"


def test_a_child_is_told_everything_and_ends_when_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    end = "signal.signal(signal.SIGTERM, lambda *_: (print('last words', flush=True), sys.exit(0)))\n"
    noted = child(tmp_path, monkeypatch, end + "print('a warning')\n" + SERVE)
    settings = CanSettings(channels=["vcan0", "vcan1"], twins="process", plant="inertia", faults=["mute:joint_1@2"])
    twins = TwinProcess(RUN, settings, "127.0.0.1:5000", stepped=True)
    reported = json.loads(noted.read_text())
    arguments = reported["arguments"]
    assert arguments[:2] == ["-m", "snakesim_can_backend.twin.command"] and "--stepped" in arguments
    assert [arguments[i + 1] for i, word in enumerate(arguments) if word == "--channel"] == ["vcan0", "vcan1"]
    assert arguments[arguments.index("--pose") + 1] == "127.0.0.1:5000"
    assert arguments[arguments.index("--parent") + 1] == str(os.getpid())
    assert reported["session"] == reported["pid"], "Ctrl-C is not for it"
    assert reported["config"]["backends"]["can"]["plant"] == "inertia"
    assert reported["config"]["backends"]["can"]["faults"] == ["mute:joint_1@2"]
    twins.stop()
    assert gone(reported["pid"]) and not Path(arguments[2]).exists()
    said = capsys.readouterr().err
    assert "a warning" in said and "last words" in said


def test_without_a_camera_and_in_real_time_it_is_told_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    noted = child(tmp_path, monkeypatch, SERVE)
    twins = TwinProcess(RUN, CanSettings(channels=VCAN, twins="process"), None, stepped=False)
    twins.stop()
    arguments = json.loads(noted.read_text())["arguments"]
    assert arguments[arguments.index("--pose") + 1] == "none" and "--stepped" not in arguments


def test_a_child_that_will_not_end_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_twins, "STOP_LIMIT_S", 0.2)
    noted = child(tmp_path, monkeypatch, "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n" + SERVE)
    twins = TwinProcess(RUN, CanSettings(channels=VCAN, twins="process"), None, stepped=False)
    began = time.monotonic()
    twins.stop()
    assert gone(json.loads(noted.read_text())["pid"]) and time.monotonic() - began < 5.0


@pytest.mark.parametrize("ending", ["sys.exit(2)\n", "time.sleep(60)\n"])
def test_a_child_that_does_not_get_ready_is_told_and_leaves_nothing(
    ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(own_twins, "START_LIMIT_S", 1.0)
    noted = child(tmp_path, monkeypatch, "print('no such plant', flush=True)\n" + ending)
    with pytest.raises(BackendError, match="the module twins did not start"):
        TwinProcess(RUN, CanSettings(channels=VCAN, twins="process"), None, stepped=False)
    reported = json.loads(noted.read_text())
    assert gone(reported["pid"]) and not Path(reported["arguments"][2]).exists()
    assert "no such plant" in capsys.readouterr().err


def test_the_real_command_says_why_it_does_not_start(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(BackendError, match="did not start"):
        TwinProcess(RUN, CanSettings(channels=["vcan77"], twins="process", plant="inertia"), None, stepped=False)
    assert "vcan77" in capsys.readouterr().err


def test_a_child_that_ends_by_itself_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    child(tmp_path, monkeypatch, "print('modules ready: 4', flush=True)\ntime.sleep(0.3)\nsys.exit(3)\n")
    twins = TwinProcess(RUN, CanSettings(channels=VCAN, twins="process"), None, stepped=False)
    assert twins.how_it_ended() is None
    wait_until(twins.how_it_ended, "the end of the child")
    assert twins.how_it_ended() == "the module twins have ended, with exit code 3"
    twins.stop()


def test_a_child_is_told_what_goes_wrong_as_in_a_terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    heard = tmp_path / "heard"
    listen = "print('modules ready: 4', flush=True)\nfor line in sys.stdin:\n    "
    noted = child(tmp_path, monkeypatch, f"{listen}pathlib.Path({str(heard)!r}).open('a').write(line)\n")
    twins = TwinProcess(RUN, CanSettings(channels=VCAN, twins="process"), None, stepped=False)
    assert "--interactive" in json.loads(noted.read_text())["arguments"]
    twins.inject(Injection("mute", "joint_3", 1.0, 2.0), begins=True)
    twins.inject(Injection("mute", "joint_3", 1.0, 2.0), begins=False)
    wait_until(lambda: heard.exists() and heard.read_text().endswith("off\n"), "the end told to the child")
    assert heard.read_text() == "mute joint_3\nmute joint_3 off\n"
    twins.stop()
    with pytest.raises(BackendError, match=r"do not accept leak:joint_1@0"):
        for _ in range(100):  # until the pipe is known to be broken
            twins.inject(Injection("leak", "joint_1"), begins=True)


def test_a_child_that_cannot_be_started_is_an_error_of_the_backend(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(own_twins.sys, "executable", str(tmp_path / "no python"))
    with pytest.raises(BackendError, match=r"the module twins cannot be started: .*No such file"):
        TwinProcess(RUN, CanSettings(channels=VCAN), None, stepped=True)


def test_a_log_that_is_gone_keeps_no_child_from_ending(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    child(tmp_path, monkeypatch, "print('modules ready', flush=True)\ntime.sleep(60)\n")
    twins = TwinProcess(RUN, CanSettings(channels=VCAN), None, stepped=True)
    twins._said.unlink()
    twins.stop()
    assert twins.how_it_ended() is not None
