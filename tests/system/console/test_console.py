"""The console of a run shows, stops and controls the robot in a real browser."""

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
MAX_STOP_S = 10.0  # from the key to motors that are off, on a computer that runs other tests, too
UNANSWERED_STOP = "THE STOP DOES NOT ANSWER"
MAX_COAST_S = 2.0  # robot time until joints without torque are at rest
REST_SAMPLE_COUNT = 5  # consecutive samples of a robot at rest
REST_SPEED_RAD_S = 0.02
# Width, height and scale of a page that draws quickly without a graphics card.
SMALL_PAGE = 800, 400, 0.25
COLOR_SCHEME = "document.documentElement.dataset.mantineColorScheme"
STATE_TOP = "document.querySelector('[data-robot]').getBoundingClientRect().top"
PANEL_WIDTHS = (
    "(panel => [panel.scrollWidth, "
    "panel.clientWidth])(document.querySelector('[class*=ScrollArea-viewport]'))"
)
HIDE_PAGE = (
    "Object.defineProperty(document, 'hidden', {value: true}); "
    "document.dispatchEvent(new Event('visibilitychange'))"
)
# Part of the page that shows only the scene, without notices.
SCENE_CLIP = {"x": 0, "y": 200, "width": 370, "height": 200, "scale": 1}


def find_max_speed_rad_s(joints: JointState) -> float:
    """Return the speed of the fastest joint."""
    return max(abs(speed) for speed in joints.velocity_rad_s)


@pytest.mark.quiet
def test_console_page_shows_moving_snake_and_escape_stops_it(tmp_path: Path) -> None:
    with open_chromium() as browser, running_snakesim(tmp_path / "run", *RUN) as run:
        start_s = time.monotonic()
        address = run.console()
        address_after_s = time.monotonic() - start_s
        page = browser.open_page(address, *SMALL_PAGE)
        page.wait_for("planar13")
        drawn_after_s = time.monotonic() - start_s
        page.wait_for("SIMULATOR")
        live_after_s = time.monotonic() - start_s
        page.wait_for("armed by snakesim run")
        first_image = page.capture_screenshot(clip=SCENE_CLIP)
        wait_until(
            lambda: page.capture_screenshot(clip=SCENE_CLIP) != first_image,
            "a snake that moves on the page",
        )
        stopped_after_s = stop_with_escape(page, run)
        assert stopped_after_s < MAX_STOP_S, f"{stopped_after_s:.2f} s"
        print(
            f"address after {address_after_s:.1f} s, robot on the page after {drawn_after_s:.1f} s and live after "
            f"{live_after_s:.1f} s, motors off {stopped_after_s:.2f} s after the key"
        )
        page.wait_for("ESTOP")
        page.evaluate(
            "document.querySelectorAll('[class*=ScrollArea-viewport]').forEach(e => { e.scrollTop = 300; })"
        )
        assert page.evaluate(STATE_TOP) >= 0, "the state scrolled out of sight"
        # On a busy computer the second stop may report for a moment that its self-test is late (503).
        assert not [error for error in page.errors if not error.endswith("/stop")], page.errors


STOP_BOX = "document.querySelector('#second-stop').getBoundingClientRect()"
NOTICE_BOX = "document.querySelector('[class*=Notification-root]').getBoundingClientRect()"
TAB_LINES = "new Set([...document.querySelectorAll('[role=tab]')].map(tab => tab.offsetTop)).size"


