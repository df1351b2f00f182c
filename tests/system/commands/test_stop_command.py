"""`snakesim estop` and `disarm` report every robot, trust only a confirmed status, and load little code."""

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
def test_estop_with_silent_robot_names_it() -> None:
    with running_host(make_run_config()) as run:
        endpoint = run.link.endpoint
        lines = list[str]()
        assert stop.stop_robots(RobotSelection(endpoint), lines.append) == 0
        assert lines == [f"lab/worm: stopped: {run.status.reason} ({endpoint})"]
        assert run.status.lifecycle == "estop"
        with open_session(ConnectionSettings(endpoint, "lab/deaf")) as silent_host:
            silent_host.declare_alive("hal")
            lines.clear()
            assert stop.stop_robots(RobotSelection(endpoint), lines.append) == 1
            results = {line.split(": ")[1] for line in lines if line.startswith("lab/worm")}
            assert results == {"stopped"}
            assert any(line.startswith("lab/deaf: NOT STOPPED: NO ANSWER") for line in lines)
            lines.clear()
            assert stop.stop_robots(RobotSelection(endpoint, "lab/nobody"), lines.append) == 1
            assert lines[0].startswith("lab/nobody: NOT STOPPED: NO ANSWER")
            # The next lines name the robots on the network.
            assert [line.split()[2] for line in lines[1:]] == ["lab/deaf,", "lab/worm,"]


def test_estop_imports_stop_port_before_slow_modules(tmp_path: Path) -> None:
    completed = snakesim(
        "estop", "--namespace", "nobody", cwd=tmp_path, extra_env={"PYTHONPROFILEIMPORTTIME": "1"}
    )
    modules = [line.rpartition("|")[2].strip() for line in completed.err.splitlines()]
    assert not {"numpy", "jinja2", "mujoco"} & set(modules)
    first_slow_import = min(modules.index("msgspec"), modules.index("zenoh"))
    assert modules.index("snakesim_hal.network.stop_port") < first_slow_import


def test_disarm_answer_without_matching_status_is_not_trusted() -> None:
    with running_host(make_run_config()) as run, running_follower(run.link, SineFollower()):
        run.arm()
        with open_session(ConnectionSettings(run.link.endpoint, "lab/other")) as impostor:
            impostor.declare_alive("hal")
            impostor.on_query(
                keys.LIFECYCLE,
                lambda query: query.reply(Answer(ok=True, reason="done", lifecycle="disarmed")),
            )
            with raises_error(RefusedError, code="robot/not-confirmed"):
                command.disarm_robot(RobotSelection(run.link.endpoint, "lab/other"))
        assert run.status.lifecycle == "armed"


def test_estop_looks_up_no_entry_points(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail_to_list_plugins(_group: str) -> list[str]:
        raise ConfigError("entry points were looked up")

    monkeypatch.setattr("snakesim_hal.model.plugins.list_installed_plugins", fail_to_list_plugins)
    assert main(["estop", "--endpoint", "tcp/127.0.0.1:9"]) == 1
