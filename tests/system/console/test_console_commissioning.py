"""Commissioning in the console of a real robot, by what a page says and is shown: without a browser."""

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
FORWARDS, HOLD_HZ = "Hold: forwards (+)", 20.0
HELD_IN_STALL, LIFTED_S = 40, 0.6  # messages, and more than a held button may be old


@pytest.fixture
def home(tmp_path: Path) -> Path:
    return make_checked_folder(tmp_path)


@pytest.fixture
def bench(tmp_path: Path) -> Path:
    return make_jogged_folder(tmp_path)


def test_console_arms_unchecked_robot_only_by_explicit_confirmation(home: Path) -> None:
    with running_snakesim(home / "run", *RUN) as run:
        asyncio.run(asyncio.wait_for(arm_unchecked(run.console()), 2 * LIMIT_S))


async def arm_unchecked(address: str) -> None:
    async with connect_viewer(address) as socket:
        viewer = ConsoleViewer(socket)
        await viewer.register_as_viewer()
        watching = asyncio.create_task(viewer.receive_until_closed())
        await wait_for_condition(
            lambda: viewer.shows_text("armed by snakesim run"), "an armed robot"
        )
        await viewer.click("Take control")
        await wait_for_condition(lambda: viewer.has_label("Release control"), "control")
        await viewer.choose("Robot", "Disarm")
        await wait_for_condition(lambda: viewer.shows_text(">DISARMED<"), "a disarmed robot")
        await viewer.click("Arm it unchecked")  # nothing has been asked and refused yet
        await viewer.choose("Robot", "Arm")
        await wait_for_condition(lambda: viewer.is_visible("Arm it unchecked"), "the word")
        assert viewer.shows_text("its joints have not been checked against its file")
        assert viewer.shows_text(">DISARMED<")
        await viewer.click("Arm it unchecked")
        await wait_for_condition(
            lambda: viewer.shows_text(", unchecked, commanded by control"),
            "a robot armed by the word",
        )
        await wait_for_condition(
            lambda: not viewer.is_visible("Arm it unchecked"), "the end of the offer"
        )
        watching.cancel()


@contextmanager
def console(home: Path, endpoint: str) -> Iterator[str]:
    """The address of one that may write into the robot file."""
    with run_in_background(
        home, "console", "--endpoint", endpoint, "--commission", "snake.toml"
    ) as process:
        assert process.stdout is not None
        yield process.stdout.readline().split()[1]


@pytest.mark.quiet
def test_console_sets_zeros_and_jogs_while_button_is_held(bench: Path) -> None:
    with running_bench_host(bench, BACKEND) as endpoint, console(bench, endpoint) as address:
        asyncio.run(asyncio.wait_for(commission(address, bench, endpoint), 3 * LIMIT_S))


async def commission(address: str, home: Path, endpoint: str) -> None:
    parts = urlsplit(address)
    assert parts.hostname is not None and parts.port is not None
    async with (
        StallingRelay(parts.hostname, parts.port) as relay,
        connect_viewer(f"http://127.0.0.1:{relay.port}{parts.path}") as socket,
    ):
        viewer = ConsoleViewer(socket)
        await viewer.register_as_viewer()
        watching = asyncio.create_task(viewer.receive_until_closed())
        await wait_for_condition(
            lambda: viewer.shows_text("not checked: its joints have not been checked"), "the table"
        )
        await wait_for_condition(lambda: viewer.shows_text("id 2"), "the table")
        await wait_for_condition(
            lambda: viewer.has_label("Start step"), "the controls of the viewer"
        )
        await viewer.click("Start step")  # of somebody who has no control
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
            lambda: viewer.shows_text("4 joints changed; restart the host with it"), "its end"
        )
        assert "straight pose, " in (home / "snake.toml").read_text()
        assert read_robot_file(home).joint_table[0].drive.zero_rad == pytest.approx(0.0, abs=1e-3)

        await viewer.choose("Step", "jog")
        assert await moved_and_stood(viewer, relay, home)
        await armed(viewer, home)
    await watching  # the page is closed
    await wait_for_condition(
        lambda: read_setpoints(home)["lifecycle"] != "armed",
        "the end of a step whose viewer has left",
    )


async def armed(viewer: ConsoleViewer, home: Path) -> None:
    """Jog joint_2, which arms the robot."""
    await wait_for_condition(
        lambda: viewer.shows_text("<div>done") or viewer.shows_text("<div>ended"),
        "the end of the step before",
    )
    await viewer.choose("Joint (0: all)", 2)
    await viewer.click("Start step")
    await wait_for_condition(
        lambda: viewer.shows_text("<div>joint_2: from -0.2"), "a joint that may be moved"
    )
    await wait_for_condition(lambda: read_setpoints(home)["lifecycle"] != "disarmed", "armed")


async def moved_and_stood(viewer: ConsoleViewer, relay: StallingRelay, home: Path) -> bool:
    """Hold the button, let it go, also while the network stalls; False when the robot was stopped meanwhile."""
    await armed(viewer, home)
    await wait_for_condition(
        lambda: is_at_fault(home) or read_setpoints(home)["mode"] == [0, 1, 0, 0],
        "one joint with current",
    )
    before = read_setpoints(home)["target"][1]
    held = {
        "type": "GuiButtonHoldMessage",
        "uuid": await viewer.wait_for_uuid(FORWARDS),
        "frequency": HOLD_HZ,
    }
    while not is_at_fault(home) and read_setpoints(home)["target"][1] < before + 0.04:
        await viewer.send_message(held)
        await asyncio.sleep(1 / HOLD_HZ)
    await ticks(home, 25)
    half = read_setpoints(home)
    await ticks(home, 25)
    if is_at_fault(home):
        return False
    assert read_setpoints(home)["target"][1] == half["target"][1]
    relay.stall()
    for _ in range(HELD_IN_STALL):
        await viewer.send_message(held)
        await asyncio.sleep(1 / HOLD_HZ)
    await asyncio.sleep(LIFTED_S)  # the finger is lifted, and only then does the network recover
    relay.go_on()
    await ticks(home, 50)
    if is_at_fault(home):
        return False
    assert read_setpoints(home)["target"][1] == half["target"][1], (
        "moved by what was held before the finger was lifted"
    )
    await viewer.click("End step")
    await wait_for_condition(lambda: viewer.shows_text("<div>done"), "its end")
    await wait_for_condition(
        lambda: read_setpoints(home)["lifecycle"] == "disarmed", "a robot without current"
    )
    return True


async def ticks(home: Path, count: int) -> None:
    """Of the robot's."""
    since = read_setpoints(home)["tick"]
    await wait_for_condition(lambda: read_setpoints(home)["tick"] > since + count, f"{count} ticks")
