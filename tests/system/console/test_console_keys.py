"""A viewer's keys at the console of a run: they drive the robot, and stop it. Without a browser, so in CI too."""

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
REPEAT_S = 0.04  # of a held key
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


def test_keys_drive_a_lost_page_stands_still_and_another_stops(tmp_path: Path) -> None:
    with running_snakesim(tmp_path / "run", *RUN) as run:
        asyncio.run(asyncio.wait_for(drive_and_stop(run.console(), run.endpoint), 2 * LIMIT_S))


async def drive_and_stop(address: str, endpoint: str) -> None:
    async with connect_viewer(address) as others:
        other = ConsoleViewer(others)
        await other.register_as_viewer()
        watching = asyncio.create_task(other.receive_until_closed())
        await wait_for_condition(
            lambda: other.shows_text("armed by snakesim run"), "an armed robot"
        )
        with open_session(ConnectionSettings(endpoint, "planar13")) as session:
            intents, paths = (
                session.declare_reader(keys.INTENT, LocomotionIntent),
                session.declare_reader(keys.TRAJECTORY, Trajectory),
            )
            status = session.declare_latched_reader(keys.STATUS, RobotStatus)
            async with connect_viewer(address) as mine:
                driver = ConsoleViewer(mine)
                await driver.register_as_viewer()
                driving = asyncio.create_task(driver.receive_until_closed())
                await wait_for_condition(lambda: driver.has_label("Take control"), "the controls")
                await driver.trigger("Drive: ahead")  # of somebody who has no control
                await driver.click("Take control")
                await wait_for_condition(lambda: driver.has_label("Release control"), "control")
                await hold(
                    driver,
                    "Drive: ahead",
                    lambda: any(path.reason for path in paths.drain()),
                    "who drives",
                )
                asked = intents.drain()
                assert asked
                assert all(
                    intent.requester == "viewer 2" and (intent.speed_m_s or 0) > 0
                    for intent in asked
                )
                before = asked[-1].heading_w_rad
                assert before is not None
                await driver.trigger("Drive: left")
                await hold(
                    driver,
                    "Drive: ahead",
                    lambda: any((i.heading_w_rad or 0) > before for i in intents.drain()),
                )
                await hold(
                    driver,
                    "Drive: backwards",
                    lambda: any((i.speed_m_s or 0) < 0 for i in intents.drain()),
                )
            await driving  # the page is closed while its key is held
            stopped = await wait_for_condition(
                lambda: paths.pop_newest(lambda path: path.speed_m_s == 0), "a robot told to stand"
            )
            assert "viewer 2" in stopped.reason
            await wait_for_condition(
                lambda: other.shows_text("no viewer has control"), "the return of control"
            )
            await other.trigger("Emergency stop")
            await wait_for_condition(
                lambda: status.pop_newest(lambda one: one.lifecycle == "estop"), "the stop"
            )
            await wait_for_condition(lambda: other.shows_text(">ESTOP<"), "the stop on the page")
        watching.cancel()


async def hold(
    viewer: ConsoleViewer, key: str, done: Callable[[], bool], what: str = "an effect"
) -> None:
    """Hold a key, as its keyboard repeats it."""
    deadline = asyncio.get_running_loop().time() + LIMIT_S
    while not done():
        assert asyncio.get_running_loop().time() < deadline, f"not in time: {what} of {key!r}"
        await viewer.trigger(key)
        await asyncio.sleep(REPEAT_S)