def test_console_page_follows_dark_mode_and_releases_button_on_leave() -> None:
    """The page follows the browser until the viewer chooses a color scheme.

    A held button is released if the page loses the keyboard focus or is hidden.
    """
    with running_console(ReadyStop()) as (server, address), open_chromium() as browser:
        ConsolePage(server, None, None, PageLog(), recorded="a run")
        page = browser.open_page("about:blank", *SMALL_PAGE)
        for preference in ("light", "dark"):
            page.send(
                "Emulation.setEmulatedMedia",
                features=[{"name": "prefers-color-scheme", "value": preference}],
            )
            page.send("Page.navigate", url=address)
            page.wait_for("Dark page")
            wait_until(
                lambda preference=preference: page.evaluate(COLOR_SCHEME) == preference,
                f"a {preference} page",
            )
        page.click("Dark page")
        wait_until(lambda: page.evaluate(COLOR_SCHEME) == "light", "the viewer's choice")
        page.evaluate("window.ends = 0; addEventListener('pointercancel', () => { ends += 1; })")
        for count, leave in enumerate(
            ("window.dispatchEvent(new Event('blur'))", HIDE_PAGE), start=1
        ):
            page.evaluate(
                "document.body.dispatchEvent(new PointerEvent('pointerdown', {bubbles: true}))"
            )
            page.evaluate(leave)
            assert page.evaluate("ends") == count


@pytest.mark.slow
def test_console_page_on_phone_fits_and_keeps_stop_visible() -> None:
    """On a wide screen the tabs are in one line."""
    config = load_scenario("triplet").config
    log = PageLog()
    with running_console(ReadyStop()) as (server, address), open_chromium() as browser:
        connection = ConnectionSettings(find_free_endpoint(), "planar13")
        console_page = ConsolePage(server, None, RobotOperations(connection, log), log)
        console_page.show_snapshot(make_expected_snapshot(config))
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
            "the second stop covers a notice, such as that of missing WebGL"
        )
        page.set_window_size(1400, 860)
        wait_until(lambda: page.evaluate(TAB_LINES) == 1, "tabs in one line")


@pytest.mark.quiet
def test_page_needs_token_and_stops_robot_without_page_process(tmp_path: Path) -> None:
    """The page of the signals has the second stop, and draws no scene."""
    with open_chromium() as browser, running_snakesim(tmp_path / "run", *RUN) as run:
        address = run.console()
        origin = origin_of(address)
        port = origin.rpartition(":")[2]
        for wrong_address in (f"{origin}/", f"{origin}/signals", f"{origin}/{'x' * 22}/"):
            browser.open_page(wrong_address, *SMALL_PAGE).wait_for(
                "open the address that the console printed"
            )
        other_site = browser.open_page("data:text/html,<title>another site</title>", *SMALL_PAGE)
        other_site.evaluate(
            OTHER_SITE_SCRIPT.format(
                page=address.replace("http", "ws").rstrip("/"), stop=f"{address}stop"
            )
        )
        wait_until(
            lambda: other_site.evaluate("[opened, posted]") == [False, True],
            "the attempts of another site",
        )
        page = browser.open_page(
            f"http://localhost:{port}{urlsplit(address).path}signals", *SMALL_PAGE
        )
        page.wait_for("Self-test: ready")
        assert UNANSWERED_STOP not in page.read_text()
        with open_session(ConnectionSettings(run.endpoint, "planar13")) as session:
            status = session.wait_for_latched(keys.STATUS, RobotStatus, 10.0)
            assert status is not None
            assert status.lifecycle != "estop", "another site has stopped the robot"
            front_pid = find_console_process(run, ".front")
            os.kill(front_pid, signal.SIGSTOP)
            try:
                page.wait_for(UNANSWERED_STOP)
            finally:
                os.kill(front_pid, signal.SIGCONT)
            wait_until(
                lambda: UNANSWERED_STOP not in page.read_text(), "a second stop that answers"
            )
            page_pid = find_console_process(run)
            os.kill(page_pid, signal.SIGSTOP)
            try:
                page.click("SECOND STOP")
                page.wait_for("planar13: stopped")
            finally:
                os.kill(page_pid, signal.SIGCONT)
            stopped = session.wait_for_latched(
                keys.STATUS, RobotStatus, 10.0, lambda newest: newest.lifecycle == "estop"
            )
            assert stopped is not None


# Another site that knows the token tries to connect and to stop the robot.
OTHER_SITE_SCRIPT = """
  var opened = null, posted = false;
  const socket = new WebSocket("{page}");
  socket.onopen = () => {{ opened = true; }};
  socket.onerror = () => {{ opened = false; }};
  fetch("{stop}", {{method: "POST", mode: "no-cors"}}).catch(() => null).then(() => {{ posted = true; }});
"""


