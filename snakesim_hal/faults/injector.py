"""Carries out one part's injected faults: those planned by the run, and those requested on the network.

Every part of a run has one: the host, and each service. Times are robot time, so that lockstep repeats them. Planned
times are relative to the first arming. A part that was restarted while the robot was armed drops its plan.
"""

import time
from collections.abc import Callable, Sequence
from math import inf
from queue import Empty, SimpleQueue

import msgspec

from snakesim_hal.base.errors import BackendError, ConfigError, WireError
from snakesim_hal.base.terminal import print_stderr
from snakesim_hal.faults.message_faults import MessageFaults
from snakesim_hal.model.fault_kinds import Change, Injection, Plan, checked
from snakesim_hal.model.fault_plan import planned
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.session import Question, Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder
from snakesim_hal.wire.messages import Answer, Clock, FaultRequest, LifecycleState

HALF_A_NANOSECOND = 0.5e-9

CarryOut = Callable[[Injection, bool], None]  # the second: whether it begins, or ends. Raises ConfigError


def no_action(injection: Injection, _begins: bool) -> None:
    """For a part that supports only message faults and `hang`."""
    raise ConfigError(f"{injection.part} cannot do {injection.kind} to {injection.target}")


def print_note(text: str, now_s: float) -> None:
    """For a part that reports to a log."""
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
        """Declares the part's key.

        newest: the newest clock, also while this part hangs; None: this part is the clock, and wall time is used.
        note: called with each begin and end, and its time.
        """
        self.part = part
        self._messages = MessageFaults(session, config.seed)
        self._carry_out = carry_out
        self._newest = newest
        self._print_note = note
        self.noted: list[str] = []  # the host's have their tick
        self._refused: list[str] = []  # planned, and not possible
        self._planned = Plan(injection for injection in planned(config) if injection.part == part)
        self._ends: list[tuple[float, Injection]] = []  # when requested faults end
        self._on: dict[tuple[str, str], Injection] = {}
        self._decoder = Decoder(FaultRequest)
        self._questions: SimpleQueue[Question] = SimpleQueue()
        self._first_armed_s: float | None = None
        self._lifecycle: LifecycleState = "disarmed"
        self._seen = False
        session.on_question(keys.fault(part), self._questions.put)

    @property
    def on(self) -> list[str]:
        """Active injected faults."""
        return [str(injection) for injection in self._on.values()]

    def turn(self, timestamp_ns: int, arm_session: int, lifecycle: LifecycleState) -> Sequence[str]:
        """At a tick: begin and end due faults, answer requests, and hang if requested. Returns planned ones refused."""
        now_s = timestamp_ns / 1e9
        self._lifecycle = lifecycle
        if arm_session and self._first_armed_s is None:
            self._first_armed_s = now_s
            if not self._seen:
                self._planned = Plan()
        self._seen = True
        self._change(now_s)
        if self._hangs():
            self._hang(now_s)
        refused, self._refused = self._refused, []
        return refused

    def idle(self) -> None:
        """Answer requests while no tick comes."""
        self._answer_all(self._newest_s(0.0))

    def close(self) -> None:
        """Drop delayed messages."""
        self._messages.close()

    def _note(self, text: str, now_s: float) -> None:
        """Report the begin or the end of a fault."""
        self._print_note(text, now_s)

    # --- time ------------------------------------------------------------------------------------------------

    def _newest_s(self, otherwise_s: float) -> float:
        clock = None if self._newest is None else self._newest()
        return otherwise_s if clock is None else clock.timestamp_ns / 1e9

    def _since_arming_s(self, now_s: float) -> float:
        return 0.0 if self._first_armed_s is None else now_s - self._first_armed_s

    def _change(self, now_s: float) -> None:
        if not self._questions.empty():
            self._answer_all(now_s)
        soon_s = now_s + HALF_A_NANOSECOND  # sums of times are not exact
        if self._ends:
            due = [injection for end_s, injection in self._ends if end_s <= soon_s]
            self._ends = [(end_s, injection) for end_s, injection in self._ends if end_s > soon_s]
            self._do([Change(injection.end_s, injection, False) for injection in due], now_s)
        if self._first_armed_s is not None and self._planned.next_s() <= soon_s - self._first_armed_s:
            self._do(self._planned.until(soon_s - self._first_armed_s), now_s)

    def _do(self, changes: list[Change], now_s: float) -> None:
        for change in changes:
            try:
                if change.begins:
                    self._begin(change.injection, now_s)
                else:
                    self._end(change.injection, now_s)
            except (ConfigError, BackendError) as error:
                self._note(f"{change.injection} is refused: {error}", now_s)
                self._refused.append(f"{change.injection} is refused: {error}")

    # --- requests --------------------------------------------------------------------------------------------

    def _answer_all(self, now_s: float) -> None:
        while True:
            try:
                question = self._questions.get_nowait()
            except Empty:
                return
            try:
                request = self._decoder.decode(question.payload, question.encoding)
                answer = self._answer(request, now_s)
            except WireError as error:
                answer = self._no(str(error), error.reason)
            except (ConfigError, BackendError) as error:
                answer = self._no(str(error), "cannot")
            question.reply(msgspec.structs.replace(answer, lifecycle=self._lifecycle))

    def _answer(self, request: FaultRequest, now_s: float) -> Answer:
        start_s, for_s = self._since_arming_s(now_s), inf if request.for_s is None else request.for_s
        injection = checked(Injection(request.kind, request.target, start_s, start_s + for_s, request.amount))
        if injection.part != self.part:
            return self._no(f"{injection.kind} of {injection.target} is carried out by {injection.part}", "wrong_part")
        if not request.end:
            self._begin(injection, now_s)
            if for_s != inf and not injection.about.once:
                self._ends.append((now_s + for_s, injection))
            return Answer(
                ok=True, reason=f"{injection.kind} of {injection.target} has begun, at {now_s:.3f} s of robot time"
            )
        was = self._on.get((injection.kind, injection.target))
        if was is None:
            on = ", ".join(self.on) or "nothing"
            return self._no(f"{injection.kind} of {injection.target} is not active; active: {on}", "wrong_state")
        self._end(was, now_s)
        return Answer(ok=True, reason=f"{injection.kind} of {injection.target} has ended")

    def _no(self, reason: str, refusal: str) -> Answer:
        return Answer(ok=False, reason=reason[:500], refusal=refusal)

    # --- faults ----------------------------------------------------------------------------------------------

    def _begin(self, injection: Injection, now_s: float) -> None:
        if injection.target_type == "key":
            self._messages.begin(injection)
        elif injection.target_type != "process":
            self._carry_out(injection, True)
        if not injection.about.once:
            self._on[injection.kind, injection.target] = injection
        self._note(f"{injection} {'happens' if injection.about.once else 'begins'}", now_s)

    def _end(self, injection: Injection, now_s: float) -> None:
        """End a fault, unless a newer one of the same kind has replaced it, or a request has ended it."""
        place = injection.kind, injection.target
        if self._on.get(place) is not injection:
            return
        del self._on[place]
        if injection.target_type == "key":
            self._messages.end(injection)
        elif injection.target_type != "process":
            self._carry_out(injection, False)
        self._note(f"{injection} ends", now_s)

    def _hangs(self) -> bool:
        return any(kind == "hang" for kind, _ in self._on)

    def _hang(self, began_s: float) -> None:
        """Keep the interpreter busy. Only a request to end it is processed."""
        began = time.monotonic()
        while self._hangs():
            wall_s = began_s + time.monotonic() - began
            self._change(wall_s if self._newest is None else self._newest_s(began_s))
