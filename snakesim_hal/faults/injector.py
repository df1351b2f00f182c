"""Carries out one part's injected faults: those planned by the run, and those requested on the network.

Every part of a run has one: the host, and each service. Times are robot time, so that lockstep repeats them. Planned
times are relative to the first arming. A part that was restarted while the robot was armed drops its plan.

Threads: the part calls every method from the thread of its loop. Zenoh's thread only puts requests into a queue, which
`turn` and `idle` read.
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
from snakesim_hal.model.fault_kinds import Change, Injection, InjectionPlan, check_injection
from snakesim_hal.model.fault_plan import parse_planned
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.session import Session
from snakesim_hal.network.streams import Query
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder
from snakesim_hal.wire.messages import Answer, Clock, FaultRequest, LifecycleState

HALF_A_NANOSECOND = 0.5e-9

NEVER_S = inf


class CarryOut(Protocol):
    """Begins or ends a fault. Raises ConfigError if that is not possible."""

    def __call__(self, injection: Injection, *, begins: bool) -> object: ...


def no_action(injection: Injection, *, begins: bool) -> None:
    """Refuse a fault, in a part that supports only message faults and `hang`."""
    raise ConfigError(
        f"{injection.part} cannot do {injection.kind} to {injection.target}", code="injection/not-supported"
    )


def print_note(text: str, now_s: float) -> None:
    """Write the begin or the end of a fault to the log, in a part that has no other record."""
    print_stderr(f"{now_s:.3f} s: injected: {text}")


class Injector:
    """The injector of one part. Call `turn` once in every cycle of the part's loop."""

    def __init__(
        self,
        part: str,
        config: RunConfig,
        session: Session,
        *,
        carry_out: CarryOut = no_action,
        newest: Callable[[], Clock | None] | None = None,
        note: Callable[[str, float], None] = print_note,
    ) -> None:
        """Declare the part's key for requests.

        Args:
            part: name of the service, or of the host.
            config: of the run, with its planned faults.
            session: of the part; its messages can be disturbed.
            carry_out: begins and ends faults that concern neither messages nor the process.
            newest: returns the newest clock, also while this part hangs; None: this part is the clock, and wall time
                is used.
            note: is called with each begin and end, and its time in s.
        """
        # What carries out and reports faults.
        self.part = part
        self._messages = MessageFaults(session, config.seed)
        self._carry_out = carry_out
        self._newest = newest
        self._print_note = note
        self.notes: list[str] = []  # the host's have their tick
        # Faults.
        self._planned = InjectionPlan(injection for injection in parse_planned(config) if injection.part == part)
        self._refused: list[str] = []  # planned, and not possible; reported by the next `turn`
        self._ends: list[tuple[float, Injection]] = []  # robot time in s at which each requested fault ends
        self._active: dict[tuple[str, str], Injection] = {}  # by kind and target
        # Requests.
        self._decoder = Decoder(FaultRequest)
        self._questions: SimpleQueue[Query] = SimpleQueue()
        # The robot.
        self._first_armed_s: float | None = None
        self._lifecycle: LifecycleState = "disarmed"
        self._has_ticked = False
        session.on_query(keys.fault_key(part), self._questions.put)

    @property
    def active(self) -> list[str]:
        """Return the active injected faults as texts."""
        return [str(injection) for injection in self._active.values()]

    def update(self, timestamp_ns: int, arm_session: int, lifecycle: LifecycleState) -> Sequence[str]:
        """Begin and end the faults that are due at a tick, answer requests, and hang if a fault requires it.

        Args:
            timestamp_ns: robot time of the tick.
            arm_session: of the robot's clock; 0: never armed.
            lifecycle: state of the robot.

        Returns:
            Planned faults that could not be carried out, with the reason.
        """
        now_s = timestamp_ns / 1e9
        self._lifecycle = lifecycle
        if arm_session and self._first_armed_s is None:
            self._first_armed_s = now_s
            if not self._has_ticked:  # restarted while the robot was armed
                self._planned = InjectionPlan()
        self._has_ticked = True
        self._apply_changes(now_s)
        if self._hangs():
            self._hang(now_s)
        refused = self._refused
        self._refused = []
        return refused

    def answer_requests(self) -> None:
        """Answer requests while no tick comes."""
        self._answer_all(self._newest_s(0.0))

    def close(self) -> None:
        """Drop delayed messages."""
        self._messages.close()

    def _note(self, text: str, now_s: float) -> None:
        """Report the begin or the end of a fault."""
        self._print_note(text, now_s)

    # --- time ------------------------------------------------------------------------------------------------

    def _newest_s(self, default_s: float) -> float:
        """Return the robot time of the newest clock, or the default without one."""
        clock = None if self._newest is None else self._newest()
        if clock is None:
            return default_s
        return clock.timestamp_ns / 1e9

    def _since_arming_s(self, now_s: float) -> float:
        if self._first_armed_s is None:
            return 0.0
        return now_s - self._first_armed_s

    def _apply_changes(self, now_s: float) -> None:
        """Answer requests, then end requested faults and begin or end planned ones that are due."""
        if not self._questions.empty():
            self._answer_all(now_s)
        soon_s = now_s + HALF_A_NANOSECOND  # sums of times are not exact
        if self._ends:
            due = [injection for end_s, injection in self._ends if end_s <= soon_s]
            self._ends = [(end_s, injection) for end_s, injection in self._ends if end_s > soon_s]
            self._carry_out_all([Change(injection.end_s, injection, False) for injection in due], now_s)
        if self._first_armed_s is not None and self._planned.next_s() <= soon_s - self._first_armed_s:
            self._carry_out_all(self._planned.until(soon_s - self._first_armed_s), now_s)

    def _carry_out_all(self, changes: list[Change], now_s: float) -> None:
        for change in changes:
            try:
                if change.begins:
                    self._begin(change.injection, now_s)
                else:
                    self._end(change.injection, now_s)
            except (ConfigError, BackendError) as error:
                refusal = f"{change.injection} is refused: {error}"
                self._note(refusal, now_s)
                self._refused.append(refusal)

    # --- requests --------------------------------------------------------------------------------------------

    def _answer_all(self, now_s: float) -> None:
        while True:
            try:
                question = self._questions.get_nowait()
            except Empty:
                return
            answer = self._answer_question(question, now_s)
            question.reply(msgspec.structs.replace(answer, lifecycle=self._lifecycle))

    def _answer_question(self, question: Query, now_s: float) -> Answer:
        """Decode a request and carry it out; every error becomes a refusal."""
        try:
            request = self._decoder.decode(question.payload, question.encoding)
            return self._carry_out_request(request, now_s)
        except WireError as error:
            return _refuse(str(error), refusal=error.reason)
        except (ConfigError, BackendError) as error:
            return _refuse(str(error), refusal="cannot")

    def _carry_out_request(self, request: FaultRequest, now_s: float) -> Answer:
        """Begin or end the requested fault.

        Raises:
            ConfigError: the request is not valid, or cannot be carried out here.
        """
        start_s = self._since_arming_s(now_s)
        duration_s = NEVER_S if request.for_s is None else request.for_s
        injection = check_injection(
            Injection(request.kind, request.target, start_s, start_s + duration_s, request.amount)
        )
        name = f"{injection.kind} of {injection.target}"
        if injection.part != self.part:
            return _refuse(f"{name} is carried out by {injection.part}", refusal="wrong_part")
        if request.end:
            return self._end_on_request(injection, now_s)
        self._begin(injection, now_s)
        if duration_s != NEVER_S and not injection.about.once:
            self._ends.append((now_s + duration_s, injection))
        return Answer(ok=True, reason=f"{name} has begun, at {now_s:.3f} s of robot time")

    def _end_on_request(self, injection: Injection, now_s: float) -> Answer:
        name = f"{injection.kind} of {injection.target}"
        active = self._active.get((injection.kind, injection.target))
        if active is None:
            names = ", ".join(self.active) or "nothing"
            return _refuse(f"{name} is not active; active: {names}", refusal="wrong_state")
        self._end(active, now_s)
        return Answer(ok=True, reason=f"{name} has ended")

    # --- faults ----------------------------------------------------------------------------------------------

    def _begin(self, injection: Injection, now_s: float) -> None:
        match injection.target_type:
            case "key":
                self._messages.begin(injection)
            case "process":
                pass  # `turn` hangs while the fault is active
            case _:
                self._carry_out(injection, begins=True)
        if injection.about.once:
            self._note(f"{injection} happens", now_s)
        else:
            self._active[injection.kind, injection.target] = injection
            self._note(f"{injection} begins", now_s)

    def _end(self, injection: Injection, now_s: float) -> None:
        """End a fault, unless a newer one of the same kind has replaced it, or a request has ended it."""
        name = injection.kind, injection.target
        if self._active.get(name) is not injection:
            return
        del self._active[name]
        match injection.target_type:
            case "key":
                self._messages.end(injection)
            case "process":
                pass
            case _:
                self._carry_out(injection, begins=False)
        self._note(f"{injection} ends", now_s)

    def _hangs(self) -> bool:
        return any(kind == "hang" for kind, _ in self._active)

    def _hang(self, began_s: float) -> None:
        """Keep the interpreter busy. Only the planned end, or a request, ends it."""
        began_monotonic_s = time.monotonic()
        while self._hangs():
            wall_s = began_s + time.monotonic() - began_monotonic_s
            now_s = wall_s if self._newest is None else self._newest_s(began_s)
            self._apply_changes(now_s)


def _refuse(reason: str, *, refusal: str) -> Answer:
    """Return a refusal, with its text and its code."""
    return Answer(ok=False, reason=reason[:500], refusal=refusal)
