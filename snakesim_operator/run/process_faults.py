"""Injected faults that only the supervisor can carry out: a process is killed, stopped or frozen; the clock steps.

They begin at robot time since the first arming. The duration of a freeze is wall-clock time:
while the host is frozen, or waits for a frozen service, robot time stands still.
"""

import signal
import time
from collections.abc import Callable
from math import inf
from queue import SimpleQueue

from snakesim_hal.base.errors import ConfigError, RefusedError, WireError
from snakesim_hal.base.process import step_wall_clock
from snakesim_hal.model.fault_kinds import RUN, Injection, Plan, checked
from snakesim_hal.model.fault_plan import planned
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.session import Question, Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder
from snakesim_hal.wire.messages import Answer, Clock, Description, FaultRequest, LifecycleState
from snakesim_operator.run.supervisor import Supervisor

MEETING_POINTS = ("host", "router")
SIGNALS = {"kill": signal.SIGKILL, "stop": signal.SIGTERM, "freeze": signal.SIGSTOP}


class RobotTime:
    """Robot time since the first arming, through restarts of the host. Between two clocks it stands still."""

    def __init__(self, session: Session) -> None:
        self._clocks = session.reader(keys.CLOCK, Clock)
        self._last_ns: int | None = None  # None: never armed yet
        self._elapsed_ns = 0

    def seconds(self) -> float | None:
        """None before the first arming."""
        for clock in self._clocks.drain():
            if self._last_ns is None:
                self._last_ns = clock.timestamp_ns if clock.arm_session else None
                continue
            self._elapsed_ns += max(clock.timestamp_ns - self._last_ns, 0)
            self._last_ns = clock.timestamp_ns
        return None if self._last_ns is None else self._elapsed_ns * 1e-9


class ProcessFaults:
    """Carries out faults planned in the scenario, and those requested on `fault/run`."""

    def __init__(self, config: RunConfig, session: Session, supervisor: Supervisor, say: Callable[[str], None]) -> None:
        self._allowed = config.allow_fault_injection
        self._supervisor = supervisor
        self._say = say
        self._plan = Plan(injection for injection in planned(config) if injection.part == RUN)
        self._time = None if self._plan.next_s() == inf else RobotTime(session)  # every clock wakes this process
        self._frozen: dict[str, float] = {}  # name of a process -> monotonic time at which it continues
        self._asked: list[Injection] = []
        self._stepped_s = 0.0
        self._decoder = Decoder(FaultRequest)
        self._questions: SimpleQueue[Question] = SimpleQueue()
        session.on_question(keys.fault(RUN), self._questions.put)

    def refusal(self, robot: Description) -> str | None:
        """Why the scenario's faults are not allowed on this robot; None if they are, or if there are none."""
        return self._forbidden(robot) if self._plan.next_s() != inf else None

    def carry_out(self, robot: Description | None, lifecycle: LifecycleState) -> None:
        """Carry out due faults, and answer requests. robot: None while it is unknown.

        Raises RefusedError when a planned fault is not permitted.
        """
        now_s = None if self._time is None else self._time.seconds()
        if now_s is not None:
            for change in self._plan.until(now_s):
                if change.begins:
                    self._begin(change.injection)
        while self._asked:
            self._begin(self._asked.pop(0))
        for name in [name for name, until in self._frozen.items() if until <= time.monotonic()]:
            self._thaw(name)
        for _ in range(self._questions.qsize()):
            question = self._questions.get()
            question.reply(self._answer(question, robot, lifecycle))

    def undo(self) -> None:
        """Undo all changes to the computer."""
        for name in list(self._frozen):
            self._thaw(name)
        if self._stepped_s:
            step_wall_clock(-self._stepped_s)

    def _answer(self, question: Question, robot: Description | None, lifecycle: LifecycleState) -> Answer:
        def no(reason: str, refusal: str) -> Answer:
            return Answer(ok=False, reason=reason[:500], refusal=refusal, lifecycle=lifecycle)

        forbidden = "the robot is not known yet" if robot is None else self._forbidden(robot)
        if forbidden is not None:
            return no(forbidden, "not_allowed")
        try:
            request = self._decoder.decode(question.payload, question.encoding)
            injection = checked(Injection(request.kind, request.target, 0.0, request.for_s or inf, request.amount))
            if request.end:
                self._end(injection)
                return Answer(ok=True, reason=f"ended: {injection.kind}:{injection.target}", lifecycle=lifecycle)
            self._check(injection)
            if injection.target_type == "process":
                self._asked.append(injection)  # when the answer is on its way: it may pass through that process
            else:
                self._begin(injection)
        except WireError as error:
            return no(str(error), error.reason)
        except ConfigError as error:
            return no(str(error), "unknown_fault")
        except RefusedError as error:
            return no(str(error), "not_permitted")
        return Answer(ok=True, reason=f"begins: {injection.kind}:{injection.target}", lifecycle=lifecycle)

    def _forbidden(self, robot: Description) -> str | None:
        if robot.emulated or self._allowed:
            return None
        return (
            f"{robot.robot} on backend {robot.backend} is real: fault injection needs "
            "`allow_fault_injection = true` in the "
            f"scenario, or --set allow_fault_injection=true"
        )

    def _check(self, injection: Injection) -> None:
        if injection.part != RUN:
            raise ConfigError(f"{injection.kind}:{injection.target} is carried out at {keys.fault(injection.part)}")
        if injection.target_type == "process" and injection.target not in self._supervisor.names:
            raise ConfigError(
                f"there is no process {injection.target!r}; this run has {', '.join(self._supervisor.names)}"
            )
        if injection.kind == "freeze" and injection.target in MEETING_POINTS and injection.end_s == inf:
            raise ConfigError(
                f"freeze:{injection.target} needs an end, because a frozen {injection.target} cannot receive the "
                f"request to end it: give --for SECONDS"
            )

    def _begin(self, injection: Injection) -> None:
        self._say(f"injected fault: {injection.kind}:{injection.target}")
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
            raise ConfigError(f"{injection.kind}:{injection.target} is not active; only a freeze can be ended")
        self._thaw(injection.target)

    def _thaw(self, name: str) -> None:
        del self._frozen[name]
        self._supervisor.signal(name, signal.SIGCONT)
        self._say(f"injected fault ends: freeze:{name}")
