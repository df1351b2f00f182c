"""`python -m snakesim_testing.lab.intruder SESSION.json5`: holds a viewer's certificate, and does what it can with it.

It repeats every message that it receives, at the same key. It commands with the epoch and the next sequence number
that it reads, and it answers in the robot's place. It prints how often, every tenth of a second.
"""

import sys
import time
from collections import Counter

import msgspec.msgpack
import zenoh

QUERIES = ("hal/lifecycle", "hal/estop", "hal/lease")


def main(path: str) -> None:
    """Until it is ended."""
    did: Counter[str] = Counter()
    with zenoh.open(zenoh.Config.from_file(path)) as session:

        def say(key: zenoh.KeyExpr | str, payload: bytes, encoding: zenoh.Encoding) -> None:
            session.put(key, payload, encoding=encoding, allowed_destination=zenoh.Locality.REMOTE)

        def repeat(sample: zenoh.Sample) -> None:
            say(sample.key_expr, sample.payload.to_bytes(), sample.encoding)
            did["repeated"] += 1
            if str(sample.key_expr) == "actuator/joints":
                command = msgspec.msgpack.decode(sample.payload.to_bytes())
                command["sequence"] += 1
                command["target"] = [0.3] * len(command["target"])
                say(sample.key_expr, msgspec.msgpack.encode(command), sample.encoding)
                did["commanded"] += 1

        def answer(query: zenoh.Query) -> None:
            did["answered"] += 1
            query.reply(query.key_expr, b"\x80")
            query.drop()

        kept = [session.declare_subscriber("**", repeat), *(session.declare_queryable(key, answer) for key in QUERIES)]
        while kept:
            time.sleep(0.1)
            print(dict(did), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
