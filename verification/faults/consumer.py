"""A consumer of streams that cannot keep up. `python -m verification.faults.consumer KIND ENDPOINT NAMESPACE`.

sleep: its callback sleeps for half a second at every sample. disk: it writes what it gets to /dev/full, which answers
as a disk that is full.
"""

import sys
import time
from pathlib import Path

from snakesim_hal.base.process import set_parent_death_signal
from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.wire import keys

SLEEP_S = 0.5
KEYS = (keys.JOINTS, keys.CLOCK, keys.APPLIED, keys.JOINT_COMMAND, keys.CONTACTS, keys.POSE)
STUCK = "stuck"


def main() -> None:
    """Until killed."""
    kind, endpoint, namespace = sys.argv[1:]
    set_parent_death_signal()
    was_reported: list[bool] = []

    def sleeps(_arrival: ReceivedSample) -> None:
        if not was_reported:
            was_reported.append(True)
            print(STUCK, flush=True)
        time.sleep(SLEEP_S)

    def writes(arrival: ReceivedSample) -> None:
        try:
            with Path("/dev/full").open("wb") as file:
                file.write(arrival.payload)
        except OSError as error:
            if not was_reported:
                was_reported.append(True)
                print(f"{STUCK}: {error.strerror}", flush=True)
            raise

    with open_session(ConnectionSettings(endpoint, namespace)) as session:
        for key in KEYS:
            session.on_arrival(key, sleeps if kind == "sleep" else writes)
        while True:
            time.sleep(1.0)


if __name__ == "__main__":
    main()
