"""Watches a robot from a session of its own, and acts as the operator: records when messages arrive, resets and arms.

Times are of the monotonic clock when a sample reached this process, so they are upper bounds.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import Any, Generic, TypeVar

from snakesim_hal.base.errors import NotConnectedError, WireError
from snakesim_hal.network.session import Session
from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MessageDecoder
from snakesim_hal.wire.messages import (
    Answer,
    AppliedCommand,
    Clock,
    FaultRequest,
    JointMode,
    JointState,
    LifecycleRequest,
    Message,
    RobotDescription,
    RobotStatus,
)

LIMIT_S = 30.0
LOOK_S = 0.002
MAX_REQUESTS = 5  # before the host counts as absent
FoundT = TypeVar("FoundT")
MessageT = TypeVar("MessageT", bound=Message)


class TrialError(AssertionError):
    """Something that a trial needs did not happen."""


@dataclass(frozen=True)
class ReceivedMessage(Generic[MessageT]):
    """A message, and when it arrived."""

    at_ns: int
    message: MessageT


class Observer:
    """Records what the robot publishes, until `forget`."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.status: RobotStatus | None = None
        self.stumbles = 0  # armings that did not last, or were refused at the last moment
        self.statuses: list[ReceivedMessage[RobotStatus]] = []
        self.applied: list[ReceivedMessage[AppliedCommand]] = []
        self.clocks: list[ReceivedMessage[Clock]] = []
        self.joints: dict[int, JointState] = {}
        self.commands: list[ReceivedSample] = []
        self._inbox: SimpleQueue[ReceivedSample] = SimpleQueue()
        self._decoders: dict[str, MessageDecoder[Any]] = {
            key: MessageDecoder(message)
            for key, message in (
                (keys.STATUS, RobotStatus),
                (keys.APPLIED, AppliedCommand),
                (keys.CLOCK, Clock),
                (keys.JOINTS, JointState),
            )
        }
        self._descriptions = session.declare_latched_reader(keys.DESCRIPTION, RobotDescription)
        self._description: RobotDescription | None = None
        session.on_latched_arrival(keys.STATUS, self._inbox.put)
        for key in (keys.APPLIED, keys.CLOCK, keys.JOINTS, keys.JOINT_COMMAND):
            session.on_arrival(key, self._inbox.put)

    # --- what comes in ----------------------------------------------------------------------------------------

    def listen(self) -> None:
        """Record the messages that have arrived since the last call."""
        while True:
            try:
                arrival = self._inbox.get_nowait()
            except Empty:
                return
            if arrival.key == keys.JOINT_COMMAND:
                self.commands.append(arrival)
                continue
            try:
                message = self._decoders[arrival.key].decode(arrival.payload, arrival.encoding)
            except WireError as error:  # a joint state with no number in it, say
                self.on_unreadable(arrival, error)
            else:
                self.receive(arrival.monotonic_ns, message)

    def on_unreadable(self, arrival: ReceivedSample, error: WireError) -> None:
        """Ignore a sample that cannot be decoded. Subclasses may record it."""

    def receive(self, at_ns: int, message: Any) -> None:
        """Record a message. at_ns: its arrival, by the monotonic clock."""
        match message:
            case RobotStatus():
                self.status = message
                self.statuses.append(ReceivedMessage(at_ns, message))
            case AppliedCommand():
                self.applied.append(ReceivedMessage(at_ns, message))
            case Clock():
                self.clocks.append(ReceivedMessage(at_ns, message))
            case _:
                self.joints[message.tick] = message

    def forget(self) -> None:
        """Delete the recorded messages; the newest status stays known."""
        self.listen()
        for messages in (self.statuses, self.applied, self.clocks, self.joints, self.commands):
            messages.clear()

    def until(
        self, condition: Callable[[], FoundT | None], what: str, limit_s: float = LIMIT_S
    ) -> FoundT:
        """Listen until a condition holds; what it found. Raises TrialError with its name when it does not in time."""
        deadline = time.monotonic() + limit_s
        while True:
            self.listen()
            if found := condition():
                return found
            if time.monotonic() > deadline:
                raise TrialError(f"not within {limit_s:g} s: {what}; {self.in_words()}")
            time.sleep(LOOK_S)

    def watch(self, seconds: float) -> None:
        """Listen for a while."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            time.sleep(min(left, 0.05))
            self.listen()

    def in_words(self) -> str:
        """Return the newest status in words."""
        return (
            "no status" if self.status is None else f"{self.status.lifecycle}: {self.status.reason}"
        )

    def state(self) -> str | None:
        """Return the newest lifecycle state."""
        return None if self.status is None else self.status.lifecycle

    def description(self) -> RobotDescription:
        """The robot."""

        def found() -> RobotDescription | None:
            self._description = (self._descriptions.drain() or [self._description])[-1]
            return self._description

        return self.until(found, "a description")

    # --- what is looked for -----------------------------------------------------------------------------------

    def first_safe(self, since_ns: int) -> ReceivedMessage[AppliedCommand] | None:
        """Return the first setpoints after a time that are the host's own stop mode."""
        return next(
            (h for h in self.applied if h.at_ns >= since_ns and h.message.sequence is None), None
        )

    def safe_after_ms(self, since_ns: int) -> float:
        """How long until then."""
        return (
            self.until(lambda: self.first_safe(since_ns), "the stop mode", 3.0).at_ns - since_ns
        ) / 1e6

    def first_fault(self, since_ns: int) -> RobotStatus:
        """The first status after a time that tells a fault."""

        def found() -> list[RobotStatus]:
            return [
                h.message
                for h in self.statuses
                if h.at_ns >= since_ns and h.message.lifecycle == "fault"
            ]

        return self.until(found, "a fault in the status", 3.0)[0]

    # --- the operator -----------------------------------------------------------------------------------------

    def ask(self, key: str, request: Message) -> Answer:
        """Repeat a request until the host answers; a refusal is an answer, too. Raises TrialError without an answer.

        A flood of queries may displace an answer; then the request is repeated.
        """
        why = ""
        for _ in range(MAX_REQUESTS):
            try:
                return self.session.send_request(key, request, timeout_s=2.0)
            except NotConnectedError as error:
                why = str(error)
        raise TrialError(f"{why}, requested {MAX_REQUESTS} times")

    def inject(self, part: str, kind: str, target: str, **more: Any) -> Answer:
        """Inject a fault through the robot's own injector. Raises TrialError if it refuses."""
        answer = self.ask(keys.fault_key(part), FaultRequest(kind=kind, target=target, **more))
        if not answer.ok:
            raise TrialError(f"{kind}:{target} was refused: {answer.reason}")
        return answer

    def reset(self) -> None:
        """Reset what is latched, if anything is."""
        self.until(lambda: self.status is not None, "a status")
        if self.state() in ("fault", "estop"):
            requested_ns = time.monotonic_ns()
            self.ask(keys.LIFECYCLE, LifecycleRequest(action="reset"))

            def is_reset() -> bool:  # if only for a moment: what goes wrong next is another fault
                since = [h.message.lifecycle for h in self.statuses if h.at_ns > requested_ns]
                return self.state() == "disarmed" or "disarmed" in since

            self.until(is_reset, "disarmed after reset", 5.0)

    def arm(self, limit_s: float = LIMIT_S) -> None:
        """Reset, arm as soon as the robot is ready, and wait until the controller's commands are applied.

        On a busy machine the lease of a robot that was just armed may expire: that is counted, and tried again.
        """
        deadline = time.monotonic() + limit_s
        while not self._armed(max(deadline - time.monotonic(), 0.1)):
            self.stumbles += 1
            if time.monotonic() > deadline:
                raise TrialError(f"could not be armed within {limit_s:g} s: {self.in_words()}")

    def _armed(self, limit_s: float) -> bool:
        self._make_ready(limit_s)
        robot = self.description()
        self.forget()
        if self.state() != "armed":
            request = LifecycleRequest(
                action="arm",
                robot=robot.robot,
                backend=robot.backend,
                config_hash=robot.config_hash,
            )
            if not self.ask(keys.LIFECYCLE, request).ok:
                return False

        def follows() -> bool:
            return self.state() == "armed" and any(
                h.message.sequence is not None for h in self.applied
            )

        def is_stopped() -> bool:  # also by an earlier stop, of which the status arrives only now
            return self.state() in ("fault", "estop")

        self.until(lambda: follows() or is_stopped(), "commands applied after arming", 5.0)
        return not is_stopped()

    def _make_ready(self, limit_s: float) -> None:
        """Reset until no further fault is reported: a fault of the meantime is reported after the reset.

        The robot may be armed already: a flooded router can lose the response to an earlier request that armed it.
        """
        deadline = time.monotonic() + limit_s
        while self.status is None or not (self.status.ready_to_arm or self.state() == "armed"):
            self.reset()
            left_s = max(deadline - time.monotonic(), 0.1)
            self.until(
                lambda: (
                    self.status is not None
                    and (self.status.ready_to_arm or self.state() in ("armed", "fault", "estop"))
                ),
                "ready to arm",
                left_s,
            )

    def steps(self) -> dict[str, float]:
        """Largest steps of applied angle targets since `forget`, which `arm` calls; as a trial tells them."""
        within = first = 0.0
        before: AppliedCommand | None = None
        for received in self.applied:
            now = received.message
            measured = self.joints.get(now.tick)
            for i, mode in enumerate(now.mode):
                if mode is not JointMode.POSITION:
                    continue
                if (
                    before is not None
                    and before.tick == now.tick - 1
                    and before.mode[i] is JointMode.POSITION
                ):
                    within = max(within, abs(now.target[i] - before.target[i]))
                elif measured is not None:
                    first = max(first, abs(now.target[i] - measured.angle_rad[i]))
            before = now
        return {"step_rad": within, "first_rad": first}
