"""Pictures of the console for the documentation: `python -m tests.screenshots RUN OUT.png --at 5 --dark`."""

import argparse
import subprocess
import sys
import time
from pathlib import Path

from tests.browser import chromium

SETTLE_S = 6.0  # for the browser to draw, without a graphics card


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="folder of a recorded run")
    parser.add_argument("out", type=Path, help="the picture, a PNG")
    parser.add_argument("--at", type=float, default=0.0, metavar="S", help="seconds into the recording")
    parser.add_argument("--dark", action="store_true")
    parser.add_argument("--phone", action="store_true")
    given = parser.parse_args()
    command = [sys.executable, "-m", "snakesim_operator", "console", str(given.run), "--at", str(given.at)]
    console = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert console.stdout is not None
        address = console.stdout.readline().split()[1]
        with chromium() as browser:
            tab = browser.open(address, *((390, 780) if given.phone else (1280, 760)))
            if given.phone:
                tab.size(390, 780, scale=2.0, mobile=True)
            else:
                tab.wait_for("SIMULATOR")
            time.sleep(SETTLE_S)
            tab.value("document.querySelectorAll('[class*=Notification-closeButton]').forEach(e => e.click())")
            if given.dark:
                tab.value("[...document.querySelectorAll('input[type=checkbox]')].at(-1).click()")
            time.sleep(SETTLE_S)
            tab.picture(given.out)
    finally:
        console.terminate()
        console.wait(10)


if __name__ == "__main__":
    main()
