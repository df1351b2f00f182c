"""The console of a run, as people use it: in a browser."""

import os
import signal
import time
from collections import deque
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from snakesim_hal.model.scenario import load_scenario
from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ControlParameters, JointState, RobotStatus
from snakesim_operator.features.console.operations import PageLog, RobotOperations
from snakesim_operator.features.console.page.page import ConsolePage
from snakesim_operator.features.console.robot_data.snapshot import make_expected_snapshot
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.page import origin_of
from snakesim_testing.harness.processes import assert_no_process_left, find_processes_with
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.operator.browser import BROWSER_MISSING, CHROMIUM, BrowserTab, open_chromium
from snakesim_testing.operator.ready_stop import ReadyStop
from snakesim_testing.operator.served_console import running_console
from snakesim_testing.runs.command import RunningCommand, running_snakesim

pytestmark = [pytest.mark.e2e, pytest.mark.skipif(CHROMIUM is None, reason=BROWSER_MISSING)]

RUN = (
    *(
        "triplet",
        "--controller",
        "lateral_undulation",
        "--clock-mode",
        "realtime",
        "--set",
        "rate_hz=50",
    ),
    *("--duration", "600", "--stay", "--console"),
)
STOP_LIMIT_S = 10.0  # from the key to motors that are off: far above what it takes when no other tests run beside
SILENT = "THE STOP DOES NOT ANSWER"
COAST_LIMIT_S = 2.0  # of robot time, until joints without torque are at rest
# Width, height, pixels a dot: the browser draws without a graphics card here.
SMALL = 800, 400, 0.25
LOOK = "document.documentElement.dataset.mantineColorScheme"
STATE_TOP = "document.querySelector('[data-robot]').getBoundingClientRect().top"
PANEL_WIDTHS = (
    "(panel => [panel.scrollWidth, "
    "panel.clientWidth])(document.querySelector('[class*=ScrollArea-viewport]'))"
)
HIDE = "Object.defineProperty(document, 'hidden', {value: true}); document.dispatchEvent(new Event('visibilitychange'))"
# Of the page: scene without notices.
GROUND = {"x": 0, "y": 200, "width": 370, "height": 200, "scale": 1}


def fastest_rad_s(joints: JointState) -> float:
    return max(abs(speed) for speed in joints.velocity_rad_s)


@pytest.mark.quiet
def test_console_page_shows_moving_snake_and_escape_stops_it(tmp_path: Path) -> None:
    with open_chromium() as browser, running_snakesim(tmp_path / "run", *RUN) as run:
        began_s = time.monotonic()
        address = run.console()
        told_after_s = time.monotonic() - began_s
        page = browser.open_page(address, *SMALL)
        page.wait_for("planar13")
        drawn_after_s = time.monotonic() - began_s
        page.wait_for("SIMULATOR")
        live_after_s = time.monotonic() - began_s
        page.wait_for("armed by snakesim run")
        before = page.capture_screenshot(clip=GROUND)
        wait_until(
            lambda: page.capture_screenshot(clip=GROUND) != before, "a snake that moves on the page"
        )
        stopped_after_s = stop_in(page, run)
        assert stopped_after_s < STOP_LIMIT_S, f"{stopped_after_s:.2f} s"
        print(
            f"address after {told_after_s:.1f} s, robot on the page after {drawn_after_s:.1f} s and live after "
            f"{live_after_s:.1f} s, motors off {stopped_after_s:.2f} s after the key"
        )
        page.wait_for("ESTOP")
        page.evaluate(
            "document.querySelectorAll('[class*=ScrollArea-viewport]').forEach(e => { e.scrollTop = 300; })"
        )
        assert page.evaluate(STATE_TOP) >= 0  # in sight all the same
        # On a busy computer the second stop may report for a moment that its self-test is late (503).
        assert not [error for error in page.errors if not error.endswith("/stop")], page.errors


STOP_BOX = "document.querySelector('#second-stop').getBoundingClientRect()"
NOTICE_BOX = "document.querySelector('[class*=Notification-root]').getBoundingClientRect()"
TAB_LINES = "new Set([...document.querySelectorAll('[role=tab]')].map(tab => tab.offsetTop)).size"


