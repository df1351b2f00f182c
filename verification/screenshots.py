"""Pictures of the console for the documentation, of a recorded run or of one that it starts.

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
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from PIL import Image

from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.operator.browser import open_chromium
from snakesim_testing.runs.command import running_snakesim

PHONE = 400, 800
# A busy computer answers late, and the page reports it.
LATE_ANSWERS = ("THE STOP", "NO ANSWER")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", help="folder of a recorded run, or what follows `snakesim run`")
    parser.add_argument("out", type=Path, help="the picture, a PNG")
    parser.add_argument(
        "--at", type=float, default=0.0, metavar="S", help="seconds into the recording"
    )
    parser.add_argument(
        "--after",
        type=float,
        default=8.0,
        metavar="S",
        help="seconds for the page to draw, without a graphics card (8)",
    )
    parser.add_argument(
        "--click",
        action="append",
        default=[],
        metavar="LABEL",
        help="in this order (may be repeated)",
    )
    parser.add_argument(
        "--signals", default="", metavar="NAMES", help="in the tab Signals: plots are parted by ;"
    )
    parser.add_argument(
        "--commission", metavar="FILE", help="of a host: RUN is what follows `snakesim start host`"
    )
    parser.add_argument("--scroll", type=int, default=0, metavar="DOTS", help="the panel, at last")
    parser.add_argument("--dark", action="store_true")
    parser.add_argument("--phone", action="store_true")
    given = parser.parse_args()
    width, height = PHONE if given.phone else (1280, 760)
    recorded = Path(given.run).is_dir()
    shown = recording(given.run, given.at) if recorded else live(given.run)
    if given.commission:
        shown = commissioning(given.run, given.commission)
    with shown as address, open_chromium() as browser:
        tab = browser.open_page(address, width, height)
        if given.phone:
            tab.set_window_size(width, height, scale=2.0, mobile=True)
        tab.wait_for("RECORDING" if recorded else "DISARMED" if given.commission else "armed by")
        time.sleep(given.after)
        tab.evaluate(
            "document.querySelectorAll('[class*=Notification-closeButton]').forEach(e => e.click())"
        )
        if given.dark:
            tab.click("Dark page")
        for label in [*given.click, *(["Signals"] if given.signals else [])]:
            tab.wait_for(label)
            tab.click(label)
            time.sleep(1.0)
        if given.signals:
            tab.evaluate(
                f"document.querySelector('iframe').src = 'signals?within&with#{given.signals}'"
            )
        tab.evaluate(
            f"document.querySelectorAll('[class*=viewport]').forEach(e => {{ e.scrollTop += {given.scroll}; }})"
        )
        time.sleep(given.after if recorded or given.scroll else 0.0)
        if not recorded:
            wait_until(
                lambda: not any(late in tab.read_text() for late in LATE_ANSWERS), "an answer"
            )
        taken = tab.capture_screenshot()
        save_picture(taken, given.out)


def save_picture(taken: bytes, out: Path) -> None:
    """Write a picture with 256 colors, which needs a quarter of the bytes."""
    with Image.open(io.BytesIO(taken)) as picture:
        few = picture.convert("RGB").quantize(
            256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE
        )
        few.save(out, optimize=True)


@contextlib.contextmanager
def recording(folder: str, at_s: float) -> Iterator[str]:
    """The console of a recording, and its address."""
    command = [sys.executable, "-m", "snakesim_operator", "console", folder, "--at", str(at_s)]
    console = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert console.stdout is not None
        yield console.stdout.readline().split()[1]
    finally:
        console.terminate()
        console.wait(10)


@contextlib.contextmanager
def commissioning(arguments: str, file: str) -> Iterator[str]:
    """A host that is not armed, and the address of a console that may write into its robot file."""
    endpoint, snakesim = find_free_endpoint(), [sys.executable, "-m", "snakesim_operator"]
    with tempfile.TemporaryDirectory() as state:
        own = {**os.environ, "XDG_STATE_HOME": state}
        host = subprocess.Popen(
            [*snakesim, "start", "host", *shlex.split(arguments), "--endpoint", endpoint], env=own
        )
        words = ["console", "--endpoint", endpoint, "--commission", file]
        try:
            wait_until(
                lambda: (
                    subprocess.run([*snakesim, "status", "--endpoint", endpoint]).returncode == 0
                ),
                "the host",
            )
            with subprocess.Popen(
                [*snakesim, *words], env=own, stdout=subprocess.PIPE, text=True
            ) as console:
                assert console.stdout is not None
                yield console.stdout.readline().split()[1]
                console.terminate()
        finally:
            host.terminate()
            host.wait(20)


@contextlib.contextmanager
def live(arguments: str) -> Iterator[str]:
    """A run with its console, and the address."""
    words = [*shlex.split(arguments), "--clock-mode", "realtime", "--console"]
    with (
        tempfile.TemporaryDirectory() as folder,
        running_snakesim(Path(folder) / "run", *words) as run,
    ):
        yield run.console()
        run.process.terminate()
        run.end()


if __name__ == "__main__":
    main()
