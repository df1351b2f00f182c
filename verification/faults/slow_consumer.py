"""Reads the streams of a robot, but cannot keep up with them.

Run it with `python -m verification.faults.slow_consumer KIND ENDPOINT NAMESPACE`. It runs until it is killed. KIND is

* `sleep`: its callback sleeps for half a second at every sample.
* `disk`: it writes every sample to /dev/full, which responds like a full disk.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path

from snakesim_hal.base.process import set_parent_death_signal
from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.wire import keys

SLEEP_S = 0.5
KEYS = (keys.JOINTS, keys.CLOCK, keys.APPLIED, keys.JOINT_COMMAND, keys.CONTACTS, keys.POSE)
STUCK = "stuck"  # printed at the first sample that blocks the consumer


def main() -> None:
    """Subscribe to the streams, and wait until this process is killed."""
    kind, endpoint, namespace = sys.argv[1:]
    set_parent_death_signal()
    on_sample = make_callback(kind)
    with open_session(ConnectionSettings(endpoint, namespace)) as session:
        for key in KEYS:
            session.on_arrival(key, on_sample)
        while True:
            time.sleep(1.0)


def make_callback(kind: str) -> Callable[[ReceivedSample], None]:
    """Return a callback for samples that sleeps, or fails to write to a full disk."""
    was_reported = False

    def report_once(text: str) -> None:
        nonlocal was_reported
        if not was_reported:
            was_reported = True
            print(text, flush=True)

    def sleep(_sample: ReceivedSample) -> None:
        report_once(STUCK)
        time.sleep(SLEEP_S)

    def write_to_full_disk(sample: ReceivedSample) -> None:
        try:
            with Path("/dev/full").open("wb") as file:
                file.write(sample.payload)
        except OSError as error:
            report_once(f"{STUCK}: {error.strerror}")
            raise

    return sleep if kind == "sleep" else write_to_full_disk


if __name__ == "__main__":
    main()
