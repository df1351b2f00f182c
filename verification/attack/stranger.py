"""Somebody on the network: a Zenoh session of his own, that says and hears plain dicts at the robot's keys."""

import contextlib
import json
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

import zenoh
from zenoh import ext  # pyright: ignore[reportMissingModuleSource]

from snakesim_testing.harness.wait import TIMEOUT_S, wait_until
from verification.attack.means import wire

KEPT = 2000
NAMESPACE = "planar13"  # a robot's namespace is its name
FIRST = 10**9  # sequences from here on are a stranger's: no controller counts so far
NUDGE_RAD = 0.02


@dataclass(frozen=True)
class StampedSample:
    """A sample, and when it came by the monotonic clock."""

    at_s: float
    message: Any


def settings(
    endpoint: str,
    mode: str = "client",
    *,
    listen: str | None = None,
    timeout_s: float = 3.0,
    receive_buffer: int | None = None,
) -> zenoh.Config:
    """No scouting: a stranger finds the robot by its endpoint. receive_buffer: of its connection, in bytes."""
    buffers = (
        {}
        if receive_buffer is None
        else {"transport": {"link": {"tcp": {"so_rcvbuf": receive_buffer}}}}
    )
    return zenoh.Config.from_json5(
        json.dumps(
            {
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
                **buffers,
            }
        )
    )


