"""A viewer drives and stops the robot with the keys of the console. The test needs no browser."""

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest

from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import LocomotionIntent, RobotStatus, Trajectory
from snakesim_testing.operator.console_wait import LIMIT_S, wait_for_condition
from snakesim_testing.operator.viewer import ConsoleViewer, connect_viewer
from snakesim_testing.runs.command import running_snakesim

pytestmark = pytest.mark.e2e
REPEAT_S = 0.04  # between repetitions of a held key
RUN = (
    "peg_row",
    "--clock-mode",
    "realtime",
    "--duration",
    "600",
    "--stay",
    "--console",
    "--no-record",
)


def test_console_keys_drive_and_stop_the_robot(tmp_path: Path) -> None:
    with running_snakesim(tmp_path / "run", *RUN) as run:
        asyncio.run(asyncio.wait_for(drive_and_stop(run.console(), run.endpoint), 2 * LIMIT_S))


async def drive_and_stop(address: str, endpoint: str) -> None:
    """Drive as one viewer, close its page while a key is held, and stop as another viewer."""
    async with connect_viewer(address) as other_socket:
        other = ConsoleViewer(other_socket)
        await other.register_as_viewer()
        other_task = asyncio.create_task(other.receive_until_closed())
        await wait_for_condition(
            lambda: other.shows_text("armed by snakesim run"), "an armed robot"
        )
        with open_session(ConnectionSettings(endpoint, "planar13")) as session:
            intents = session.declare_reader(keys.INTENT, LocomotionIntent)
            paths = session.declare_reader(keys.TRAJECTORY, Trajectory)
            status = session.declare_latched_reader(keys.STATUS, RobotStatus)
            async with connect_viewer(address) as driver_socket:
                driver = ConsoleViewer(driver_socket)
                await driver.register_as_viewer()
                driver_task = asyncio.create_task(driver.receive_until_closed())
                await wait_for_condition(lambda: driver.has_label("Take control"), "the controls")
                await driver.trigger("Drive: ahead")  # has no effect without control
                await driver.click("Take control")
                await wait_for_condition(lambda: driver.has_label("Release control"), "control")
                await hold_key(
                    driver,
                    "Drive: ahead",
                    lambda: any(path.reason for path in paths.drain()),
                    "a requester",
                )
                requested = intents.drain()
                assert requested
                assert all(intent.requester == "viewer 2" for intent in requested)
                assert all((intent.speed_m_s or 0) > 0 for intent in requested)
                heading_before_rad = requested[-1].heading_w_rad
                assert heading_before_rad is not None
                await driver.trigger("Drive: left")
                await hold_key(
                    driver,
                    "Drive: ahead",
                    lambda: any(
                        (intent.heading_w_rad or 0) > heading_before_rad
                        for intent in intents.drain()
                    ),
                )
                await hold_key(
                    driver,
                    "Drive: backwards",
                    lambda: any((intent.speed_m_s or 0) < 0 for intent in intents.drain()),
                )
            await driver_task  # The page was closed while its key was held.
            stopped = await wait_for_condition(
                lambda: paths.pop_newest(lambda path: path.speed_m_s == 0), "a path with speed 0"
            )
            assert "viewer 2" in stopped.reason
            await wait_for_condition(
                lambda: other.shows_text("no viewer has control"), "the return of control"
            )
            await other.trigger("Emergency stop")
            await wait_for_condition(
                lambda: status.pop_newest(lambda newest: newest.lifecycle == "estop"), "the stop"
            )
            await wait_for_condition(lambda: other.shows_text(">ESTOP<"), "the stop on the page")
        other_task.cancel()


async def hold_key(
    viewer: ConsoleViewer, key: str, is_done: Callable[[], bool], awaited: str = "an effect"
) -> None:
    """Repeat a key, as a keyboard does, until its effect is there."""
    deadline_s = asyncio.get_running_loop().time() + LIMIT_S
    while not is_done():
        assert asyncio.get_running_loop().time() < deadline_s, f"not in time: {awaited} of {key!r}"
        await viewer.trigger(key)
        await asyncio.sleep(REPEAT_S)