def find_console_process(run: RunningCommand, part: str = "") -> int:
    """Return the process id of the page server, or of the front server with part `.front`."""
    processes = find_processes_with("cmdline", f"snakesim_operator.features.console{part}\0")
    return next(pid for pid, line in processes if f"\0{run.endpoint}\0" in line)


@pytest.mark.quiet
def test_console_gives_control_to_one_viewer_and_stop_to_all(tmp_path: Path) -> None:
    with open_chromium() as browser, running_snakesim(tmp_path / "run", *RUN) as run:
        address = run.console()
        first = browser.open_page(address, *SMALL_PAGE)
        first.wait_for("Take control")
        second = browser.open_page(address, *SMALL_PAGE)  # The first page has viewer number 1.
        for tab in (first, second):
            tab.wait_for("armed by snakesim run")
            tab.wait_for("Take control")
        first.click("Take control")
        second.wait_for("viewer 1 has control")
        second.click("Take control")  # has no effect while viewer 1 has control
        first.wait_for("Release control")
        assert "Release control" not in second.read_text()
        first.click("Pause")
        second.wait_for("PAUSED")
        change_amplitude(first, run)
        first.click("Resume")
        wait_until(lambda: "PAUSED" not in second.read_text(), "the end of the pause")
        # There is no time limit, because two pages without a graphics card take seconds for a key.
        stop_with_escape(second, run)
        first.wait_for("ESTOP")
        first.click("Reset fault")
        first.wait_for("DISARMED")
        first.send("Page.navigate", url="about:blank")  # releases control
        second.wait_for("no viewer has control")
        assert not first.errors, first.errors
        assert not second.errors, second.errors
        run.process.terminate()
        run.end()
    assert_no_process_left(tmp_path / "run")


def change_amplitude(tab: BrowserTab, run: RunningCommand) -> None:
    """Change the amplitude of the running controller on the page, and wait until it is in force."""
    tab.click("Parameters")
    tab.wait_for("amplitude_rad, rad")
    tab.enter_text("amplitude_rad, rad", "0.4")
    tab.click("Apply")
    with open_session(ConnectionSettings(run.endpoint, "planar13")) as session:
        in_force = session.wait_for_latched(
            keys.PARAMETERS_IN_FORCE,
            ControlParameters,
            10.0,
            lambda newest: newest.requester == "viewer 1",
        )
    assert in_force is not None
    assert '"amplitude_rad":0.4' in in_force.parameters


def stop_with_escape(tab: BrowserTab, run: RunningCommand) -> float:
    """Press the key of the emergency stop in a page, and check that the joints coast to rest.

    Returns:
        Seconds from the key to motors that are off.
    """
    with open_session(ConnectionSettings(run.endpoint, "planar13")) as session:
        joints = session.declare_reader(keys.JOINTS, JointState)
        status = session.declare_latched_reader(keys.STATUS, RobotStatus)
        wait_until(
            lambda: any(find_max_speed_rad_s(state) > 0.05 for state in joints.drain()),
            "moving joints",
        )
        pressed_s = time.monotonic()
        tab.press_key("Escape", 27)
        wait_until(
            lambda: status.pop_newest(lambda newest: newest.lifecycle == "estop") is not None,
            "the stop",
        )
        stopped_after_s = time.monotonic() - pressed_s
        joints.drain()
        first_ns = None
        speeds_rad_s = deque[float](maxlen=REST_SAMPLE_COUNT)
        while len(speeds_rad_s) < REST_SAMPLE_COUNT or max(speeds_rad_s) > REST_SPEED_RAD_S:
            for state in joints.drain():
                if first_ns is None:
                    first_ns = state.timestamp_ns
                assert state.timestamp_ns < first_ns + MAX_COAST_S * 1e9, (
                    f"joints still move: {list(speeds_rad_s)} rad/s"
                )
                speeds_rad_s.append(find_max_speed_rad_s(state))
            time.sleep(0.005)
    return stopped_after_s