class NetworkStranger:
    """On one robot's network. Nothing here knows more than schemas/ tells."""

    def __init__(self, endpoint: str, namespace: str = NAMESPACE, **more: Any) -> None:
        zenoh.init_log_from_env_or("off")
        self.endpoint, self.namespace = endpoint, namespace
        self.session = zenoh.open(settings(endpoint, **more))
        self._declared: list[Any] = []
        self._heard: dict[str, deque[StampedSample]] = {}

    def __enter__(self) -> "NetworkStranger":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the network."""
        for declared in reversed(self._declared):
            with contextlib.suppress(Exception):
                declared.undeclare()
        self._declared.clear()
        self.session.close()

    def key(self, key: str) -> str:
        """A key in the robot's namespace."""
        return f"{self.namespace}/{key}"

    # --- listening --------------------------------------------------------------------------------------------

    def receive(self, *keys: str) -> None:
        """Listen to keys from now on; latched ones give their last value."""
        for key in keys:
            if key in self._heard:
                continue
            kept = self._heard[key] = deque(maxlen=KEPT)
            latched, must_have = (
                wire.ROWS[key].kind == "latched",
                wire.required(wire.message_of(key)),
            )

            def take(
                sample: zenoh.Sample,
                kept: deque[StampedSample] = kept,
                must_have: set[str] = must_have,
            ) -> None:
                at_s = time.monotonic()
                with contextlib.suppress(Exception):  # others may send noise there
                    message = wire.decode(sample.payload.to_bytes())
                    if isinstance(message, dict) and must_have <= message.keys():
                        kept.append(StampedSample(at_s, message))

            if latched:
                history = ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
                self._declared.append(
                    ext.declare_advanced_subscriber(
                        self.session, self.key(key), take, history=history
                    )
                )
            else:
                self._declared.append(self.session.declare_subscriber(self.key(key), take))

    def heard(self, key: str) -> list[StampedSample]:
        """Everything kept of a key, oldest first."""
        self.receive(key)
        return list(self._heard[key])

    def forget(self) -> None:
        """What has been heard so far of streams; latched values stay."""
        for key, kept in self._heard.items():
            if wire.ROWS[key].kind == "stream":
                kept.clear()

    def newest(self, key: str, limit_s: float = TIMEOUT_S) -> Any:
        """The newest message at a key; waits for the first one."""
        self.receive(key)
        return self.until(lambda: self._heard[key], f"something on {key}", limit_s)[-1].message

    def next(self, key: str, limit_s: float = TIMEOUT_S) -> Any:
        """A message at a key that comes from now on."""
        self.receive(key)
        now = time.monotonic()
        self.until(
            lambda: self._heard[key] and self._heard[key][-1].at_s > now,
            f"something new on {key}",
            limit_s,
        )
        return self._heard[key][-1].message

    until = staticmethod(wait_until)

    # --- speaking ---------------------------------------------------------------------------------------------

    def put(self, key: str, message: Any, encoding: str | None = None) -> None:
        """Publish a dict, or bytes as they are, at a key."""
        payload = message if isinstance(message, bytes) else wire.encode(message)
        self.session.put(self.key(key), payload, encoding=encoding or wire.encoding_of(key))

    def ask(
        self, key: str, request: Any, timeout_s: float = 3.0, encoding: str | None = None
    ) -> list[Any]:
        """Every answer to a query."""
        payload = request if isinstance(request, bytes) else wire.encode(request)
        replies = self.session.get(
            self.key(key),
            payload=payload,
            encoding=encoding or wire.encoding_of(key),
            timeout=timeout_s,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        return [
            wire.decode(reply.ok.payload.to_bytes()) for reply in replies if reply.ok is not None
        ]

    def pretend(self, key: str, answer: dict[str, Any]) -> list[bytes]:
        """Answer queries at a key as if one were the robot, and claim to know everything there. What was asked."""
        asked: list[bytes] = []
        encoding = wire.schema("Answer")["encoding"]

        def reply(query: zenoh.Query) -> None:
            with query:
                asked.append(b"" if query.payload is None else query.payload.to_bytes())
                query.reply(self.key(key), wire.encode(answer), encoding=encoding)

        self._declared.append(self.session.declare_queryable(self.key(key), reply, complete=True))
        time.sleep(0.2)  # until routers know of it
        return asked

    def latch(self, key: str, message: dict[str, Any]) -> Any:
        """Publish at a latched key, so that later readers get it too."""
        publisher = ext.declare_advanced_publisher(
            self.session,
            self.key(key),
            encoding=wire.encoding_of(key),
            cache=ext.CacheConfig(1),
            publisher_detection=True,
        )
        self._declared.append(publisher)
        publisher.put(wire.encode(message))
        return publisher

    def seem_alive(self, key: str) -> None:
        """Show a liveliness token."""
        self._declared.append(self.session.liveliness().declare_token(self.key(key)))

    # --- what anybody may ask of the robot ----------------------------------------------------------------------

    def status(self) -> dict[str, Any]:
        """The newest of `hal/status`."""
        return self.newest("hal/status")

    def lifecycle(self) -> str:
        """As the newest status or clock has it."""
        self.receive("hal/status", "hal/clock")
        found = [kept[-1] for key in ("hal/status", "hal/clock") if (kept := self._heard[key])]
        if not found:
            return self.status()["lifecycle"]
        return max(found, key=lambda heard: heard.at_s).message["lifecycle"]

    def request(self, action: str, **more: Any) -> dict[str, Any]:
        """Ask for another lifecycle; arming names what the description tells."""
        request: dict[str, Any] = {"action": action, "requester": "stranger", **more}
        if action == "arm":
            about = self.newest("hal/description")
            named = {name: about[name] for name in ("robot", "backend", "config_hash")}
            request = {**named, "unchecked": True, **request}
        answers = self.ask("hal/lifecycle", request)
        return (
            answers[0] if answers else {"ok": False, "reason": "no answer", "refusal": "no_answer"}
        )

    def command(self, clock: dict[str, Any], **changes: Any) -> dict[str, Any]:
        """As the controller might send it, a little off: epoch and arming are in the clock, for anybody to read."""
        about, state = self.newest("hal/description"), self.newest("sensor/joints")
        return {
            "tick": clock["tick"],
            "sequence": FIRST,
            "lease_epoch": clock["lease_epoch"],
            "layout": about["layout"],
            "valid_for_ns": about["lease_ns"],
            "mode": [wire.POSITION] * len(about["joints"]),
            "target": [angle + NUDGE_RAD for angle in state["angle_rad"]],
            "torque_limit_nm": None,
            "arm_session": clock["arm_session"],
            **changes,
        }

    def recover(self, limit_s: float = TIMEOUT_S) -> None:
        """Have the robot armed and following its controller, whatever happened to it."""
        self.receive("hal/status", "hal/clock", "hal/applied", "hal/description")
        # The next status may take a fifth of a second.
        if self.lifecycle() == "armed" and self.follows():
            return
        deadline = time.monotonic() + limit_s
        last: Any = None
        while time.monotonic() < deadline:
            status = self.next("hal/status", limit_s)
            if status["lifecycle"] == "armed":
                if self.follows():
                    return
            elif status["lifecycle"] in ("fault", "estop"):
                last = self.request("reset")
            elif status["ready_to_arm"]:
                last = self.request("arm")
            time.sleep(0.05)
        raise AssertionError(f"not armed within {limit_s:g} s: {self.status()['reason']}; {last}")

    def stand_by(self, limit_s: float = TIMEOUT_S) -> None:
        """Have the robot disarmed and ready to arm; a busy machine may have stopped it meanwhile."""
        deadline = time.monotonic() + limit_s
        while time.monotonic() < deadline:
            status = self.next("hal/status", limit_s)
            if status["lifecycle"] == "disarmed" and status["ready_to_arm"]:
                return
            if status["lifecycle"] != "disarmed":
                self.request("disarm" if status["lifecycle"] == "armed" else "reset")
        raise AssertionError(f"not ready to arm within {limit_s:g} s: {self.status()['reason']}")

    def follows(self, command_count: int = 10, limit_s: float = 1.5) -> bool:
        """Whether commands of the robot's controller are applied, one after the other."""
        first = time.monotonic()

        def enough() -> bool:
            seen = {
                heard.message["sequence"]
                for heard in self.heard("hal/applied")
                if heard.at_s > first
            }
            return len(seen - {None}) >= command_count

        with contextlib.suppress(AssertionError):
            wait_until(enough, "commands are applied", limit_s)
            return self.lifecycle() == "armed"
        return False

    def stopped_at(self, since_s: float, limit_s: float) -> float:
        """When an emergency stop was first seen: in the status, in the clock, or in what the motors get."""

        def seen() -> list[float]:
            return [
                heard.at_s
                for key in ("hal/status", "hal/clock")
                for heard in self.heard(key)
                if heard.at_s >= since_s and heard.message.get("lifecycle") == "estop"
            ]

        return min(self.until(seen, "an emergency stop", limit_s))


class HostTime:
    """When a tick of the host was, by our clock; told by ticks, because samples may be held up on the way."""

    def __init__(self, operator: NetworkStranger) -> None:
        operator.next("hal/clock")
        self._period_s = operator.newest("hal/clock")["period_ns"] * 1e-9
        self._began_s = self._offset(operator)

    def of(self, tick: int) -> float:
        """By the monotonic clock."""
        return self._began_s + tick * self._period_s

    def lost_s(self, operator: NetworkStranger) -> float:
        """How much later the host's ticks come by now: time in which it stood still."""
        operator.forget()
        operator.until(lambda: len(operator.heard("hal/clock")) >= 10, "ten ticks")
        return self._offset(operator) - self._began_s

    def _offset(self, operator: NetworkStranger) -> float:
        return min(
            heard.at_s - heard.message["tick"] * self._period_s
            for heard in operator.heard("hal/clock")
        )
