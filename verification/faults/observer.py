"""Observes a robot over its own session, and acts as the operator who resets and arms it.

Times are read from the monotonic clock when a message arrives in this process, so they are upper bounds.
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

DEFAULT_TIMEOUT_S = 30.0
POLL_PERIOD_S = 0.002  # a fifth of a control period
LISTEN_PERIOD_S = 0.05  # while nothing in particular is awaited
REACTION_TIMEOUT_S = 3.0  # longer than any stream may be old before the robot reacts
RESET_TIMEOUT_S = 5.0
FIRST_COMMAND_TIMEOUT_S = 5.0  # from arming to the first applied command
MAX_REQUESTS = 5  # without an answer, before the host counts as absent
REQUEST_TIMEOUT_S = 2.0

FoundT = TypeVar("FoundT")
MessageT = TypeVar("MessageT", bound=Message)


class TrialError(AssertionError):
    """An event that a trial needs did not happen."""


@dataclass(frozen=True)
class ReceivedMessage(Generic[MessageT]):
    """A message, and when it arrived."""

    at_ns: int  # by the monotonic clock
    message: MessageT


@dataclass(frozen=True)
class TargetSteps:
    """How far applied angle targets jump."""

    step_rad: float  # largest change of a target from one tick to the next
    first_rad: float  # largest distance of the first target of a joint from its measured angle


class Observer:
    """Records what the robot publishes, until `forget`."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.failed_armings = 0  # the host refused, or the robot stopped before its first command

        # Recorded messages, oldest first.
        self.status: RobotStatus | None = None
        self.statuses: list[ReceivedMessage[RobotStatus]] = []
        self.applied: list[ReceivedMessage[AppliedCommand]] = []
        self.clocks: list[ReceivedMessage[Clock]] = []
        self.joints: dict[int, JointState] = {}  # by tick
        self.commands: list[ReceivedSample] = []

        # Arrivals that are not decoded yet.
        self._inbox: SimpleQueue[ReceivedSample] = SimpleQueue()
        self._decoders: dict[str, MessageDecoder[Any]] = {
            keys.STATUS: MessageDecoder(RobotStatus),
            keys.APPLIED: MessageDecoder(AppliedCommand),
            keys.CLOCK: MessageDecoder(Clock),
            keys.JOINTS: MessageDecoder(JointState),
        }
        self._descriptions = session.declare_latched_reader(keys.DESCRIPTION, RobotDescription)
        self._description: RobotDescription | None = None
        session.on_latched_arrival(keys.STATUS, self._inbox.put)
        for key in (keys.APPLIED, keys.CLOCK, keys.JOINTS, keys.JOINT_COMMAND):
            session.on_arrival(key, self._inbox.put)

    # --- record messages --------------------------------------------------------------------------------------

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
            except WireError as error:  # for example a joint state that contains NaN
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
        """Delete the recorded messages, except the newest status."""
        self.listen()
        for messages in (self.statuses, self.applied, self.clocks, self.joints, self.commands):
            messages.clear()

    def listen_for(self, duration_s: float) -> None:
        """Record messages for a while."""
        deadline_s = time.monotonic() + duration_s
        while (remaining_s := deadline_s - time.monotonic()) > 0:
            time.sleep(min(remaining_s, LISTEN_PERIOD_S))
            self.listen()

    def wait_until(
        self,
        condition: Callable[[], FoundT | None],
        description: str,
        timeout_s: float = DEFAULT_TIMEOUT_S,
    ) -> FoundT:
        """Record messages until a condition returns a true value, and return this value.

        Args:
            condition: Returns a true value once the condition holds.
            description: What is awaited, for the error message.
            timeout_s: Time after which the wait fails.

        Raises:
            TrialError: The condition did not hold in time.
        """
        deadline_s = time.monotonic() + timeout_s
        while True:
            self.listen()
            if found := condition():
                return found
            if time.monotonic() > deadline_s:
                raise TrialError(
                    f"not within {timeout_s:g} s: {description}; {self.describe_status()}"
                )
            time.sleep(POLL_PERIOD_S)

    # --- read what was recorded -------------------------------------------------------------------------------

    def describe_status(self) -> str:
        """Return the lifecycle state and its reason, from the newest status."""
        if self.status is None:
            return "no status"
        return f"{self.status.lifecycle}: {self.status.reason}"

    def get_lifecycle(self) -> str | None:
        """Return the newest lifecycle state, or None if there was no status yet."""
        return None if self.status is None else self.status.lifecycle

    def get_description(self) -> RobotDescription:
        """Return the newest description of the robot. Wait for it if there is none yet."""

        def read_newest() -> RobotDescription | None:
            descriptions = self._descriptions.drain()
            if descriptions:
                self._description = descriptions[-1]
            return self._description

        return self.wait_until(read_newest, "a description")

    def has_applied_commands(self) -> bool:
        """Return whether the host applied a command of a controller since `forget`."""
        return any(received.message.sequence is not None for received in self.applied)

    def find_stop_setpoints(self, since_ns: int) -> ReceivedMessage[AppliedCommand] | None:
        """Return the first setpoints of the stop mode, which the host computes without a command.

        Args:
            since_ns: Time by the monotonic clock; earlier setpoints do not count.
        """
        for received in self.applied:
            if received.at_ns >= since_ns and received.message.sequence is None:
                return received
        return None

    def measure_stop_delay_ms(self, since_ns: int) -> float:
        """Wait for the first setpoints of the stop mode, and return their delay after a time."""
        stop = self.wait_until(
            lambda: self.find_stop_setpoints(since_ns), "the stop mode", REACTION_TIMEOUT_S
        )
        return (stop.at_ns - since_ns) / 1e6

    def wait_for_fault(self, since_ns: int) -> RobotStatus:
        """Wait for a status after a time that reports the lifecycle state `fault`, and return the first one."""

        def find_fault() -> RobotStatus | None:
            for received in self.statuses:
                if received.at_ns >= since_ns and received.message.lifecycle == "fault":
                    return received.message
            return None

        return self.wait_until(find_fault, "a fault in the status", REACTION_TIMEOUT_S)

    def measure_target_steps(self) -> TargetSteps:
        """Return how far the angle targets jumped since `forget`, which `arm` calls."""
        step_rad = 0.0
        first_rad = 0.0
        previous: AppliedCommand | None = None
        for received in self.applied:
            applied = received.message
            measured = self.joints.get(applied.tick)
            for i, mode in enumerate(applied.mode):
                if mode is not JointMode.POSITION:
                    continue
                target_rad = applied.target[i]
                if previous is not None and _is_continued(previous, applied, i):
                    step_rad = max(step_rad, abs(target_rad - previous.target[i]))
                elif measured is not None:
                    first_rad = max(first_rad, abs(target_rad - measured.angle_rad[i]))
            previous = applied
        return TargetSteps(step_rad, first_rad)

    # --- act as the operator ----------------------------------------------------------------------------------

    def send_request(self, key: str, request: Message) -> Answer:
        """Send a request until the host answers, and return the answer, which may be a refusal.

        A flood of queries can displace an answer. The request is then sent again.

        Raises:
            TrialError: The host did not answer MAX_REQUESTS requests.
        """
        reason = ""
        for _ in range(MAX_REQUESTS):
            try:
                return self.session.send_request(key, request, timeout_s=REQUEST_TIMEOUT_S)
            except NotConnectedError as error:
                reason = str(error)
        raise TrialError(f"{reason}, requested {MAX_REQUESTS} times")

    def inject_fault(self, part: str, kind: str, target: str, **options: Any) -> Answer:
        """Inject a fault with the robot's own injector.

        Args:
            part: Process that injects the fault, for example `hal`.
            kind: Kind of the fault, for example `mute`.
            target: Joint, bus, key or process that fails.
            options: Further fields of the FaultRequest.

        Raises:
            TrialError: The injector refused.
        """
        request = FaultRequest(kind=kind, target=target, **options)
        answer = self.send_request(keys.fault_key(part), request)
        if not answer.ok:
            raise TrialError(f"{kind}:{target} was refused: {answer.reason}")
        return answer

    def reset(self) -> None:
        """Reset the latched fault or emergency stop, if there is one."""
        self.wait_until(lambda: self.status is not None, "a status")
        if self.get_lifecycle() not in ("fault", "estop"):
            return
        request_ns = time.monotonic_ns()
        self.send_request(keys.LIFECYCLE, LifecycleRequest(action="reset"))

        def was_disarmed() -> bool:  # another fault may follow at once
            return self.get_lifecycle() == "disarmed" or any(
                received.at_ns > request_ns and received.message.lifecycle == "disarmed"
                for received in self.statuses
            )

        self.wait_until(was_disarmed, "disarmed after reset", RESET_TIMEOUT_S)

    def arm(self, timeout_s: float = DEFAULT_TIMEOUT_S) -> None:
        """Reset, arm as soon as the robot is ready, and wait until the host applies a command.

        On a busy machine, the lease can expire right after arming. This is counted, and arming is repeated.

        Raises:
            TrialError: The robot could not be armed in time.
        """
        deadline_s = time.monotonic() + timeout_s
        while not self._try_to_arm(max(deadline_s - time.monotonic(), 0.1)):
            self.failed_armings += 1
            if time.monotonic() > deadline_s:
                raise TrialError(
                    f"could not be armed within {timeout_s:g} s: {self.describe_status()}"
                )

    def _try_to_arm(self, timeout_s: float) -> bool:
        """Arm once. Return whether the host then applied a command before the robot stopped."""
        self._reset_until_ready(timeout_s)
        description = self.get_description()
        self.forget()
        if self.get_lifecycle() != "armed":
            request = LifecycleRequest(
                action="arm",
                robot=description.robot,
                backend=description.backend,
                config_hash=description.config_hash,
            )
            if not self.send_request(keys.LIFECYCLE, request).ok:
                return False

        def is_moving() -> bool:
            return self.get_lifecycle() == "armed" and self.has_applied_commands()

        def is_stopped() -> bool:  # the status of an earlier stop may also arrive only now
            return self.get_lifecycle() in ("fault", "estop")

        self.wait_until(
            lambda: is_moving() or is_stopped(),
            "commands applied after arming",
            FIRST_COMMAND_TIMEOUT_S,
        )
        return not is_stopped()

    def _reset_until_ready(self, timeout_s: float) -> None:
        """Reset until the robot is ready to arm. Another fault can be reported after a reset.

        The robot may be armed already: a flooded router can lose the answer to an earlier request that armed it.
        """
        deadline_s = time.monotonic() + timeout_s

        def is_ready() -> bool:
            return self.status is not None and (
                self.status.ready_to_arm or self.status.lifecycle == "armed"
            )

        while not is_ready():
            self.reset()
            self.wait_until(
                lambda: is_ready() or self.get_lifecycle() in ("fault", "estop"),
                "ready to arm",
                max(deadline_s - time.monotonic(), 0.1),
            )


def _is_continued(previous: AppliedCommand, applied: AppliedCommand, joint_index: int) -> bool:
    """Return whether a joint also had an angle target in the tick before."""
    is_next_tick = previous.tick == applied.tick - 1
    return is_next_tick and previous.mode[joint_index] is JointMode.POSITION
