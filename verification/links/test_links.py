"""A robot and its controller on machines of their own: what a broken link or a dead router does. Needs root."""

import os
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from verification.links.lab import LinkLab, lab

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.skipif(os.geteuid() != 0, reason="makes network namespaces: needs root"),
    pytest.mark.skipif(not shutil.which("ip"), reason="makes network namespaces: needs iproute2"),
    pytest.mark.skipif(
        not Path("/dev/net/tun").exists(),
        reason="makes links of TAP interfaces: needs /dev/net/tun",
    ),
]
IMAGES_BYTES = 200_000
STOP_LIMIT_S = 0.3  # 50 ms of the lease, a period, and a busy computer


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LinkLab]:
    with lab(tmp_path_factory.mktemp("lab")) as made:
        yield made


def armed(made: LinkLab) -> None:
    """Moving for a moment."""
    made.arm()
    time.sleep(0.3)


def test_cut_link_stops_robot_and_restored_one_allows_arming(robot: LinkLab) -> None:
    armed(robot)
    robot.link.set_quality(cut=True)
    assert robot.until(lambda status: status.lifecycle == "fault", "stopped") < STOP_LIMIT_S
    time.sleep(3.0)  # longer than the session between router and workstation lives
    robot.link.set_quality()
    robot.arm()


def test_dead_router_stops_robot_and_new_one_allows_arming(robot: LinkLab) -> None:
    """Again and again: a row of the fault table."""
    armed(robot)
    robot.kill_router()
    assert robot.until(lambda status: status.lifecycle == "fault", "stopped") < STOP_LIMIT_S
    robot.start_router()
    robot.arm()


def test_a_link_with_some_delay_keeps_the_robot_armed(robot: LinkLab) -> None:
    robot.link.set_quality(delay_s=0.005)
    try:
        armed(robot)
        time.sleep(1.0)
        assert robot.status is not None and robot.status.lifecycle == "armed"
    finally:
        robot.link.set_quality()


def test_slow_link_overloaded_by_images_stops_nothing(tmp_path: Path) -> None:
    with lab(tmp_path, "robot=planar13_camera") as made:
        made.robot.run(
            "sh", "-c", "tc qdisc add dev robot root tbf rate 4mbit burst 16kb latency 50ms"
        )
        recording = made.record()
        made.until(
            lambda _: recording.is_file() and recording.stat().st_size > IMAGES_BYTES,
            "images are recorded",
        )

        def stays_armed() -> bool:
            made.arm()
            time.sleep(2.0)
            return made.status is not None and made.status.lifecycle == "armed"

        # A busy computer may stop it once; a link that is too full would each time.
        assert any(stays_armed() for _ in range(3)), made.status and made.status.reason
        link = made.robot.run("tc", "-s", "qdisc", "show", "dev", "robot")
        assert re.search(r"overlimits [1-9]\d{2,}", link), f"it was not full: {link}"
