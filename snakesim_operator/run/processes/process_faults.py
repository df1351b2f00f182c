"""Injects the faults that need the supervisor: kills, stops or freezes processes, and steps the wall clock.

Planned faults start at a robot time since the first arming. The duration of a freeze is wall-clock time, because robot
time is paused while the host is frozen or waits for a frozen service.
"""

import signal
import time
from collections.abc import Callable
from math import inf
from queue import SimpleQueue

from snakesim_hal.base.errors import ConfigError, RefusedError, WireError
from snakesim_hal.base.process import step_wall_clock
from snakesim_hal.model.fault_kinds import (
    RUN,
    FaultInjection,
    InjectionPlan,
    validate_and_complete_injection,
)
from snakesim_hal.model.fault_plan import parse_planned_faults
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.session import Session
from snakesim_hal.network.streams import IncomingQuery
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MessageDecoder
from snakesim_hal.wire.messages import Answer, Clock, FaultRequest, LifecycleState, RobotDescription
from snakesim_operator.run.processes.supervisor import RunSupervisor

REQUEST_ROUTING_PROCESSES = ("host", "router")
MAX_REASON_CHARACTERS = 500
SIGNALS = {"kill": signal.SIGKILL, "stop": signal.SIGTERM, "freeze": signal.SIGSTOP}


class RobotTime:
    """Counts robot time since the first arming, also across restarts of the host. It advances with clock messages."""

    def __init__(self, session: Session) -> None:
        self._clocks = session.declare_reader(keys.CLOCK, Clock)
        self._last_ns: int | None = None  # None before the first arming
        self._elapsed_ns = 0

    def get_elapsed_s(self) -> float | None:
        """Return the robot time since the first arming in s; None before the first arming."""
        for clock in self._clocks.drain():
            if self._last_ns is None:
                if clock.arm_session:
                    self._last_ns = clock.timestamp_ns
                continue
            self._elapsed_ns += max(clock.timestamp_ns - self._last_ns, 0)
            self._last_ns = clock.timestamp_ns
        if self._last_ns is None:
            return None
        return self._elapsed_ns * 1e-9


