"""Carries out the injected faults that only the supervisor can: processes are killed or frozen, the clock is stepped.

They begin at robot time since the first arming. The duration of a freeze is wall-clock time:
while the host is frozen, or waits for a frozen service, robot time is paused.
"""

import signal
import time
from collections.abc import Callable
from math import inf
from queue import SimpleQueue

from snakesim_hal.base.errors import ConfigError, RefusedError, WireError
from snakesim_hal.base.process import step_wall_clock
from snakesim_hal.model.fault_kinds import RUN, Injection, InjectionPlan, check_injection
from snakesim_hal.model.fault_plan import parse_planned
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.session import Session
from snakesim_hal.network.streams import Query
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder
from snakesim_hal.wire.messages import Answer, Clock, Description, FaultRequest, LifecycleState
from snakesim_operator.run.supervisor import Supervisor

MEETING_POINTS = ("host", "router")
MAX_REASON_CHARACTERS = 500
SIGNALS = {"kill": signal.SIGKILL, "stop": signal.SIGTERM, "freeze": signal.SIGSTOP}


class RobotTime:
    """Counts robot time since the first arming, also when the host restarts. It is paused between clock messages."""

    def __init__(self, session: Session) -> None:
        self._clocks = session.reader(keys.CLOCK, Clock)
        self._last_ns: int | None = None  # None: never armed yet
        self._elapsed_ns = 0

    def seconds(self) -> float | None:
        """Return the time in s; None before the first arming."""
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
    """Carries out faults planned in the scenario, and those requested on `fault/run`."""

    def __init__(
        self, config: RunConfig, session: Session, supervisor: Supervisor, print_text: Callable[[str], None]
    ) -> None:
        """Prepare the faults of processes that the scenario plans, and accept requests for further ones.

        Args:
            config: Configuration of the run, with the planned faults, and whether others may be requested.
            session: Session of the run.
            supervisor: Has the processes that are killed, frozen or restarted.
            print_text: Prints a line.
        """
        self._allowed = config.allow_fault_injection
        self._supervisor = supervisor
        self._print_text = print_text
        self._plan = InjectionPlan(injection for injection in parse_planned(config) if injection.part == RUN)
        self._time = RobotTime(session) if self._has_plan() else None  # each clock message wakes this process
        self._frozen: dict[str, float] = {}  # name of a process -> monotonic time at which it continues
        self._requested: list[Injection] = []  # begin at the next `carry_out`
        self._stepped_s = 0.0
        self._decoder = Decoder(FaultRequest)
        self._questions: SimpleQueue[Query] = SimpleQueue()
        session.on_query(keys.fault_key(RUN), self._questions.put)

    def refusal(self, robot: Description) -> str | None:
        """Return why the scenario's faults are not allowed on this robot; None if they are, or if there are none."""
        if not self._has_plan():
            return None
        return self._describe_prohibition(robot)

    def _has_plan(self) -> bool:
        return self._plan.next_s() != inf

    def carry_out(self, robot: Description | None, lifecycle: LifecycleState) -> None:
        """Carry out due faults, and answer requests. robot: None while it is unknown.

        Raises RefusedError when a planned fault is not permitted.
        """
        self._begin_planned()
        while self._requested:
            self._begin(self._requested.pop(0))
        for name, thaw_time_s in list(self._frozen.items()):
            if thaw_time_s <= time.monotonic():
                self._thaw(name)
        for _ in range(self._questions.qsize()):
            question = self._questions.get()
            question.reply(self._answer(question, robot, lifecycle))

    def _begin_planned(self) -> None:
        """Begin the planned faults that are due in robot time."""
        now_s = None if self._time is None else self._time.seconds()
        if now_s is None:
            return
        for change in self._plan.until(now_s):
            if change.begins:
                self._begin(change.injection)

    def undo(self) -> None:
        """Undo all changes to the computer."""
        for name in list(self._frozen):
            self._thaw(name)
        if self._stepped_s:
            step_wall_clock(-self._stepped_s)

    def _answer(self, question: Query, robot: Description | None, lifecycle: LifecycleState) -> Answer:
        """Carry out a request to begin or end a fault, if it is allowed, and return the answer to it.

        Args:
            question: The request as it was received.
            robot: Description of the robot; None while it is not known.
            lifecycle: State of the robot, which every answer contains.
        """

        def refuse(reason: str, refusal: str) -> Answer:
            return Answer(ok=False, reason=reason[:MAX_REASON_CHARACTERS], refusal=refusal, lifecycle=lifecycle)

        if robot is None:
            return refuse("the robot is not known yet", "not_allowed")
        prohibition = self._describe_prohibition(robot)
        if prohibition is not None:
            return refuse(prohibition, "not_allowed")
        try:
            request = self._decoder.decode(question.payload, question.encoding)
            end_s = request.for_s or inf
            injection = check_injection(Injection(request.kind, request.target, 0.0, end_s, request.amount))
            if request.end:
                self._end(injection)
                return Answer(ok=True, reason=f"ended: {injection.kind}:{injection.target}", lifecycle=lifecycle)
            self._check(injection)
            if injection.target_type == "process":
                self._requested.append(injection)  # not now: the answer may pass through that process
            else:
                self._begin(injection)
        except WireError as error:
            return refuse(str(error), error.reason)
        except ConfigError as error:
            return refuse(str(error), "unknown_fault")
        except RefusedError as error:
            return refuse(str(error), "not_permitted")
        return Answer(ok=True, reason=f"begins: {injection.kind}:{injection.target}", lifecycle=lifecycle)

    def _describe_prohibition(self, robot: Description) -> str | None:
        """Return why faults may not be injected into this robot; None if they may."""
        if robot.emulated or self._allowed:
            return None
        return (
            f"{robot.robot} on backend {robot.backend} is real: fault injection needs "
            "`allow_fault_injection = true` in the scenario, or --set allow_fault_injection=true"
        )

    def _check(self, injection: Injection) -> None:
        """Raise ConfigError for a requested fault that this run cannot carry out, or could not end."""
        if injection.part != RUN:
            raise ConfigError(
                f"{injection.kind}:{injection.target} is carried out at {keys.fault_key(injection.part)}",
                code="injection/not-supported",
            )
        if injection.target_type == "process" and injection.target not in self._supervisor.names:
            raise ConfigError(
                f"there is no process {injection.target!r}; this run has {', '.join(self._supervisor.names)}",
                code="injection/unknown-target",
            )
        if injection.kind == "freeze" and injection.target in MEETING_POINTS and injection.end_s == inf:
            raise ConfigError(
                f"freeze:{injection.target} needs an end, because a frozen {injection.target} cannot receive the "
                f"request to end it: give --for SECONDS",
                code="injection/not-supported",
            )

    def _begin(self, injection: Injection) -> None:
        self._print_text(f"injected fault: {injection.kind}:{injection.target}")
        if injection.target_type != "process":
            step_s = injection.amount or 0.0
            step_wall_clock(step_s)
            self._stepped_s += step_s
            return
        self._supervisor.signal(injection.target, SIGNALS[injection.kind])
        if injection.kind == "freeze":
            self._frozen[injection.target] = time.monotonic() + injection.end_s - injection.start_s

    def _end(self, injection: Injection) -> None:
        if injection.target not in self._frozen:
            raise ConfigError(
                f"{injection.kind}:{injection.target} is not active; only a freeze can be ended",
                code="injection/not-supported",
            )
        self._thaw(injection.target)

    def _thaw(self, name: str) -> None:
        del self._frozen[name]
        self._supervisor.signal(name, signal.SIGCONT)
        self._print_text(f"injected fault ends: freeze:{name}")
