"""A client without credentials on the network of a robot: a Zenoh session that exchanges plain dicts.

It knows no more of the protocol than `schemas/` documents. An unauthorized client uses it for its attacks, and
`robot_operator.py` extends it for the user who resets and arms the robot.
"""

import contextlib
import json
import time
from collections import deque
from dataclasses import dataclass
from typing import Any, Self

import zenoh
from zenoh import ext  # pyright: ignore[reportMissingModuleSource]

from snakesim_testing.harness.wait import TIMEOUT_S, wait_until
from verification.attack.tools import wire

NAMESPACE = "planar13"  # the namespace of a robot is its name
KEPT_SAMPLES = 2000  # of each key
FIRST_FORGED_SEQUENCE = 10**9  # no controller sends so many commands in a test
NUDGE_RAD = 0.02  # difference between the measured angles and the targets of a forged command
QUERYABLE_DELAY_S = 0.2  # until routers know a new queryable


@dataclass(frozen=True)
class ReceivedSample:
    """A message and the time of its arrival."""

    received_s: float  # monotonic clock
    message: Any


def make_zenoh_config(
    endpoint: str,
    mode: str = "client",
    *,
    listen: str | None = None,
    timeout_s: float = 3.0,
    receive_buffer_bytes: int | None = None,
) -> zenoh.Config:
    """Return the configuration of a session that finds the robot by its endpoint alone, without scouting.

    Args:
        endpoint: Endpoint to which the session connects; empty for none.
        mode: `client`, `peer` or `router`.
        listen: Endpoint on which the session itself listens.
        timeout_s: Time in s after which connecting fails.
        receive_buffer_bytes: Size of the receive buffer of its connection; None for the default of the system.
    """
    config: dict[str, Any] = {
        "mode": mode,
        "scouting": {
            "delay": 0,
            "multicast": {"enabled": False},
            "gossip": {"enabled": False},
        },
        "timestamping": {"enabled": {"router": True, "peer": True, "client": True}},
        "listen": {"endpoints": [] if listen is None else [listen]},
        "connect": {
            "endpoints": [endpoint] if endpoint else [],
            "timeout_ms": round(timeout_s * 1000),
            "exit_on_failure": True,
        },
    }
    if receive_buffer_bytes is not None:
        config["transport"] = {"link": {"tcp": {"so_rcvbuf": receive_buffer_bytes}}}
    return zenoh.Config.from_json5(json.dumps(config))


