"""Answers the requests that reach a host: for the lease, another lifecycle state, a stop, or simulated time."""

from collections.abc import Callable

import msgspec

from snakesim_hal.host.host_state import HostState
from snakesim_hal.host.latch import EstopLatch, make_reply
from snakesim_hal.host.outbox import Outbox
from snakesim_hal.host.readiness import Readiness
from snakesim_hal.host.simulated_time import Refusal
from snakesim_hal.host.status_reporter import StatusReporter
from snakesim_hal.wire.messages import (
    Answer,
    EstopRequest,
    LeaseRequest,
    LifecycleRequest,
    SimulatorRequest,
)

MAX_LOGGED_REQUESTS = 256

Request = LeaseRequest | LifecycleRequest | EstopRequest | SimulatorRequest
Reply = Callable[[Answer], None]


class RequestHandler:
    """Carries requests out, and replies once to each of them, from any thread."""

    def __init__(
        self,
        state: HostState,
        readiness: Readiness,
        status: StatusReporter,
        latch: EstopLatch,
        outbox: Outbox,
    ) -> None:
        self.log: list[str] = []  # each request except those for the lease: from whom, and the result
        self.simulator_requests: list[tuple[SimulatorRequest, Reply]] = []  # until the next tick begins
        self._state = state
        self._readiness = readiness
        self._status = status
        self._latch = latch
        self._outbox = outbox

    def handle(self, request: Request, reply: Reply) -> None:
        """Carry one request out and reply to it. A simulator request waits until the next tick begins."""
        match request:
            case EstopRequest():
                self._handle_estop(request, reply)
            case LeaseRequest():
                self._handle_lease(request, reply)
            case LifecycleRequest() | SimulatorRequest() if self._is_for_another_host(request):
                self._finish(request, self._refuse_wrong_host(request), reply)
            case LifecycleRequest():
                self._handle_lifecycle(request, reply)
            case SimulatorRequest():
                self.simulator_requests.append((request, reply))

    def change_simulated_time(self) -> None:
        """Carry out, between two ticks, what was requested of the simulator's time."""
        requests = self.simulator_requests
        self.simulator_requests = []
        for request, reply in requests:
            answer = self._change_simulated_time(request)
            self._log_request(request, answer)
            self._status.publish()
            reply(answer)

    # --- one kind of request each ----------------------------------------------------------------------------

    def _handle_estop(self, request: EstopRequest, reply: Reply) -> None:
        tick = self._state.clock.tick
        answer = self._state.authority.on_estop(request, tick)
        answer = self._with_host(answer)
        self._log_request(request, answer)
        self._status.publish()
        self._latch.engage(request.requester, tick, make_reply(reply, answer))

    def _handle_lease(self, request: LeaseRequest, reply: Reply) -> None:
        state = self._state
        now_ns = state.clock.safety_ns()
        state.authority.check_deadlines(now_ns, state.clock.tick)  # first, because an expired lease is a fault
        answer = state.authority.on_lease(request, now_ns)
        self._status.publish()
        reply(self._with_host(answer))

    def _handle_lifecycle(self, request: LifecycleRequest, reply: Reply) -> None:
        """Carry out a lifecycle request, and answer it.

        Args:
            request: what to do: arm, disarm, reset, or finish the run.
            reply: function that sends the answer.
        """
        if request.action == "arm":
            refusal = self._refuse_to_arm()
            if refusal is not None:
                self._finish(request, refusal, reply)
                return

        answer = self._state.authority.on_lifecycle(request, self._state.clock.safety_ns())
        match request.action:
            case "arm" if answer.ok:
                self._state.forget_answers_before_arming()
            case "finish":
                reason = "on request"
                if request.requester:
                    reason = f"on request by {request.requester}"
                self._state.ending.request("finished", reason)
            case _:
                pass
        self._finish(request, answer, reply)

    def _finish(self, request: LifecycleRequest | SimulatorRequest, answer: Answer, reply: Reply) -> None:
        """Log a request and reply; to a reset of an emergency stop only after it is no longer on the disk."""
        answer = self._with_host(answer)
        self._log_request(request, answer)
        self._status.publish()
        if isinstance(request, LifecycleRequest) and request.action == "reset" and answer.ok:
            self._latch.release(make_reply(reply, answer))
        else:
            reply(answer)

    def _change_simulated_time(self, request: SimulatorRequest) -> Answer:
        state = self._state
        outcome = state.clock.simulated.carry_out(request, state.clock.tick)
        if isinstance(outcome, Refusal):
            return state.answer(ok=False, reason=outcome.why, refusal=outcome.word)

        state.clock.restart_deadlines(state.clock.simulated.speed)
        if request.action == "reset":
            finish = LifecycleRequest(action="finish", requester=request.requester)
            state.authority.on_lifecycle(finish, state.clock.safety_ns())
            state.ending.request("reset", f"by {request.requester}")
        return state.answer(ok=True, reason=outcome)

    # --- refusals and the log --------------------------------------------------------------------------------

    def _is_for_another_host(self, request: LifecycleRequest | SimulatorRequest) -> bool:
        return request.host not in (None, self._state.description.host)

    def _refuse_wrong_host(self, request: LifecycleRequest | SimulatorRequest) -> Answer:
        own_host = self._state.description.host
        reason = f"this is host {own_host}, the request is for {request.host}: two have one name"
        return self._state.answer(ok=False, reason=reason, refusal="wrong_host")

    def _refuse_to_arm(self) -> Answer | None:
        """Return the refusal while services are missing or differ from this host."""
        missing = self._readiness.missing_services()
        if missing:
            reason = f"waiting for {', '.join(missing)}"
            return self._state.answer(ok=False, reason=reason, refusal="not_ready")
        unpublished = self._readiness.unpublished_processes()
        if unpublished:
            reason = f"waiting for the settings of {', '.join(unpublished)}"
            return self._state.answer(ok=False, reason=reason, refusal="not_ready")
        differing = self._readiness.differing_processes()
        if differing:
            return self._state.answer(ok=False, reason="; ".join(differing), refusal="settings_differ")
        return None

    def _with_host(self, answer: Answer) -> Answer:
        return msgspec.structs.replace(answer, host=self._state.description.host)

    def _log_request(self, request: LifecycleRequest | EstopRequest | SimulatorRequest, answer: Answer) -> None:
        """Keep a request and its result, for the run's record and the process's log."""
        if len(self.log) >= MAX_LOGGED_REQUESTS:
            return
        action = "estop" if isinstance(request, EstopRequest) else request.action
        outcome = "done" if answer.ok else f"refused: {answer.reason}"
        entry = f"tick {self._state.clock.tick}: {action} by {request.requester!r}, {outcome}"
        self.log.append(entry)
        self._outbox.log(entry)