class ProcessFaults:
    """Injects the faults that the scenario plans, and those that clients request on `fault/run`."""

    def __init__(
        self,
        config: RunConfig,
        session: Session,
        supervisor: RunSupervisor,
        print_text: Callable[[str], None],
    ) -> None:
        """Prepare the faults of processes that the scenario plans, and accept requests for further ones.

        Args:
            config: Configuration of the run, with the planned faults, and whether clients may request faults.
            session: Session on the network of the run.
            supervisor: Supervisor of the processes that are killed, stopped or frozen.
            print_text: Prints a line.
        """
        self._is_injection_allowed = config.allow_fault_injection
        self._supervisor = supervisor
        self._print_text = print_text
        self._plan = InjectionPlan(
            injection
            for injection in parse_planned_faults(config)
            if injection.executing_part == RUN
        )
        # Each clock message wakes this process.
        self._time = RobotTime(session) if self._has_plan() else None
        # Name of a process -> monotonic time at which it continues.
        self._resume_time_by_process: dict[str, float] = {}
        # Begin at the next `apply_due_faults`.
        self._requested_injections: list[FaultInjection] = []
        self._clock_offset_s = 0.0
        self._decoder = MessageDecoder(FaultRequest)
        self._queries: SimpleQueue[IncomingQuery] = SimpleQueue()
        session.on_query(keys.fault_key(RUN), self._queries.put)

    def describe_refusal(self, robot: RobotDescription) -> str | None:
        """Describe why the planned faults are not allowed on a robot; None if they are, or if there are none."""
        if not self._has_plan():
            return None
        return self._describe_prohibition(robot)

    def _has_plan(self) -> bool:
        """Return whether a planned fault has not started yet."""
        return self._plan.next_transition_s() != inf

    def apply_due_faults(self, robot: RobotDescription | None, lifecycle: LifecycleState) -> None:
        """Start and end the faults that are due, and respond to requests.

        Args:
            robot: Description of the robot; None while it is unknown.
            lifecycle: State of the robot, for the responses.

        Raises:
            RefusedError: A planned fault is not permitted.
        """
        self._start_planned_faults()
        while self._requested_injections:
            self._start_fault(self._requested_injections.pop(0))
        for name, resume_time_s in list(self._resume_time_by_process.items()):
            if resume_time_s <= time.monotonic():
                self._resume_process(name)
        for _ in range(self._queries.qsize()):
            query = self._queries.get()
            query.reply(self._handle_request(query, robot, lifecycle))

    def _start_planned_faults(self) -> None:
        """Start the planned faults that are due in robot time."""
        now_s = None if self._time is None else self._time.get_elapsed_s()
        if now_s is None:
            return
        for change in self._plan.pop_due_transitions(now_s):
            if change.is_start:
                self._start_fault(change.injection)

    def undo_all(self) -> None:
        """Undo all faults that are still active: resume frozen processes, and set the wall clock right."""
        for name in list(self._resume_time_by_process):
            self._resume_process(name)
        if self._clock_offset_s:
            step_wall_clock(-self._clock_offset_s)

    def _handle_request(
        self, query: IncomingQuery, robot: RobotDescription | None, lifecycle: LifecycleState
    ) -> Answer:
        """Start or end a fault as requested, if that is allowed, and return the response.

        Args:
            query: The request as it was received.
            robot: Description of the robot; None while it is unknown.
            lifecycle: State of the robot, which every response contains.
        """

        def refuse(reason: str, refusal: str) -> Answer:
            return Answer(
                ok=False,
                reason=reason[:MAX_REASON_CHARACTERS],
                refusal=refusal,
                lifecycle=lifecycle,
            )

        if robot is None:
            return refuse("the robot is not known yet", "not_allowed")
        prohibition = self._describe_prohibition(robot)
        if prohibition is not None:
            return refuse(prohibition, "not_allowed")
        try:
            request = self._decoder.decode(query.payload, query.encoding)
            end_s = request.for_s or inf
            injection = validate_and_complete_injection(
                FaultInjection(request.kind, request.target, 0.0, end_s, request.amount)
            )
            if request.end:
                self._end_fault(injection)
                return Answer(
                    ok=True,
                    reason=f"ended: {injection.kind}:{injection.target}",
                    lifecycle=lifecycle,
                )
            self._validate_injection(injection)
            if injection.target_type == "process":
                # Not now: the response may pass through that process.
                self._requested_injections.append(injection)
            else:
                self._start_fault(injection)
        except WireError as error:
            return refuse(str(error), error.reason)
        except ConfigError as error:
            return refuse(str(error), "unknown_fault")
        except RefusedError as error:
            return refuse(str(error), "not_permitted")
        return Answer(
            ok=True, reason=f"begins: {injection.kind}:{injection.target}", lifecycle=lifecycle
        )

    def _describe_prohibition(self, robot: RobotDescription) -> str | None:
        """Describe why faults may not be injected into a robot; None if they may."""
        if robot.emulated or self._is_injection_allowed:
            return None
        return (
            f"{robot.robot} on backend {robot.backend} is real: fault injection needs "
            "`allow_fault_injection = true` in the scenario, or --set allow_fault_injection=true"
        )

    def _validate_injection(self, injection: FaultInjection) -> None:
        """Raise ConfigError for a requested fault that this run cannot inject, or could not end."""
        if injection.executing_part != RUN:
            raise ConfigError(
                f"{injection.kind}:{injection.target} is carried out at {keys.fault_key(injection.executing_part)}",
                code="injection/not-supported",
            )
        if (
            injection.target_type == "process"
            and injection.target not in self._supervisor.process_names
        ):
            raise ConfigError(
                f"there is no process {injection.target!r}; this run has {', '.join(self._supervisor.process_names)}",
                code="injection/unknown-target",
            )
        if (
            injection.kind == "freeze"
            and injection.target in REQUEST_ROUTING_PROCESSES
            and injection.end_s == inf
        ):
            raise ConfigError(
                f"freeze:{injection.target} needs an end, because a frozen {injection.target} cannot receive the "
                f"request to end it: give --for SECONDS",
                code="injection/not-supported",
            )

    def _start_fault(self, injection: FaultInjection) -> None:
        """Inject a fault now: send a signal to a process, or step the wall clock."""
        self._print_text(f"injected fault: {injection.kind}:{injection.target}")
        if injection.target_type != "process":
            step_s = injection.amount or 0.0
            step_wall_clock(step_s)
            self._clock_offset_s += step_s
            return
        self._supervisor.send_signal(injection.target, SIGNALS[injection.kind])
        if injection.kind == "freeze":
            self._resume_time_by_process[injection.target] = (
                time.monotonic() + injection.end_s - injection.start_s
            )

    def _end_fault(self, injection: FaultInjection) -> None:
        """End a freeze before its time. Raises ConfigError for a fault that is not active."""
        if injection.target not in self._resume_time_by_process:
            raise ConfigError(
                f"{injection.kind}:{injection.target} is not active; only a freeze can be ended",
                code="injection/not-supported",
            )
        self._resume_process(injection.target)

    def _resume_process(self, name: str) -> None:
        """Resume a frozen process."""
        del self._resume_time_by_process[name]
        self._supervisor.send_signal(name, signal.SIGCONT)
        self._print_text(f"injected fault ends: freeze:{name}")
