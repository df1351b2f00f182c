"""`python -m tests.attack.means.look ENDPOINT`: the lifecycle of every robot that shows a status, as a JSON list."""

import json
import sys
import time

import zenoh
from zenoh import ext  # pyright: ignore[reportMissingModuleSource]

from tests.attack.means import wire
from tests.attack.stranger import settings

LOOK_S = 0.6  # a status comes a few times a second


def main() -> None:
    """Look once."""
    zenoh.init_log_from_env_or("off")
    found: dict[str, str] = {}

    def take(sample: zenoh.Sample) -> None:
        found[str(sample.key_expr)] = wire.decode(sample.payload.to_bytes())["lifecycle"]

    try:
        session = zenoh.open(settings(sys.argv[1], timeout_s=1.0))
    except zenoh.ZError:
        print("[]")
        return
    history = ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
    reader = ext.declare_advanced_subscriber(session, "**/hal/status", take, history=history)
    time.sleep(LOOK_S)
    print(json.dumps(list(found.values())), flush=True)
    reader.undeclare()
    session.close()


if __name__ == "__main__":
    main()
