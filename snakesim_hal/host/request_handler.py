"""Answers the requests that reach a host: for the lease, another lifecycle state, a stop, or simulated time."""

from collections.abc import Callable

import msgspec

from snakesim_hal.host.host_state import HostState
from snakesim_hal.host.latch import EstopLatch, make_storage_callback
from snakesim_hal.host.outbox import HostOutbox
from snakesim_hal.host.readiness import ServiceReadiness
from snakesim_hal.host.simulated_time import SimulatorRefusal
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
        readiness: ServiceReadiness,
        status: StatusReporter,
        latch: EstopLatch,
        outbox: HostOutbox,
    ) -> None:
        # Each request except those for the lease: from whom, and the result.
        self.log: list[str] = []
        # Until the next tick begins.
        self.simulator_requests: list[tuple[SimulatorRequest, Reply]] = []
        self._state = state
        self._readiness = readiness
        self._status = status
        self._latch = latch
        self._outbox = outbox

    def handle_request(self, request: Request, reply: Reply) -> None:
        """Execute one request and reply to it. A simulator request waits until the next tick starts."""
        match request:
            case EstopRequest():
                self._handle_estop(request, reply)
            case LeaseRequest():
                self._handle_lease(request, reply)
            case LifecycleRequest() | SimulatorRequest() if self._is_for_another_host(request):
                self._log_and_reply(request, self._make_wrong_host_refusal(request), reply)
            case LifecycleRequest():
                self._handle_lifecycle(request, reply)
            case SimulatorRequest():
                self.simulator_requests.append((request, reply))

    def execute_simulator_requests(self) -> None:
        """Execute the queued simulator requests, between two ticks, and reply to them."""
        requests = self.simulator_requests
        self.simulator_requests = []
        for request, reply in requests:
            answer = self._execute_simulator_request(request)
            self._log_request(request, answer)
            self._status.publish_if_due()
            reply(answer)

    # --- one kind of request each ----------------------------------------------------------------------------

    def _handle_estop(self, request: EstopRequest, reply: Reply) -> None:
        tick = self._state.clock.tick
        answer = self._state.authority.handle_estop_request(request, tick)
        answer = self._add_host_id(answer)
        self._log_request(request, answer)
        self._status.publish_if_due()
        self._latch.engage(request.requester, tick, make_storage_callback(reply, answer))

    def _handle_lease(self, request: LeaseRequest, reply: Reply) -> None:
        state = self._state
        now_ns = state.clock.safety_ns()
        # First, because an expired lease is a fault.
        state.authority.latch_faults_and_expire_lease(now_ns, state.clock.tick)
        answer = state.authority.handle_lease_request(request, now_ns)
        self._status.publish_if_due()
        reply(self._add_host_id(answer))

    def _handle_lifecycle(self, request: LifecycleRequest, reply: Reply) -> None:
        """Arm, disarm or reset the robot, or finish the run, and answer the request.

        Args:
            request: Request with one of these actions.
            reply: Function that sends the answer.
        """
        if request.action == "arm":
            refusal = self._find_arming_refusal()
            if refusal is not None:
                self._log_and_reply(request, refusal, reply)
                return

        answer = self._state.authority.handle_lifecycle_request(
            request, self._state.clock.safety_ns()
        )
        match request.action:
            case "arm" if answer.ok:
                self._state.reset_answered_ticks()
            case "finish":
                reason = "on request"
                if request.requester:
                    reason = f"on request by {request.requester}"
                self._state.ending.request("finished", reason)
            case _:
                pass
        self._log_and_reply(request, answer, reply)

    def _log_and_reply(
        self, request: LifecycleRequest | SimulatorRequest, answer: Answer, reply: Reply
    ) -> None:
        """Log a request, publish the status, and reply. A reset is answered only after the stop is off the disk."""
        answer = self._add_host_id(answer)
        self._log_request(request, answer)
        self._status.publish_if_due()
        if isinstance(request, LifecycleRequest) and request.action == "reset" and answer.ok:
            self._latch.release(make_storage_callback(reply, answer))
        else:
            reply(answer)

    def _execute_simulator_request(self, request: SimulatorRequest) -> Answer:
        state = self._state
        outcome = state.clock.simulated.execute_request(request, state.clock.tick)
        if isinstance(outcome, SimulatorRefusal):
            return state.make_answer(ok=False, reason=outcome.reason, refusal=outcome.code)

        state.clock.restart_deadlines(state.clock.simulated.speed)
        if request.action == "reset":
            finish = LifecycleRequest(action="finish", requester=request.requester)
            state.authority.handle_lifecycle_request(finish, state.clock.safety_ns())
            state.ending.request("reset", f"by {request.requester}")
        return state.make_answer(ok=True, reason=outcome)

    # --- refusals and the log --------------------------------------------------------------------------------

    def _is_for_another_host(self, request: LifecycleRequest | SimulatorRequest) -> bool:
        return request.host not in (None, self._state.description.host)

    def _make_wrong_host_refusal(self, request: LifecycleRequest | SimulatorRequest) -> Answer:
        own_host = self._state.description.host
        reason = f"this is host {own_host}, the request is for {request.host}: two have one name"
        return self._state.make_answer(ok=False, reason=reason, refusal="wrong_host")

    def _find_arming_refusal(self) -> Answer | None:
        """Return the refusal of a request to arm if services are missing or differ from this host; otherwise None."""
        missing = self._readiness.find_missing_services()
        if missing:
            reason = f"waiting for {', '.join(missing)}"
            return self._state.make_answer(ok=False, reason=reason, refusal="not_ready")
        unpublished = self._readiness.find_undescribed_processes()
        if unpublished:
            reason = f"waiting for the settings of {', '.join(unpublished)}"
            return self._state.make_answer(ok=False, reason=reason, refusal="not_ready")
        differing = self._readiness.describe_differing_processes()
        if differing:
            return self._state.make_answer(
                ok=False, reason="; ".join(differing), refusal="settings_differ"
            )
        return None

    def _add_host_id(self, answer: Answer) -> Answer:
        return msgspec.structs.replace(answer, host=self._state.description.host)

    def _log_request(
        self, request: LifecycleRequest | EstopRequest | SimulatorRequest, answer: Answer
    ) -> None:
        """Add a request and its result to the run's record and to the log of the process."""
        if len(self.log) >= MAX_LOGGED_REQUESTS:
            return
        action = "estop" if isinstance(request, EstopRequest) else request.action
        result = "done" if answer.ok else f"refused: {answer.reason}"
        entry = f"tick {self._state.clock.tick}: {action} by {request.requester!r}, {result}"
        self.log.append(entry)
        self._outbox.log(entry)
