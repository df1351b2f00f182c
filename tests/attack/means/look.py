"""`python -m tests.attack.means.look ENDPOINT`: the lifecycle of the robot that shows itself there, as a JSON list."""

import json
import sys
import time

import zenoh

from tests.attack.stranger import Stranger

LOOK_S = 0.6  # a status comes a few times a second


def main() -> None:
    """Look once; an empty list where nobody shows one."""
    try:
        with Stranger(sys.argv[1], timeout_s=1.0) as looking:
            looking.receive("hal/status")
            time.sleep(LOOK_S)
            newest = looking.heard("hal/status")[-1:]
    except zenoh.ZError:
        newest = []
    print(json.dumps([heard.message["lifecycle"] for heard in newest]), flush=True)


if __name__ == "__main__":
    main()
