"""One robot for all attacks that leave it alive, and what was measured, told at the end."""

from collections.abc import Iterator
from typing import Any

import pytest

from verification.attack.robot import AttackedRobot, Victim


@pytest.fixture(scope="package")
def victim(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Victim]:
    kept = Victim(tmp_path_factory.mktemp("victim"))
    yield kept
    kept.close()


@pytest.fixture(scope="package")
def victim_behind_a_router(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Victim]:
    kept = Victim(tmp_path_factory.mktemp("routed"), "--with-router")
    yield kept
    kept.close()


@pytest.fixture
def routed(victim_behind_a_router: Victim) -> AttackedRobot:
    """A robot whose network outlives its host."""
    return victim_behind_a_router.armed()


@pytest.fixture
def robot(victim: Victim) -> AttackedRobot:
    return victim.armed()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """All but the tests of the suite itself start real processes."""
    for item in items:
        if "/verification/attack/" in str(item.path) and item.path.name != "test_stranger.py":
            item.add_marker(pytest.mark.e2e)


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """What tests have measured, by `record_property`."""
    rows = {
        f"{report.nodeid.rpartition('/')[2]}: {name} {value}"
        for reports in terminalreporter.stats.values()
        for report in reports
        for name, value in getattr(report, "user_properties", [])
        if "verification/attack" in report.nodeid
    }
    if rows:
        terminalreporter.section("measured")
        for row in sorted(rows):
            terminalreporter.write_line(row)