class NetworkClient:
    """A client on the network of one robot. A context manager, which leaves the network at its end."""

    def __init__(self, endpoint: str, namespace: str = NAMESPACE, **session_options: Any) -> None:
        """Connect to a network.

        Args:
            endpoint: Endpoint of the robot's network.
            namespace: First part of all keys.
            **session_options: Further arguments of `make_zenoh_config`.

        Raises:
            zenoh.ZError: Nothing listens at the endpoint.
        """
        zenoh.init_log_from_env_or("off")
        self.endpoint = endpoint
        self.namespace = namespace
        self.session = zenoh.open(make_zenoh_config(endpoint, **session_options))
        self._declarations: list[Any] = []  # in the order in which they were made
        self._samples: dict[str, deque[ReceivedSample]] = {}  # by key, oldest first

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the network."""
        for declaration in reversed(self._declarations):
            with contextlib.suppress(Exception):
                declaration.undeclare()
        self._declarations.clear()
        self.session.close()

    def add_namespace(self, key: str) -> str:
        """Return the full Zenoh key of a key of the robot."""
        return f"{self.namespace}/{key}"

    # --- receive messages ---------------------------------------------------------------------------------------

    def subscribe(self, *keys: str) -> None:
        """Keep the messages of keys from now on. A latched key also delivers its last value."""
        for key in keys:
            if key not in self._samples:
                self._samples[key] = deque(maxlen=KEPT_SAMPLES)
                self._declarations.append(self._declare_subscriber(key))

    def _declare_subscriber(self, key: str) -> Any:
        """Declare a subscriber that keeps the valid messages of a key."""
        samples = self._samples[key]
        required_fields = wire.find_required_fields(key)

        def keep_valid_message(sample: zenoh.Sample) -> None:
            received_s = time.monotonic()
            with contextlib.suppress(Exception):  # an attack may publish anything on this key
                message = wire.decode(sample.payload.to_bytes())
                if isinstance(message, dict) and required_fields <= message.keys():
                    samples.append(ReceivedSample(received_s, message))

        full_key = self.add_namespace(key)
        if wire.is_latched(key):
            history = ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
            return ext.declare_advanced_subscriber(
                self.session, full_key, keep_valid_message, history=history
            )
        return self.session.declare_subscriber(full_key, keep_valid_message)

    def list_samples(self, key: str) -> list[ReceivedSample]:
        """Return the kept messages of a key with their times of arrival, oldest first."""
        self.subscribe(key)
        return list(self._samples[key])

    def list_messages(self, key: str) -> list[Any]:
        """Return the kept messages of a key, oldest first."""
        return [sample.message for sample in self.list_samples(key)]

    def discard_streams(self) -> None:
        """Discard the kept messages of all streams; the values of latched keys stay."""
        for key, samples in self._samples.items():
            if wire.is_stream(key):
                samples.clear()

    def read_newest(self, key: str) -> Any:
        """Return the newest message of a key. If there is none yet, wait for the first one."""
        samples = wait_until(lambda: self.list_samples(key), f"a message on {key}")
        return samples[-1].message

    def wait_for_next(self, key: str, timeout_s: float = TIMEOUT_S) -> Any:
        """Wait for a message of a key that arrives from now on, and return it."""
        self.subscribe(key)
        start_s = time.monotonic()

        def has_new_message() -> bool:
            samples = self._samples[key]
            return bool(samples) and samples[-1].received_s > start_s

        wait_until(has_new_message, f"a new message on {key}", timeout_s)
        return self._samples[key][-1].message

    # --- send messages ------------------------------------------------------------------------------------------

    def publish(self, key: str, message: Any) -> None:
        """Publish a dict, or bytes as they are, on a key."""
        self.session.put(
            self.add_namespace(key), _encode(message), encoding=wire.find_encoding(key)
        )

    def publish_latched(self, key: str, message: dict[str, Any]) -> Any:
        """Publish on a latched key, so that later subscribers receive the message too. Returns the publisher."""
        publisher = ext.declare_advanced_publisher(
            self.session,
            self.add_namespace(key),
            encoding=wire.find_encoding(key),
            cache=ext.CacheConfig(1),
            publisher_detection=True,
        )
        self._declarations.append(publisher)
        publisher.put(wire.encode(message))
        return publisher

    def query(self, key: str, request: Any, timeout_s: float = 3.0) -> list[Any]:
        """Send a dict, or bytes as they are, as a query, and return all answers."""
        replies = self.session.get(
            self.add_namespace(key),
            payload=_encode(request),
            encoding=wire.find_encoding(key),
            timeout=timeout_s,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        return [
            wire.decode(reply.ok.payload.to_bytes()) for reply in replies if reply.ok is not None
        ]

    def answer_queries(self, key: str, answer: dict[str, Any]) -> None:
        """Answer every query on a key like a robot, and claim to have all of its data."""
        encoding = wire.read_schema("Answer")["encoding"]

        def send_answer(query: zenoh.Query) -> None:
            with query:
                query.reply(self.add_namespace(key), wire.encode(answer), encoding=encoding)

        queryable = self.session.declare_queryable(
            self.add_namespace(key), send_answer, complete=True
        )
        self._declarations.append(queryable)
        time.sleep(QUERYABLE_DELAY_S)

    def declare_token(self, key: str) -> None:
        """Declare a liveliness token, as a live process does."""
        token = self.session.liveliness().declare_token(self.add_namespace(key))
        self._declarations.append(token)

    # --- requests and commands ----------------------------------------------------------------------------------

    def request_lifecycle(self, action: str, **fields: Any) -> dict[str, Any]:
        """Request a change of the lifecycle state, and return the first answer.

        Args:
            action: Such as `arm`, `disarm` or `reset`. To arm, the request repeats what the description contains.
            **fields: Further fields of the request.

        Returns:
            The answer; a refusal with the code `no_answer` if there was none.
        """
        request: dict[str, Any] = {"action": action, "requester": "test client"}
        if action == "arm":
            description = self.read_newest("hal/description")
            for field in ("robot", "backend", "config_hash"):
                request[field] = description[field]
            request["unchecked"] = True
        request.update(fields)
        answers = self.query("hal/lifecycle", request)
        if not answers:
            return {"ok": False, "reason": "no answer", "refusal": "no_answer"}
        return answers[0]

    def make_command(self, clock: dict[str, Any], **changes: Any) -> dict[str, Any]:
        """Return a command that the controller might send, with slightly different targets.

        Lease epoch and arm session are in `hal/clock`, which any client can read.

        Args:
            clock: Message of `hal/clock` that the command answers.
            **changes: Fields that have another value.
        """
        description = self.read_newest("hal/description")
        joint_state = self.read_newest("sensor/joints")
        return {
            "tick": clock["tick"],
            "sequence": FIRST_FORGED_SEQUENCE,
            "lease_epoch": clock["lease_epoch"],
            "layout": description["layout"],
            "valid_for_ns": description["lease_ns"],
            "mode": [wire.POSITION] * len(description["joints"]),
            "target": [angle_rad + NUDGE_RAD for angle_rad in joint_state["angle_rad"]],
            "torque_limit_nm": None,
            "arm_session": clock["arm_session"],
            **changes,
        }


def _encode(message: Any) -> bytes:
    """Return the MessagePack of a message; bytes are returned as they are."""
    if isinstance(message, bytes):
        return message
    return wire.encode(message)
