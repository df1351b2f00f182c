"""The console of a run, as people use it: in a browser."""

import time
from collections import deque
from pathlib import Path

import pytest

from snakesim_hal.network.session import Link, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ControlSettings, JointState, SettingsRequest
from tests.browser import CHROMIUM, MISSING, Tab, chromium
from tests.e2e.command import Running, nothing_left, running, wait_until

pytestmark = [pytest.mark.e2e, pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason=MISSING)]

STOP_LIMIT_S = 1.0  # from the key to joints at rest; on an idle machine it is a tenth of that
SMALL = 800, 400, 0.25  # width, height, pixels a dot: the browser draws without a graphics card here


def address_of(run: Running) -> str:
    run.wait_for("console: http")
    return next(line.split()[1] for line in run.said().splitlines() if line.startswith("console: "))


def fastest_rad_s(joints: JointState) -> float:
    return max(abs(speed) for speed in joints.velocity_rad_s)


def test_it_shows_the_run_and_anybody_stops_it_but_one_viewer_has_control(tmp_path: Path) -> None:
    arguments = ["triplet", "--controller", "lateral_undulation", "--duration", "600", "--stay", "--console"]
    with running(tmp_path / "run", *arguments) as run, chromium() as browser:
        address = address_of(run)
        first = browser.open(address, *SMALL)
        first.wait_for("Take control")
        second = browser.open(address, *SMALL)  # after the first, whose number is thus 1
        for tab in (first, second):
            tab.wait_for("SIMULATOR")
            tab.wait_for("Take control")
        first.wait_for("armed by snakesim run")
        first.click("Take control")
        second.wait_for("viewer 1 has control")
        second.click("Take control")  # greyed out
        first.wait_for("Release control")
        assert "Release control" not in second.text()
        first.click("Pause")
        second.wait_for("PAUSED")
        change_settings(run)
        first.click("Resume")
        wait_until(lambda: "PAUSED" not in second.text(), "the end of the pause")
        stopped_after_s = stop_in(second, run)
        assert stopped_after_s < STOP_LIMIT_S, f"{stopped_after_s:.2f} s"
        first.wait_for("ESTOP")
        first.click("Clear")
        first.wait_for("DISARMED")
        first.send("Page.navigate", url="about:blank")  # and control is free again
        second.wait_for("nobody has control")
        assert not first.errors and not second.errors, first.errors + second.errors
        run.process.terminate()
        run.end()
    nothing_left(tmp_path / "run")


def change_settings(run: Running) -> None:
    """Of the controller, while it runs: a bad value is refused with the usual words."""
    with open_session(Link(run.endpoint, "planar13")) as session:
        for value, taken in ((-1, False), (0.4, True)):
            settings = f'{{"amplitude_rad": {value}}}'
            request = SettingsRequest(who="ada", controller="lateral_undulation", settings=settings)
            answer = session.ask(keys.SETTINGS, request, 10.0)
            assert answer.ok == taken, answer.reason
        in_force = session.latest(keys.SETTINGS_IN_FORCE, ControlSettings, 10.0)
        assert in_force is not None and '"amplitude_rad":0.4' in in_force.settings and in_force.who == "ada"


def stop_in(tab: Tab, run: Running) -> float:
    """Press the emergency stop's key in a page; seconds until all joints are at rest."""
    with open_session(Link(run.endpoint, "planar13")) as session:
        joints = session.reader(keys.JOINTS, JointState)
        wait_until(lambda: any(fastest_rad_s(one) > 0.05 for one in joints.drain()), "moving joints")
        tab.press("Escape", 27)
        pressed_s, recent = time.monotonic(), deque[float](maxlen=5)
        while len(recent) < 5 or max(recent) > 0.02:
            assert time.monotonic() < pressed_s + 30, f"joints still move: {list(recent)} rad/s"
            recent += [fastest_rad_s(one) for one in joints.drain()]
            time.sleep(0.005)
        return time.monotonic() - pressed_s
