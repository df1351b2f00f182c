"""The operator of a soak: injects one fault after the other, watches what follows, and recovers the robot."""

import time
from typing import BinaryIO

import msgspec

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Answer, LifecycleRequest, Message, RobotStatus
from verification.faults.observer import TrialError
from verification.soak.faults import EventDrawer, SoakEvent
from verification.soak.health import ProcessHealth
from verification.soak.result import EventOutcome, SoakResult
from verification.soak.watch import JudgingObserver

SETTLING_S = 1.0  # after a fault has ended, until its consequences must be visible
MAX_RECOVERY_S = 60.0  # which includes the back-off of a supervisor
RECOVERY_POLL_PERIOD_S = 0.1
MIN_APPLIED_COMMANDS = 50  # of a controller, until the robot counts as recovered
MAX_MOVING_S = 5.0  # in which they must be applied
MOVING_POLL_PERIOD_S = 0.05
MAX_STATUS_AGE_NS = 1_000_000_000  # an older status may be one of a host that has ended
REQUEST_TIMEOUT_S = 5.0
RETRY_DELAY_S = 0.2
WATCH_PERIOD_S = 0.01
MAX_VIOLATIONS = 20  # until the soak ends
# Refusals of an injector that cannot inject a fault with this backend.
IMPOSSIBLE_REFUSALS = ("cannot", "unknown_fault", "not_permitted")
# Refusals of a request to end a fault that has already ended, for example because its process has been restarted.
ENDED_REFUSALS = ("wrong_state", "not_on", "unknown_fault")


