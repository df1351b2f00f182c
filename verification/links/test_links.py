"""A robot and its controller on separate machines: what a bad link or a dead router does. Needs root."""

import os
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from verification.links.link_lab import LinkLab, start_link_lab

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.skipif(os.geteuid() != 0, reason="makes network namespaces: needs root"),
    pytest.mark.skipif(not shutil.which("ip"), reason="makes network namespaces: needs iproute2"),
    pytest.mark.skipif(
        not Path("/dev/net/tun").exists(),
        reason="makes links of TAP interfaces: needs /dev/net/tun",
    ),
]
MIN_RECORDING_BYTES = 200_000  # a recording of this size contains images
MAX_STOP_S = 0.3  # the lease lasts 50 ms; the rest is for a control cycle on a busy computer
SLOW_LINK = "tc qdisc add dev robot root tbf rate 4mbit burst 16kb latency 50ms"


@pytest.fixture(scope="module")
def link_lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LinkLab]:
    """Return a lab whose robot is ready to be armed."""
    with start_link_lab(tmp_path_factory.mktemp("lab")) as started_lab:
        yield started_lab


def arm_and_move(link_lab: LinkLab) -> None:
    """Arm the robot, and let it move for a moment."""
    link_lab.arm()
    time.sleep(0.3)


def wait_for_stop(link_lab: LinkLab) -> float:
    """Wait until the host has stopped the robot, and return the waiting time in s."""
    return link_lab.wait_until(lambda status: status.lifecycle == "fault", "stopped")


def test_cut_link_stops_robot_and_restored_one_allows_arming(link_lab: LinkLab) -> None:
    arm_and_move(link_lab)
    link_lab.link.set_quality(cut=True)
    assert wait_for_stop(link_lab) < MAX_STOP_S
    time.sleep(3.0)  # the session between router and workstation ends earlier
    link_lab.link.set_quality()
    link_lab.arm()


def test_dead_router_stops_robot_and_new_one_allows_arming(link_lab: LinkLab) -> None:
    arm_and_move(link_lab)
    link_lab.kill_router()
    assert wait_for_stop(link_lab) < MAX_STOP_S
    link_lab.start_router()
    link_lab.arm()


def test_link_with_some_delay_keeps_robot_armed(link_lab: LinkLab) -> None:
    link_lab.link.set_quality(delay_s=0.005)
    try:
        arm_and_move(link_lab)
        time.sleep(1.0)
        assert link_lab.is_armed()
    finally:
        link_lab.link.set_quality()


def stays_armed(link_lab: LinkLab) -> bool:
    """Arm the robot, and return whether it is still armed after 2 s."""
    link_lab.arm()
    time.sleep(2.0)
    return link_lab.is_armed()


def test_slow_link_overloaded_by_images_stops_nothing(tmp_path: Path) -> None:
    with start_link_lab(tmp_path, "robot=planar13_camera") as link_lab:
        link_lab.robot.run("sh", "-c", SLOW_LINK)
        recording = link_lab.start_recorder()
        link_lab.wait_until(
            lambda _: recording.is_file() and recording.stat().st_size > MIN_RECORDING_BYTES,
            "images are recorded",
        )
        # A busy computer may stop the robot once. A link that is too slow would stop it each time.
        assert any(stays_armed(link_lab) for _ in range(3)), link_lab.host.status
        statistics = link_lab.robot.run("tc", "-s", "qdisc", "show", "dev", "robot")
        overloaded = re.search(r"overlimits [1-9]\d{2,}", statistics)
        assert overloaded, f"the link was not overloaded: {statistics}"
