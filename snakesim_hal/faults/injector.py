"""Carries out one part's injected faults: those planned by the run, and those requested on the network.

Every part of a run has one: the host, and each service. Times are robot time, so that lockstep repeats them. Planned
times are relative to the first arming. A part that was restarted while the robot was armed drops its plan.

Threads: the part calls every method from the thread of its loop. Zenoh's thread only puts requests into a queue, which
`update` and `answer_requests` read.
"""

import time
from collections.abc import Callable, Sequence
from math import inf
from queue import Empty, SimpleQueue
from typing import Protocol

import msgspec

from snakesim_hal.base.errors import BackendError, ConfigError, WireError
from snakesim_hal.base.terminal import print_stderr
from snakesim_hal.faults.message_faults import MessageFaults
from snakesim_hal.model.fault_kinds import (
    FaultInjection,
    FaultTransition,
    InjectionPlan,
    validate_and_complete_injection,
)
from snakesim_hal.model.fault_plan import parse_planned_faults
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.session import Session
from snakesim_hal.network.streams import IncomingQuery
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MessageDecoder
from snakesim_hal.wire.messages import Answer, Clock, FaultRequest, LifecycleState

TIME_TOLERANCE_S = 0.5e-9  # half of the resolution of timestamps
MAX_REASON_LENGTH = 500  # characters, as the message Answer allows


class ApplyFault(Protocol):
    """Starts or ends a fault. Raises ConfigError if that is not possible."""

    def __call__(self, injection: FaultInjection, *, begins: bool) -> object: ...


def refuse_fault(injection: FaultInjection, *, begins: bool) -> None:
    """Refuse a fault, in a part that supports only message faults and `hang`."""
    raise ConfigError(
        f"{injection.executing_part} cannot do {injection.kind} to {injection.target}",
        code="injection/not-supported",
    )


def print_event(text: str, now_s: float) -> None:
    """Print the start or the end of a fault to stderr, in a part of the run that has no other log."""
    print_stderr(f"{now_s:.3f} s: injected: {text}")