def test_console_page_follows_dark_mode_and_releases_button_on_leave() -> None:
    """Dark until the viewer chooses; left when it loses the keyboard, or is hidden."""
    with running_console(ReadyStop()) as (server, address), open_chromium() as browser:
        ConsolePage(server, None, None, PageLog(), recorded="a run")
        page = browser.open_page("about:blank", *SMALL)
        for prefers in ("light", "dark"):
            page.send(
                "Emulation.setEmulatedMedia",
                features=[{"name": "prefers-color-scheme", "value": prefers}],
            )
            page.send("Page.navigate", url=address)
            page.wait_for("Dark page")
            wait_until(lambda prefers=prefers: page.evaluate(LOOK) == prefers, f"a {prefers} page")
        page.click("Dark page")
        wait_until(lambda: page.evaluate(LOOK) == "light", "the viewer's choice")
        page.evaluate("window.ends = 0; addEventListener('pointercancel', () => { ends += 1; })")
        for count, leave in enumerate(("window.dispatchEvent(new Event('blur'))", HIDE), start=1):
            page.evaluate(
                "document.body.dispatchEvent(new PointerEvent('pointerdown', {bubbles: true}))"
            )
            page.evaluate(leave)
            assert page.evaluate("ends") == count


@pytest.mark.slow
def test_console_page_on_phone_fits_and_keeps_stop_visible() -> None:
    """And a wide screen shows the tabs in one line."""
    config, log = load_scenario("triplet").config, PageLog()
    with running_console(ReadyStop()) as (server, address), open_chromium() as browser:
        ConsolePage(
            server,
            None,
            RobotOperations(ConnectionSettings(find_free_endpoint(), "planar13"), log),
            log,
        ).show_snapshot(make_expected_snapshot(config))
        page = browser.open_page(address, 400, 800, 0.5)
        page.wait_for("planar13")
        for tab in ("Joints", "State", "Signals", "Log"):
            page.click(tab)
            wait_until(
                lambda: page.evaluate(PANEL_WIDTHS) == [400, 400],
                f"a panel as wide as the phone in tab {tab}",
            )
        # On a busy computer the stop may report for a moment that it does not answer; then its box is higher.
        wait_until(lambda: page.evaluate(f"{STOP_BOX}.bottom") < 100, "a second stop at the top")
        page.wait_for("Stops the robot even if EMERGENCY STOP does not react. Self-test: ready")
        assert page.evaluate(f"{NOTICE_BOX}.top > {STOP_BOX}.bottom"), (
            "a notice, such as of missing WebGL, is not covered"
        )
        page.set_window_size(1400, 860)
        wait_until(lambda: page.evaluate(TAB_LINES) == 1, "tabs in one line")


@pytest.mark.slow
def test_page_needs_token_and_stops_robot_without_page_process(tmp_path: Path) -> None:
    """On the page of the signals, which has the second stop and draws no scene."""
    with open_chromium() as browser, running_snakesim(tmp_path / "run", *RUN) as run:
        address = run.console()
        origin = origin_of(address)
        port = origin.rpartition(":")[2]
        for wrong in (f"{origin}/", f"{origin}/signals", f"{origin}/{'x' * 22}/"):
            browser.open_page(wrong, *SMALL).wait_for("open the address that the console printed")
        evil = browser.open_page("data:text/html,<title>another site</title>", *SMALL)
        evil.evaluate(
            ANOTHER_SITE.format(
                page=address.replace("http", "ws").rstrip("/"), stop=f"{address}stop"
            )
        )
        wait_until(
            lambda: evil.evaluate("[opened, posted]") == [False, True], "what another site may do"
        )
        page = browser.open_page(f"http://localhost:{port}{urlsplit(address).path}signals", *SMALL)
        page.wait_for("Self-test: ready")
        assert SILENT not in page.read_text()
        with open_session(ConnectionSettings(run.endpoint, "planar13")) as session:
            status = session.wait_for_latched(keys.STATUS, RobotStatus, 10.0)
            assert status is not None and status.lifecycle != "estop", (
                "another site has stopped the robot"
            )
            front = console_process(run, ".front")
            os.kill(front, signal.SIGSTOP)
            try:
                page.wait_for(SILENT)
            finally:
                os.kill(front, signal.SIGCONT)
            wait_until(lambda: SILENT not in page.read_text(), "a second stop that answers")
            pages = console_process(run)
            os.kill(pages, signal.SIGSTOP)
            try:
                page.click("SECOND STOP")
                page.wait_for("planar13: stopped")
            finally:
                os.kill(pages, signal.SIGCONT)
            assert (
                session.wait_for_latched(
                    keys.STATUS, RobotStatus, 10.0, lambda one: one.lifecycle == "estop"
                )
                is not None
            )


