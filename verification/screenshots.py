"""Take pictures of the console for the documentation, of a recorded run or of a run that it starts.

python -m verification.screenshots runs/clutter docs/pictures/console.png --at 5 --dark
python -m verification.screenshots 'peg_row --stay' docs/pictures/console-live.png \\
    --click 'Take control' --click Parameters
"""

import argparse
import contextlib
import io
import os
import shlex
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path

from PIL import Image

from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.operator.browser import BrowserTab, open_chromium
from snakesim_testing.runs.command import SNAKESIM_COMMAND, running_snakesim

PHONE_SIZE = (400, 800)  # points
DESKTOP_SIZE = (1280, 760)
PHONE_SCALE = 2.0  # pixels a point
COLORS = 256  # of a picture; it needs a quarter of the bytes of one with all colors
CLICK_S = 1.0  # until the page has drawn the result of a click
CONSOLE_END_TIMEOUT_S = 10
HOST_END_TIMEOUT_S = 20
# On a busy computer, answers arrive late, and the page shows one of these messages.
LATE_ANSWER_MESSAGES = ("THE STOP", "NO ANSWER")
CLOSE_NOTIFICATIONS = (
    "document.querySelectorAll('[class*=Notification-closeButton]').forEach(e => e.click())"
)


def main() -> None:
    """Take one picture, and write it into a file."""
    options = _parse_arguments()
    is_recording = Path(options.run).is_dir()
    with open_console(options) as address, open_chromium() as browser:
        width, height = PHONE_SIZE if options.phone else DESKTOP_SIZE
        tab = browser.open_page(address, width, height)
        if options.phone:
            tab.set_window_size(width, height, scale=PHONE_SCALE, mobile=True)
        tab.wait_for(choose_first_text(options))
        time.sleep(options.after)
        prepare_page(tab, options)
        if is_recording or options.scroll:
            time.sleep(options.after)
        if not is_recording:
            wait_until(lambda: not shows_late_answer(tab), "an answer")
        save_picture(tab.capture_screenshot(), options.out)


def _parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m verification.screenshots",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "run", help="folder of a recorded run, or the arguments of `snakesim run` for a new one"
    )
    parser.add_argument("out", type=Path, help="file for the picture, a PNG")
    parser.add_argument(
        "--at", type=float, default=0.0, metavar="S", help="time in the recording, in s (0)"
    )
    parser.add_argument(
        "--after",
        type=float,
        default=8.0,
        metavar="S",
        help="time for the page to draw without a graphics card, in s (8)",
    )
    parser.add_argument(
        "--click",
        action="append",
        default=[],
        metavar="LABEL",
        help="click the element with this label; may be repeated, the order counts",
    )
    parser.add_argument(
        "--signals",
        default="",
        metavar="NAMES",
        help="plot these signals in the tab Signals; a semicolon begins another plot",
    )
    parser.add_argument(
        "--commission",
        metavar="FILE",
        help="robot file to commission; RUN contains the arguments of `snakesim start host`",
    )
    parser.add_argument(
        "--scroll", type=int, default=0, metavar="PIXELS", help="scroll the panel down at the end"
    )
    parser.add_argument("--dark", action="store_true", help="use dark colors")
    parser.add_argument("--phone", action="store_true", help="use the size of a phone")
    return parser.parse_args()


def open_console(options: argparse.Namespace) -> AbstractContextManager[str]:
    """Return the context of the console that the options describe; it yields the console's address."""
    if options.commission:
        return run_commissioning_console(options.run, options.commission)
    if Path(options.run).is_dir():
        return run_recording_console(options.run, options.at)
    return run_live_console(options.run)


def choose_first_text(options: argparse.Namespace) -> str:
    """Return the text that the page shows when it has loaded."""
    if Path(options.run).is_dir():
        return "RECORDING"
    if options.commission:
        return "DISARMED"
    return "armed by"


def prepare_page(tab: BrowserTab, options: argparse.Namespace) -> None:
    """Close notifications, then select colors, tabs, signals and the scroll position."""
    tab.evaluate(CLOSE_NOTIFICATIONS)
    if options.dark:
        tab.click("Dark page")
    labels = list(options.click)
    if options.signals:
        labels.append("Signals")
    for label in labels:
        tab.wait_for(label)
        tab.click(label)
        time.sleep(CLICK_S)
    if options.signals:
        source = f"signals?within&with#{options.signals}"
        tab.evaluate(f"document.querySelector('iframe').src = '{source}'")
    tab.evaluate(
        "document.querySelectorAll('[class*=viewport]')"
        f".forEach(e => {{ e.scrollTop += {options.scroll}; }})"
    )


def shows_late_answer(tab: BrowserTab) -> bool:
    """Return whether the page shows that an answer of the host is late."""
    text = tab.read_text()
    return any(message in text for message in LATE_ANSWER_MESSAGES)


def save_picture(png: bytes, out: Path) -> None:
    """Write a picture with 256 colors."""
    with Image.open(io.BytesIO(png)) as picture:
        reduced = picture.convert("RGB").quantize(
            COLORS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE
        )
        reduced.save(out, optimize=True)


def read_address(console: subprocess.Popen[str]) -> str:
    """Return the address in the first line that a console prints."""
    assert console.stdout is not None
    return console.stdout.readline().split()[1]


@contextlib.contextmanager
def run_recording_console(folder: str, at_s: float) -> Iterator[str]:
    """Run the console of a recording, and yield its address.

    Args:
        folder: Folder of the recorded run.
        at_s: Time in the recording that the console shows, in s.
    """
    console = subprocess.Popen(
        [*SNAKESIM_COMMAND, "console", folder, "--at", str(at_s)], stdout=subprocess.PIPE, text=True
    )
    try:
        yield read_address(console)
    finally:
        console.terminate()
        console.wait(CONSOLE_END_TIMEOUT_S)


@contextlib.contextmanager
def run_commissioning_console(arguments: str, robot_file: str) -> Iterator[str]:
    """Run a host that is not armed and a console that may write its robot file, and yield the console's address.

    Args:
        arguments: Arguments of `snakesim start host`.
        robot_file: The file that the console may write.
    """
    endpoint = ("--endpoint", find_free_endpoint())
    with tempfile.TemporaryDirectory() as state:
        environment = {**os.environ, "XDG_STATE_HOME": state}
        host = subprocess.Popen(
            [*SNAKESIM_COMMAND, "start", "host", *shlex.split(arguments), *endpoint],
            env=environment,
        )
        status_command = [*SNAKESIM_COMMAND, "status", *endpoint]
        try:
            wait_until(
                lambda: subprocess.run(status_command, check=False).returncode == 0, "the host"
            )
            with subprocess.Popen(
                [*SNAKESIM_COMMAND, "console", *endpoint, "--commission", robot_file],
                env=environment,
                stdout=subprocess.PIPE,
                text=True,
            ) as console:
                yield read_address(console)
                console.terminate()
        finally:
            host.terminate()
            host.wait(HOST_END_TIMEOUT_S)


@contextlib.contextmanager
def run_live_console(arguments: str) -> Iterator[str]:
    """Start a run with a console in real time, and yield the console's address.

    Args:
        arguments: Arguments of `snakesim run`.
    """
    with (
        tempfile.TemporaryDirectory() as folder,
        running_snakesim(
            Path(folder) / "run", *shlex.split(arguments), "--clock-mode", "realtime", "--console"
        ) as run,
    ):
        yield run.console()
        run.process.terminate()
        run.end()


if __name__ == "__main__":
    main()
