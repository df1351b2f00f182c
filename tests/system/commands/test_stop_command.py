"""`snakesim estop`, `disarm`: who is asked, who is believed, and what is said when nobody is."""

from pathlib import Path

import pytest

from snakesim_hal.base.errors import ConfigError, RefusedError
from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Answer
from snakesim_operator.base.targets import RobotSelection
from snakesim_operator.cli import main
from snakesim_operator.robot_commands import command, stop
from snakesim_testing.hal.local_network import SineFollower, running_follower, running_host
from snakesim_testing.hal.small_robots import make_run_config
from snakesim_testing.messages import raises_error
from snakesim_testing.runs.command import snakesim


@pytest.mark.slow
def test_a_robot_that_does_not_answer_a_stop_is_named() -> None:
    with running_host(make_run_config()) as run:
        at, said = run.link.endpoint, list[str]()
        assert stop.stop_robots(RobotSelection(at), said.append) == 0
        assert said == [f"lab/worm: stopped: {run.status.reason} ({at})"]
        assert run.status.lifecycle == "estop"
        with open_session(ConnectionSettings(at, "lab/deaf")) as deaf:
            deaf.declare_alive("hal")
            said.clear()
            assert stop.stop_robots(RobotSelection(at), said.append) == 1
            assert {line.split(": ")[1] for line in said if line.startswith("lab/worm")} == {
                "stopped"
            }
            assert any(line.startswith("lab/deaf: NOT STOPPED: NO ANSWER") for line in said)
            said.clear()
            assert stop.stop_robots(RobotSelection(at, "lab/nobody"), said.append) == 1
            assert said[0].startswith("lab/nobody: NOT STOPPED: NO ANSWER")
            assert [line.split()[2] for line in said[1:]] == ["lab/deaf,", "lab/worm,"], (
                "those that are there"
            )


def test_a_stop_waits_for_no_slow_import(tmp_path: Path) -> None:
    ended = snakesim(
        "estop", "--namespace", "nobody", cwd=tmp_path, extra_env={"PYTHONPROFILEIMPORTTIME": "1"}
    )
    imported = [line.rpartition("|")[2].strip() for line in ended.err.splitlines()]
    assert not {"numpy", "jinja2", "mujoco"} & set(imported)
    slow = min(imported.index("msgspec"), imported.index("zenoh"))
    assert imported.index("snakesim_hal.network.stop_port") < slow


def test_stop_answer_without_matching_status_is_not_trusted() -> None:
    with running_host(make_run_config()) as run, running_follower(run.link, SineFollower()):
        run.arm()
        with open_session(ConnectionSettings(run.link.endpoint, "lab/other")) as impostor:
            impostor.declare_alive("hal")
            impostor.on_query(
                keys.LIFECYCLE,
                lambda question: question.reply(
                    Answer(ok=True, reason="done", lifecycle="disarmed")
                ),
            )
            with raises_error(RefusedError, code="robot/not-confirmed"):
                command.disarm_robot(RobotSelection(run.link.endpoint, "lab/other"))
        assert run.status.lifecycle == "armed"


def test_an_emergency_stop_looks_up_no_entry_points(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_group: str) -> list[str]:
        raise ConfigError("entry points were looked up")

    monkeypatch.setattr("snakesim_hal.model.plugins.list_installed_plugins", refuse)
    assert main(["estop", "--endpoint", "tcp/127.0.0.1:9"]) == 1
