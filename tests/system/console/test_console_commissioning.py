"""The console of a real robot arms it unchecked, sets its zeros, and jogs it. The tests need no browser."""

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from snakesim_testing.harness.stalling_relay import StallingRelay
from snakesim_testing.operator.console_wait import LIMIT_S, wait_for_condition
from snakesim_testing.operator.viewer import ConsoleViewer, connect_viewer
from snakesim_testing.runs.bench_host import running_bench_host
from snakesim_testing.runs.checked_robot import make_checked_folder
from snakesim_testing.runs.command import run_in_background, running_snakesim
from snakesim_testing.runs.hand_turned_robot import read_robot_file
from snakesim_testing.runs.jogged_robot import (
    BACKEND,
    is_at_fault,
    make_jogged_folder,
    read_setpoints,
)

pytestmark = pytest.mark.e2e
REAL = ("bench.toml", "--backend", "./real.py:Real", "--unchecked")
RUN = (*REAL, "--stay", "--duration", "36000", "--console", "--no-record")
FORWARDS = "Hold: forwards (+)"
HOLD_RATE_HZ = 20.0
MIN_MOTION_RAD = 0.04
HALF_SECOND_TICKS = 25
STALLED_MESSAGE_COUNT = 40
RELEASE_S = 0.6  # longer than the maximum age of a held button


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """Make a folder with a real robot whose joints were never checked."""
    return make_checked_folder(tmp_path)


@pytest.fixture
def bench(tmp_path: Path) -> Path:
    """Make a folder with a robot whose setpoints are written into a file."""
    return make_jogged_folder(tmp_path)


def test_console_arms_unchecked_robot_only_after_explicit_confirmation(home: Path) -> None:
    with running_snakesim(home / "run", *RUN) as run:
        asyncio.run(asyncio.wait_for(arm_unchecked(run.console()), 2 * LIMIT_S))


async def arm_unchecked(address: str) -> None:
    """Disarm the robot, and arm it again as a viewer who confirms that it is unchecked."""
    async with connect_viewer(address) as socket:
        viewer = ConsoleViewer(socket)
        await viewer.register_as_viewer()
        viewer_task = asyncio.create_task(viewer.receive_until_closed())
        await wait_for_condition(
            lambda: viewer.shows_text("armed by snakesim run"), "an armed robot"
        )
        await viewer.click("Take control")
        await wait_for_condition(lambda: viewer.has_label("Release control"), "control")
        await viewer.choose("Robot", "Disarm")
        await wait_for_condition(lambda: viewer.shows_text(">DISARMED<"), "a disarmed robot")
        await viewer.click("Arm it unchecked")  # has no effect before a refusal
        await viewer.choose("Robot", "Arm")
        await wait_for_condition(lambda: viewer.is_visible("Arm it unchecked"), "the confirmation")
        assert viewer.shows_text("its joints have not been checked against its file")
        assert viewer.shows_text(">DISARMED<")
        await viewer.click("Arm it unchecked")
        await wait_for_condition(
            lambda: viewer.shows_text(", unchecked, commanded by control"),
            "a robot that was armed unchecked",
        )
        await wait_for_condition(
            lambda: not viewer.is_visible("Arm it unchecked"), "the end of the offer"
        )
        viewer_task.cancel()


@contextmanager
def running_commissioning_console(home: Path, endpoint: str) -> Iterator[str]:
    """Run a console that may write into the robot file, and yield its address."""
    with run_in_background(
        home, "console", "--endpoint", endpoint, "--commission", "snake.toml"
    ) as process:
        assert process.stdout is not None
        yield process.stdout.readline().split()[1]


@pytest.mark.quiet
def test_console_sets_zeros_and_jogs_while_button_is_held(bench: Path) -> None:
    with (
        running_bench_host(bench, BACKEND) as endpoint,
        running_commissioning_console(bench, endpoint) as address,
    ):
        asyncio.run(asyncio.wait_for(commission(address, bench), 3 * LIMIT_S))