# What another site tries, if it knows the token.
ANOTHER_SITE = """
  var opened = null, posted = false;
  const socket = new WebSocket("{page}");
  socket.onopen = () => {{ opened = true; }};
  socket.onerror = () => {{ opened = false; }};
  fetch("{stop}", {{method: "POST", mode: "no-cors"}}).catch(() => null).then(() => {{ posted = true; }});
"""


def console_process(run: RunningCommand, part: str = "") -> int:
    """Return the process id of the pages, or of the front server."""
    found = find_processes_with("cmdline", f"snakesim_operator.features.console{part}\0")
    return next(pid for pid, line in found if f"\0{run.endpoint}\0" in line)


@pytest.mark.slow
def test_one_viewer_has_control_and_anybody_stops_it(tmp_path: Path) -> None:
    with open_chromium() as browser, running_snakesim(tmp_path / "run", *RUN) as run:
        address = run.console()
        first = browser.open_page(address, *SMALL)
        first.wait_for("Take control")
        second = browser.open_page(address, *SMALL)  # after the first, whose number is thus 1
        for tab in (first, second):
            tab.wait_for("armed by snakesim run")
            tab.wait_for("Take control")
        first.click("Take control")
        second.wait_for("viewer 1 has control")
        second.click("Take control")  # greyed out
        first.wait_for("Release control")
        assert "Release control" not in second.read_text()
        first.click("Pause")
        second.wait_for("PAUSED")
        change_settings(first, run)
        first.click("Resume")
        wait_until(lambda: "PAUSED" not in second.read_text(), "the end of the pause")
        # No limit: two pages drawn without a graphics card take seconds for a key.
        stop_in(second, run)
        first.wait_for("ESTOP")
        first.click("Reset fault")
        first.wait_for("DISARMED")
        first.send("Page.navigate", url="about:blank")  # and control is free again
        second.wait_for("no viewer has control")
        assert not first.errors and not second.errors, first.errors + second.errors
        run.process.terminate()
        run.end()
    assert_no_process_left(tmp_path / "run")


def change_settings(tab: BrowserTab, run: RunningCommand) -> None:
    """Of the controller, while it runs, by typing one into the page."""
    tab.click("Parameters")
    tab.wait_for("amplitude_rad, rad")
    tab.enter_text("amplitude_rad, rad", "0.4")
    tab.click("Apply")
    with open_session(ConnectionSettings(run.endpoint, "planar13")) as session:
        in_force = session.wait_for_latched(
            keys.PARAMETERS_IN_FORCE,
            ControlParameters,
            10.0,
            lambda one: one.requester == "viewer 1",
        )
    assert in_force is not None
    assert '"amplitude_rad":0.4' in in_force.parameters


def stop_in(tab: BrowserTab, run: RunningCommand) -> float:
    """Press the emergency stop's key in a page; seconds until the motors are off. Then the joints coast to rest."""
    with open_session(ConnectionSettings(run.endpoint, "planar13")) as session:
        joints, status = (
            session.declare_reader(keys.JOINTS, JointState),
            session.declare_latched_reader(keys.STATUS, RobotStatus),
        )
        wait_until(
            lambda: any(fastest_rad_s(one) > 0.05 for one in joints.drain()), "moving joints"
        )
        pressed_s = time.monotonic()
        tab.press_key("Escape", 27)
        wait_until(
            lambda: status.pop_newest(lambda one: one.lifecycle == "estop") is not None, "the stop"
        )
        stopped_after_s = time.monotonic() - pressed_s
        joints.drain()
        from_ns, recent = None, deque[float](maxlen=5)
        while len(recent) < 5 or max(recent) > 0.02:
            for one in joints.drain():
                from_ns = one.timestamp_ns if from_ns is None else from_ns
                assert one.timestamp_ns < from_ns + COAST_LIMIT_S * 1e9, (
                    f"joints still move: {list(recent)} rad/s"
                )
                recent.append(fastest_rad_s(one))
            time.sleep(0.005)
    return stopped_after_s
