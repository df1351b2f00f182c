"""Commissioning in the console of a real robot, by what a page says and is shown: without a browser."""

import asyncio
from pathlib import Path

import pytest

from snakesim_hal.model.files import SHIPPED
from tests.e2e.command import running
from tests.e2e.test_checked import JOINTS, REAL, SCENARIO
from tests.e2e.test_console_keys import LIMIT_S, until
from tests.viewer import Viewer, viewing

pytestmark = pytest.mark.e2e
RUN = (
    "bench.toml",
    "--backend",
    "./real.py:Real",
    "--unchecked",
    "--stay",
    "--duration",
    "36000",
    "--console",
    "--no-record",
)


@pytest.fixture
def home(tmp_path: Path) -> Path:
    shipped = (SHIPPED / "robots" / "planar13.toml").read_text()
    (tmp_path / "snake.toml").write_text(shipped.replace("modules = 13", f"modules = {JOINTS}"))
    (tmp_path / "bench.toml").write_text(SCENARIO)
    (tmp_path / "real.py").write_text(REAL)
    (tmp_path / "serials").write_text("A1 B2 C3")
    return tmp_path


def test_a_robot_that_nobody_checked_is_armed_by_the_page_by_an_explicit_word(home: Path) -> None:
    with running(home / "run", *RUN) as run:
        asyncio.run(asyncio.wait_for(arm_unchecked(run.console()), 2 * LIMIT_S))


async def arm_unchecked(address: str) -> None:
    async with viewing(address) as socket:
        viewer = Viewer(socket)
        await viewer.come()
        watching = asyncio.create_task(viewer.watch())
        await until(lambda: viewer.shows("armed by snakesim run"), "an armed robot")
        await viewer.click("Take control")
        await until(lambda: viewer.has("Release control"), "control")
        await viewer.choose("Robot", "Disarm")
        await until(lambda: viewer.shows(">DISARMED<"), "a disarmed robot")
        await viewer.click("Arm it unchecked")  # nothing has been asked and refused yet
        await viewer.choose("Robot", "Arm")
        await until(lambda: viewer.visible("Arm it unchecked"), "the word")
        assert viewer.shows("nobody has checked that its joints are as its file says") and viewer.shows(">DISARMED<")
        await viewer.click("Arm it unchecked")
        await until(lambda: viewer.shows(", unchecked, commanded by control"), "a robot armed by the word")
        await until(lambda: not viewer.visible("Arm it unchecked"), "the end of the offer")
        watching.cancel()