async def commission(address: str, home: Path) -> None:
    """Set the zeros and jog joint_2 as a viewer whose network can stall, then close the page."""
    parts = urlsplit(address)
    assert parts.hostname is not None and parts.port is not None
    async with (
        StallingRelay(parts.hostname, parts.port) as relay,
        connect_viewer(f"http://127.0.0.1:{relay.port}{parts.path}") as socket,
    ):
        viewer = ConsoleViewer(socket)
        await viewer.register_as_viewer()
        viewer_task = asyncio.create_task(viewer.receive_until_closed())
        await wait_for_condition(
            lambda: viewer.shows_text("not checked: its joints have not been checked"), "the table"
        )
        await wait_for_condition(lambda: viewer.shows_text("id 2"), "the table")
        await wait_for_condition(
            lambda: viewer.has_label("Start step"), "the controls of the viewer"
        )
        await viewer.click("Start step")  # has no effect without control
        await viewer.click("Take control")
        await wait_for_condition(lambda: viewer.has_label("Release control"), "control")
        assert not viewer.shows_text("data-step")

        await viewer.choose("Step", "zero")
        await viewer.click("Start step")
        await wait_for_condition(
            lambda: viewer.shows_text("Lay the robot straight"), "the command's question"
        )
        assert "straight pose" not in (home / "snake.toml").read_text()
        await viewer.click("Enter")
        await wait_for_condition(
            lambda: viewer.shows_text("4 joints changed; restart the host with it"),
            "the end of the step",
        )
        assert "straight pose, " in (home / "snake.toml").read_text()
        assert read_robot_file(home).joint_table[0].drive.zero_rad == pytest.approx(0.0, abs=1e-3)

        await viewer.choose("Step", "jog")
        assert await jog_and_release_button(viewer, relay, home)
        await start_jog(viewer, home)
    await viewer_task  # The page is closed.
    await wait_for_condition(
        lambda: read_setpoints(home)["lifecycle"] != "armed",
        "the end of a step whose viewer has left",
    )


async def start_jog(viewer: ConsoleViewer, home: Path) -> None:
    """Start to jog joint_2, which arms the robot."""
    await wait_for_condition(
        lambda: viewer.shows_text("<div>done") or viewer.shows_text("<div>ended"),
        "the end of the step before",
    )
    await viewer.choose("Joint (0: all)", 2)
    await viewer.click("Start step")
    await wait_for_condition(
        lambda: viewer.shows_text("<div>joint_2: from -0.2"), "a joint that may be moved"
    )
    await wait_for_condition(
        lambda: read_setpoints(home)["lifecycle"] != "disarmed", "an armed robot"
    )


async def jog_and_release_button(viewer: ConsoleViewer, relay: StallingRelay, home: Path) -> bool:
    """Hold the button and release it, then do the same while the network stalls.

    The joint must move only while the button is held, and not after delayed messages.

    Returns:
        False if a fault stopped the robot.
    """
    await start_jog(viewer, home)
    await wait_for_condition(
        lambda: is_at_fault(home) or read_setpoints(home)["mode"] == [0, 1, 0, 0],
        "one joint with current",
    )
    initial_rad = read_setpoints(home)["target"][1]
    hold_message = {
        "type": "GuiButtonHoldMessage",
        "uuid": await viewer.wait_for_uuid(FORWARDS),
        "frequency": HOLD_RATE_HZ,
    }
    while (
        not is_at_fault(home) and read_setpoints(home)["target"][1] < initial_rad + MIN_MOTION_RAD
    ):
        await viewer.send_message(hold_message)
        await asyncio.sleep(1 / HOLD_RATE_HZ)
    await wait_for_ticks(home, HALF_SECOND_TICKS)
    released = read_setpoints(home)
    await wait_for_ticks(home, HALF_SECOND_TICKS)
    if is_at_fault(home):
        return False
    assert read_setpoints(home)["target"][1] == released["target"][1]
    relay.stall()
    for _ in range(STALLED_MESSAGE_COUNT):
        await viewer.send_message(hold_message)
        await asyncio.sleep(1 / HOLD_RATE_HZ)
    await asyncio.sleep(RELEASE_S)  # The network recovers only after the release of the button.
    relay.go_on()
    await wait_for_ticks(home, 2 * HALF_SECOND_TICKS)
    if is_at_fault(home):
        return False
    assert read_setpoints(home)["target"][1] == released["target"][1], (
        "delayed messages moved the joint"
    )
    await viewer.click("End step")
    await wait_for_condition(lambda: viewer.shows_text("<div>done"), "the end of the step")
    await wait_for_condition(
        lambda: read_setpoints(home)["lifecycle"] == "disarmed", "a robot without current"
    )
    return True


async def wait_for_ticks(home: Path, count: int) -> None:
    """Wait until the robot has made more than a number of ticks."""
    start_tick = read_setpoints(home)["tick"]
    await wait_for_condition(
        lambda: read_setpoints(home)["tick"] > start_tick + count, f"{count} ticks"
    )