class FaultInjector:
    """Injects the planned and requested faults of one part of a run. Call `update` once in every cycle of its loop."""

    def __init__(
        self,
        part: str,
        config: RunConfig,
        session: Session,
        *,
        apply_fault: ApplyFault = refuse_fault,
        read_newest_clock: Callable[[], Clock | None] | None = None,
        report_event: Callable[[str, float], None] = print_event,
    ) -> None:
        """Read the planned faults of this part, and declare the key on which it receives requests for faults.

        Args:
            part: Name of the part of the run: a service, or the host.
            config: Run configuration with the planned faults.
            session: Network session of the part. Message faults are applied to what it publishes.
            apply_fault: Function that starts or ends a fault that concerns neither messages nor the process. The
                default refuses such faults.
            read_newest_clock: Function that returns the newest clock message, also while this part hangs. None in the
                host, which publishes the clock: while the host hangs, its robot time follows the wall clock.
            report_event: Function that is called with a text and the robot time in s when a fault starts or ends.
        """
        # What applies and reports faults.
        self.part = part
        self._message_faults = MessageFaults(session, config.seed)
        self._apply_fault = apply_fault
        self._read_newest_clock = read_newest_clock
        self._report_event = report_event
        self.notes: list[str] = []  # starts and ends of faults; only the host fills it
        # Faults.
        self._plan = InjectionPlan(
            injection
            for injection in parse_planned_faults(config)
            if injection.executing_part == part
        )
        # Planned faults that are not possible; the next `update` returns them.
        self._new_refusals: list[str] = []
        # End in robot time (s), and the requested fault.
        self._scheduled_ends: list[tuple[float, FaultInjection]] = []
        self._active_faults: dict[tuple[str, str], FaultInjection] = {}  # by kind and target
        # Requests.
        self._decoder = MessageDecoder(FaultRequest)
        self._request_queue: SimpleQueue[IncomingQuery] = SimpleQueue()
        # The robot.
        self._first_armed_s: float | None = None
        self._lifecycle: LifecycleState = "disarmed"
        self._has_ticked = False
        session.on_query(keys.fault_key(part), self._request_queue.put)

    @property
    def active(self) -> list[str]:
        """Return the active injected faults as texts."""
        return [str(injection) for injection in self._active_faults.values()]

    def update(
        self, timestamp_ns: int, arm_session: int, lifecycle: LifecycleState
    ) -> Sequence[str]:
        """Start and end the faults that are due at a tick, answer requests, and hang if a fault requires it.

        Args:
            timestamp_ns: Robot time of the tick.
            arm_session: Number of the arm session from the robot's clock. 0 if the robot was never armed.
            lifecycle: Lifecycle state of the robot.

        Returns:
            Texts about planned faults that could not be started or ended since the last call, each with the reason.
        """
        now_s = timestamp_ns / 1e9
        self._lifecycle = lifecycle
        if arm_session and self._first_armed_s is None:
            self._first_armed_s = now_s
            # This part was restarted while the robot was armed: the first arming is unknown.
            if not self._has_ticked:
                self._plan = InjectionPlan()
        self._has_ticked = True
        self._apply_due_transitions(now_s)
        if self._should_hang():
            self._hang_until_ended(now_s)
        refusals = self._new_refusals
        self._new_refusals = []
        return refusals

    def answer_requests(self) -> None:
        """Answer requests while no tick comes."""
        self._answer_queued_requests(self._read_newest_time_s(0.0))

    def close(self) -> None:
        """Drop delayed messages."""
        self._message_faults.close()

    def _record_event(self, text: str, now_s: float) -> None:
        """Report the start or the end of a fault. A subclass may keep it instead."""
        self._report_event(text, now_s)

    # --- time ------------------------------------------------------------------------------------------------

    def _read_newest_time_s(self, default_s: float) -> float:
        """Return the robot time of the newest clock message, or the default if there is no such message."""
        clock = None if self._read_newest_clock is None else self._read_newest_clock()
        if clock is None:
            return default_s
        return clock.timestamp_ns / 1e9

    def _compute_time_since_arming_s(self, now_s: float) -> float:
        """Return the time since the first arming; 0 before it."""
        if self._first_armed_s is None:
            return 0.0
        return now_s - self._first_armed_s

    def _apply_due_transitions(self, now_s: float) -> None:
        """Answer queued requests, then end requested faults and start or end planned faults that are due."""
        if not self._request_queue.empty():
            self._answer_queued_requests(now_s)
        latest_s = now_s + TIME_TOLERANCE_S  # sums of times are not exact
        if self._scheduled_ends:
            due = [injection for end_s, injection in self._scheduled_ends if end_s <= latest_s]
            self._scheduled_ends = [
                (end_s, injection) for end_s, injection in self._scheduled_ends if end_s > latest_s
            ]
            self._apply_transitions(
                [FaultTransition(injection.end_s, injection, False) for injection in due], now_s
            )
        if (
            self._first_armed_s is not None
            and self._plan.next_transition_s() <= latest_s - self._first_armed_s
        ):
            self._apply_transitions(
                self._plan.pop_due_transitions(latest_s - self._first_armed_s), now_s
            )

    def _apply_transitions(self, transitions: list[FaultTransition], now_s: float) -> None:
        """Start or end faults. A fault that is refused is reported, and `update` returns it."""
        for transition in transitions:
            try:
                if transition.is_start:
                    self._start_fault(transition.injection, now_s)
                else:
                    self._end_fault(transition.injection, now_s)
            except (ConfigError, BackendError) as error:
                refusal = f"{transition.injection} is refused: {error}"
                self._record_event(refusal, now_s)
                self._new_refusals.append(refusal)

    # --- requests --------------------------------------------------------------------------------------------

    def _answer_queued_requests(self, now_s: float) -> None:
        """Handle all queued requests, and reply to each."""
        while True:
            try:
                query = self._request_queue.get_nowait()
            except Empty:
                return
            answer = self._handle_query(query, now_s)
            query.reply(msgspec.structs.replace(answer, lifecycle=self._lifecycle))

    def _handle_query(self, query: IncomingQuery, now_s: float) -> Answer:
        """Decode a request, start or end its fault, and return the answer. Every error becomes a refusal."""
        try:
            request = self._decoder.decode(query.payload, query.encoding)
            return self._apply_request(request, now_s)
        except WireError as error:
            return _make_refusal(str(error), refusal=error.reason)
        except (ConfigError, BackendError) as error:
            return _make_refusal(str(error), refusal="cannot")

    def _apply_request(self, request: FaultRequest, now_s: float) -> Answer:
        """Start or end the requested fault, and schedule its end if the request has a duration.

        Args:
            request: Request with kind, target, amount and duration of the fault.
            now_s: Current robot time.

        Returns:
            The answer. It refuses a fault that another part of the run carries out, and the end of a fault that is not
            active.

        Raises:
            ConfigError: The request is not valid, or this part cannot inject the fault.
        """
        start_s = self._compute_time_since_arming_s(now_s)
        duration_s = inf if request.for_s is None else request.for_s
        injection = validate_and_complete_injection(
            FaultInjection(
                request.kind, request.target, start_s, start_s + duration_s, request.amount
            )
        )
        fault_name = f"{injection.kind} of {injection.target}"
        if injection.executing_part != self.part:
            return _make_refusal(
                f"{fault_name} is carried out by {injection.executing_part}", refusal="wrong_part"
            )
        if request.end:
            return self._end_requested_fault(injection, now_s)
        self._start_fault(injection, now_s)
        if duration_s != inf and not injection.kind_info.is_instantaneous:
            self._scheduled_ends.append((now_s + duration_s, injection))
        return Answer(ok=True, reason=f"{fault_name} has begun, at {now_s:.3f} s of robot time")

    def _end_requested_fault(self, injection: FaultInjection, now_s: float) -> Answer:
        """End the active fault of this kind and target, or return a refusal if there is none."""
        fault_name = f"{injection.kind} of {injection.target}"
        active = self._active_faults.get((injection.kind, injection.target))
        if active is None:
            active_names = ", ".join(self.active) or "nothing"
            return _make_refusal(
                f"{fault_name} is not active; active: {active_names}", refusal="wrong_state"
            )
        self._end_fault(active, now_s)
        return Answer(ok=True, reason=f"{fault_name} has ended")

    # --- faults ----------------------------------------------------------------------------------------------

    def _start_fault(self, injection: FaultInjection, now_s: float) -> None:
        """Start a fault and report it. Raises ConfigError or BackendError if it is not possible."""
        match injection.target_type:
            case "key":
                self._message_faults.begin(injection)
            case "process":
                pass  # `update` hangs while the fault is active
            case _:
                self._apply_fault(injection, begins=True)
        if injection.kind_info.is_instantaneous:
            self._record_event(f"{injection} happens", now_s)
        else:
            self._active_faults[injection.kind, injection.target] = injection
            self._record_event(f"{injection} begins", now_s)

    def _end_fault(self, injection: FaultInjection, now_s: float) -> None:
        """End a fault and report it, unless a newer fault has replaced it, or a request has ended it."""
        fault_key = injection.kind, injection.target
        if self._active_faults.get(fault_key) is not injection:
            return
        del self._active_faults[fault_key]
        match injection.target_type:
            case "key":
                self._message_faults.end(injection)
            case "process":
                pass
            case _:
                self._apply_fault(injection, begins=False)
        self._record_event(f"{injection} ends", now_s)

    def _should_hang(self) -> bool:
        return any(kind == "hang" for kind, _ in self._active_faults)

    def _hang_until_ended(self, start_s: float) -> None:
        """Keep the interpreter busy until the planned end of the fault, or until a request ends it."""
        start_monotonic_s = time.monotonic()
        while self._should_hang():
            wall_time_s = start_s + time.monotonic() - start_monotonic_s
            now_s = (
                wall_time_s
                if self._read_newest_clock is None
                else self._read_newest_time_s(start_s)
            )
            self._apply_due_transitions(now_s)


def _make_refusal(reason: str, *, refusal: str) -> Answer:
    """Return the answer that refuses a request, with the reason as a text and as a code."""
    return Answer(ok=False, reason=reason[:MAX_REASON_LENGTH], refusal=refusal)
