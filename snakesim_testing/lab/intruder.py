"""Attacks a robot with the certificate of a viewer.

Run it with `python -m snakesim_testing.lab.intruder SESSION.json5`. It publishes every message that it receives again.
It sends commands with the lease epoch and the next sequence number that it reads, and answers requests in the robot's
place. Every 0.1 s it prints the number of attempts of each kind.
"""

import sys
import time
from collections import Counter

import msgspec.msgpack
import zenoh

QUERIES = ("hal/lifecycle", "hal/estop", "hal/lease")
FORGED_TARGET = 0.3  # rad, of every joint
EMPTY_MAP = b"\x80"  # of MessagePack
PRINT_PERIOD_S = 0.1


def main(path: str) -> None:
    """Attack the robot until this process is ended, and print the number of attempts of each kind.

    Args:
        path: File with the Zenoh configuration of the session, as JSON5.
    """
    attempts: Counter[str] = Counter()
    with zenoh.open(zenoh.Config.from_file(path)) as session:

        def publish(key: zenoh.KeyExpr | str, payload: bytes, encoding: zenoh.Encoding) -> None:
            session.put(key, payload, encoding=encoding, allowed_destination=zenoh.Locality.REMOTE)

        def replay_sample(sample: zenoh.Sample) -> None:
            """Publish a received message again; after a joint command, publish also a forged next one."""
            payload = sample.payload.to_bytes()
            publish(sample.key_expr, payload, sample.encoding)
            attempts["repeated"] += 1
            if str(sample.key_expr) == "actuator/joints":
                command = msgspec.msgpack.decode(payload)
                command["sequence"] += 1
                command["target"] = [FORGED_TARGET] * len(command["target"])
                publish(sample.key_expr, msgspec.msgpack.encode(command), sample.encoding)
                attempts["commanded"] += 1

        def answer_query(query: zenoh.Query) -> None:
            """Answer a query in the robot's place, with an empty map."""
            attempts["answered"] += 1
            query.reply(query.key_expr, EMPTY_MAP)
            query.drop()

        # Zenoh ends a declaration when its object is deleted.
        subscriber = session.declare_subscriber("**", replay_sample)
        queryables = [session.declare_queryable(key, answer_query) for key in QUERIES]
        while subscriber and queryables:
            time.sleep(PRINT_PERIOD_S)
            print(dict(attempts), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