class SoakOperator:
    """Injects faults and recovers the robot, while it watches the robot all the time."""

    def __init__(
        self, watch: JudgingObserver, health: ProcessHealth, result: SoakResult, log: BinaryIO
    ) -> None:
        """Create the operator.

        Args:
            watch: Observes and judges the messages of the robot.
            health: Measures the processes of the run.
            result: Gets all outcomes and violations.
            log: A file for the outcomes, one a line.
        """
        self._watch = watch
        self._health = health
        self._result = result
        self._log = log
        self._start_s = time.monotonic()

    def run(self, drawer: EventDrawer, duration_s: float) -> None:
        """Inject faults until the time is over, there are too many violations, or the robot does not recover."""
        for event in drawer.draw_events():
            is_over = time.monotonic() - self._start_s > duration_s
            if is_over or len(self._result.violations) >= MAX_VIOLATIONS:
                return
            self._watch_for(event.pause_s)
            answer = self._send_request(keys.fault_key(event.part), event.request)
            if not answer.ok:
                self._note_refusal(drawer, event, answer)
                continue
            outcome = self._watch_event(event, answer)
            self._result.outcomes.append(outcome)
            self._log.write(msgspec.json.encode(outcome) + b"\n")
            self._log.flush()
            if outcome.recovery_s is None:
                return

    def _note_refusal(self, drawer: EventDrawer, event: SoakEvent, answer: Answer) -> None:
        """Rule a fault out that the backend cannot inject; any other refusal is a violation."""
        if answer.refusal in IMPOSSIBLE_REFUSALS:
            drawer.rule_out(event)
            fault = f"{event.request.kind}:{event.request.target}"
            self._result.impossible_faults[f"{fault}: {answer.reason}"] += 1
        else:
            self._add_violations(event, [f"the injector refuses: {answer.reason}"])

    def _watch_event(self, event: SoakEvent, answer: Answer) -> EventOutcome:
        """Watch what follows from an injected fault, recover the robot, and report all violations."""
        outcome = EventOutcome(
            time_s=round(time.monotonic() - self._start_s, 3),
            event=str(event),
            consequence=event.consequence,
            answer=answer.reason,
        )
        try:
            self._await_consequences(event, outcome)
        except TrialError as error:
            outcome.violations.append(str(error))
        outcome.violations += self._watch.violations
        self._watch.violations.clear()
        self._add_violations(event, outcome.violations)
        return outcome

    def _await_consequences(self, event: SoakEvent, outcome: EventOutcome) -> None:
        """Wait until the fault has ended, judge how it was explained, and recover the robot."""
        watch = self._watch
        begin_ns = time.monotonic_ns()
        watch.ignored_keys = {event.request.target}
        tick_before = watch.status.tick if watch.status is not None else 0
        self._watch_for(event.duration_s)
        self._end_fault(event, outcome)
        self._watch_for(SETTLING_S)
        was_restarted = watch.status is not None and watch.status.tick < tick_before
        if was_restarted:
            watch.start_over()
        statuses = [received.message for received in watch.statuses if received.at_ns >= begin_ns]
        self._judge_statuses(event, outcome, statuses, was_restarted=was_restarted)
        self._recover()
        watch.ignored_keys = set()
        outcome.final_status = watch.describe_status()
        elapsed_s = (time.monotonic_ns() - begin_ns) * 1e-9
        outcome.recovery_s = round(elapsed_s - event.duration_s - SETTLING_S, 3)

    def _end_fault(self, event: SoakEvent, outcome: EventOutcome) -> None:
        """Request the end of a fault that does not end by itself."""
        if event.end_request is None:
            return
        answer = self._send_request(keys.fault_key(event.part), event.end_request)
        if not answer.ok and answer.refusal not in ENDED_REFUSALS:
            outcome.violations.append(f"its end was refused: {answer.reason}")

    def _judge_statuses(
        self,
        event: SoakEvent,
        outcome: EventOutcome,
        statuses: list[RobotStatus],
        *,
        was_restarted: bool,
    ) -> None:
        """Judge whether the robot has stopped if it must, and whether the causes name the fault."""
        first_fault = next((status for status in statuses if status.lifecycle == "fault"), None)
        was_disarmed = any(status.lifecycle == "disarmed" for status in statuses)
        outcome.detected = first_fault is not None or was_restarted or was_disarmed
        if first_fault is not None:
            outcome.causes = [fault.cause for fault in first_fault.faults]
            joints = [f"{fault.joint}" for fault in first_fault.faults]
            explanation = " ".join((first_fault.reason, *outcome.causes, *joints))
            if not any(name in explanation for name in event.expected_names):
                expected = ", ".join(event.expected_names)
                outcome.violations.append(f"no cause names one of {expected}: {explanation}")
        if event.consequence == "stop" and not outcome.detected:
            outcome.violations.append(
                f"the robot had to stop, and did not: {self._watch.describe_status()}"
            )

    def _recover(self) -> None:
        """Recover the robot as a person does: reset it, wait until it is ready, arm it, and see it move.

        Raises:
            TrialError: The robot did not recover within MAX_RECOVERY_S.
        """
        watch = self._watch
        deadline_s = time.monotonic() + MAX_RECOVERY_S
        last_answer = ""
        while True:
            if time.monotonic() > deadline_s:
                raise TrialError(
                    f"not recovered within {MAX_RECOVERY_S:g} s: {watch.describe_status()}; {last_answer}"
                )
            self._watch_for(RECOVERY_POLL_PERIOD_S)
            status = watch.status
            if status is None or status.waiting_for or not self._has_fresh_status():
                continue
            if status.lifecycle == "armed":
                if self._is_moving():
                    return
            elif status.lifecycle in ("fault", "estop"):
                request = LifecycleRequest(action="reset")
                last_answer = self._send_request(keys.LIFECYCLE, request).reason
            elif status.ready_to_arm:
                request = LifecycleRequest(
                    action="arm",
                    robot=status.robot,
                    backend=status.backend,
                    config_hash=watch.get_description().config_hash,
                )
                last_answer = self._send_request(keys.LIFECYCLE, request).reason

    def _has_fresh_status(self) -> bool:
        """Return whether the newest status is recent, and not one of a host that has ended."""
        statuses = self._watch.statuses
        return bool(statuses) and time.monotonic_ns() - statuses[-1].at_ns < MAX_STATUS_AGE_NS

    def _is_moving(self) -> bool:
        """Return whether commands of a controller are applied tick after tick."""
        watch = self._watch
        count_before = watch.controller_command_count
        deadline_s = time.monotonic() + MAX_MOVING_S
        while time.monotonic() < deadline_s:
            self._watch_for(MOVING_POLL_PERIOD_S)
            if watch.get_lifecycle() != "armed":
                return False
            if watch.controller_command_count - count_before >= MIN_APPLIED_COMMANDS:
                return True
        return False

    def _send_request(self, key: str, request: Message) -> Answer:
        """Send a request until it is answered: a process that was just started answers a little later."""
        deadline_s = time.monotonic() + MAX_RECOVERY_S
        while True:
            try:
                return self._watch.session.send_request(key, request, timeout_s=REQUEST_TIMEOUT_S)
            except NotConnectedError as error:
                if time.monotonic() > deadline_s:
                    return Answer(ok=False, reason=str(error), refusal="no_answer")
                self._watch_for(RETRY_DELAY_S)

    def _watch_for(self, duration_s: float) -> None:
        """Watch messages and processes for a while, at least once."""
        end_s = time.monotonic() + duration_s
        while True:
            self._watch.listen()
            self._health.measure_when_due()
            remaining_s = end_s - time.monotonic()
            if remaining_s <= 0:
                return
            time.sleep(min(remaining_s, WATCH_PERIOD_S))

    def _add_violations(self, event: SoakEvent, violations: list[str]) -> None:
        for text in violations:
            violation = f"seed {self._result.seed}, {event}: {text}"
            print(f"VIOLATION {violation}", flush=True)
            self._result.violations.append(violation)
