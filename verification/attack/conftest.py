"""Fixtures that share a robot between the attacks, and the summary of what the tests measured."""

from collections.abc import Iterator
from typing import Any

import pytest

from verification.attack.console import MAX_OPEN_FILES
from verification.attack.robot import AttackedRobot, SharedRobot

TESTS_WITHOUT_ROBOT = "test_attack_suite.py"


@pytest.fixture(scope="package")
def shared_robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SharedRobot]:
    """A robot whose host listens on the network's endpoint."""
    shared = SharedRobot(tmp_path_factory.mktemp("robot"))
    yield shared
    shared.close()


@pytest.fixture(scope="package")
def shared_robot_with_router(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SharedRobot]:
    """A robot with a router process, which continues if the host is frozen."""
    shared = SharedRobot(tmp_path_factory.mktemp("robot_with_router"), "--with-router")
    yield shared
    shared.close()


@pytest.fixture(scope="module")
def shared_robot_with_console(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SharedRobot]:
    """A robot with a console, whose processes may open MAX_OPEN_FILES files each."""
    shared = SharedRobot(
        tmp_path_factory.mktemp("robot_with_console"),
        "--console",
        command_prefix=("prlimit", f"--nofile={MAX_OPEN_FILES}:{MAX_OPEN_FILES}"),
    )
    yield shared
    shared.close()


@pytest.fixture
def robot(shared_robot: SharedRobot) -> AttackedRobot:
    """An armed robot."""
    return shared_robot.make_armed()


@pytest.fixture
def robot_with_router(shared_robot_with_router: SharedRobot) -> AttackedRobot:
    """An armed robot whose network continues if its host is frozen."""
    return shared_robot_with_router.make_armed()


@pytest.fixture
def robot_with_console(shared_robot_with_console: SharedRobot) -> AttackedRobot:
    """An armed robot with a console."""
    return shared_robot_with_console.make_armed()


@pytest.fixture
def console_address(robot_with_console: AttackedRobot) -> str:
    """The address of the robot's console, http://..., which ends with a secret token."""
    return robot_with_console.run.console()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that start real processes as `e2e`."""
    for item in items:
        is_attack = "/verification/attack/" in str(item.path)
        if is_attack and item.path.name != TESTS_WITHOUT_ROBOT:
            item.add_marker(pytest.mark.e2e)


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Print the values that the attacks recorded with `record_property`."""
    lines: set[str] = set()
    for reports in terminalreporter.stats.values():
        for report in reports:
            properties = getattr(report, "user_properties", [])
            if not properties or "verification/attack" not in report.nodeid:
                continue
            test = report.nodeid.rpartition("/")[2]
            lines |= {f"{test}: {name} {value}" for name, value in properties}
    if lines:
        terminalreporter.section("measured")
        for line in sorted(lines):
            terminalreporter.write_line(line)
