"""The HAL host: runs any backend, tick by tick, and is the only process that touches it.

In every tick the host samples the sensors and publishes them with the clock. It lets the safety core judge the samples,
waits for the command that answers them, and lets the safety core decide. Then it hands the setpoints to the backend and
lets a control period pass. The clock mode decides how long it waits:

realtime  until the tick's deadline on the monotonic clock; an old command stays active until its lease ends
lockstep  until every service whose output is due has delivered; the host stays at tick 0 until the first arming
free      not at all
"""

import contextlib
import secrets
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from math import inf

import msgspec

from snakesim_hal.backend import Backend, Samples
from snakesim_hal.base.arithmetic import measure_arithmetic
from snakesim_hal.base.errors import BackendError, WireError
from snakesim_hal.faults.allowed import Faults, NoFaults
from snakesim_hal.host.cable_file import CableFile
from snakesim_hal.host.control_cycle import ControlCycle
from snakesim_hal.host.host_clock import HostClock
from snakesim_hal.host.host_state import HostState
from snakesim_hal.host.inbox import Inbox
from snakesim_hal.host.latch import EstopLatch
from snakesim_hal.host.network_watch import NetworkWatch
from snakesim_hal.host.outbox import Outbox, Outgoing
from snakesim_hal.host.participants import Participants
from snakesim_hal.host.readiness import Readiness
from snakesim_hal.host.request_handler import Reply, Request, RequestHandler
from snakesim_hal.host.run_statistics import RunStatistics
from snakesim_hal.host.status_messages import make_applied_command
from snakesim_hal.host.status_reporter import StatusReporter
from snakesim_hal.host.timing import BackendTime, PublishTimes
from snakesim_hal.model.fault_kinds import HAL
from snakesim_hal.model.scenario import RunConfig, encode_config
from snakesim_hal.network.private_channel import HostEnd, HostMessage
from snakesim_hal.network.run_key import add_proof, own_run_key
from snakesim_hal.network.session import Session
from snakesim_hal.run_log.black_box import BlackBox
from snakesim_hal.run_log.host_record import Ending
from snakesim_hal.safety.authority import Authority
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Answer,
    Clock,
    ClockMode,
    Description,
    EstopRequest,
    Fault,
    JointCommand,
    LifecycleRequest,
    Status,
)

STANDBY_PERIOD_NS = 20_000_000  # between two looks at the services, in lockstep before the first arming
PAUSED_PERIOD_NS = 50_000_000  # between two clock messages while a simulator is paused
SEND_START_S = 0.0001  # for the sending threads, so that the host judges a tick while it is on its way to the services
MAX_INPUT_FRACTION = 0.25  # of a period, for late input: a flood must not take all of it
WRITE_MARGIN_FACTOR = 1.5  # the backend's calls may take longer than they usually do
WRITE_MARGIN_NS = 50_000
RECORD_AFTER_ARMED_NS = 2_000_000_000  # in a host that stays, so that it does not fill memory while it waits
MAX_PARTICIPANT_WAIT_S = 0.5  # between two looks at injected faults and the status


@dataclass(frozen=True, kw_only=True)
class HostOptions:
    """How a host runs; every option has a default that suits a run of its own."""

    # The end of the run.
    max_ticks: int | None = None  # end so many ticks after the first arming; None: on request only
    end_after_fault_s: float | None = None  # robot time; None: stay, so that a person can reset the fault
    clock_mode_after_fault: ClockMode = "realtime"  # of ticks that wait for no service
    stay: bool = False  # count only armed ticks, and record little in between; else count all from the first arming

    # What connects the host with its surroundings.
    latch: EstopLatch | None = None  # stores an emergency stop for later hosts
    starter: HostEnd | None = None  # private channel to the process that started this host
    realtime_warnings: Sequence[str] = ()  # real-time measures that the operating system refused

    # The robot.
    faults: Faults | None = None  # injected ones, as `create_host_faults` returns them; None: requests are refused
    unchecked: str = ""  # why only an explicit word arms it, as `why_unchecked` returns it
    cables: CableFile | None = None  # of joints without end stops


class Host:
    """One robot, one backend, one session."""

    def __init__(
        self,
        config: RunConfig,
        backend: Backend,
        session: Session,
        options: HostOptions | None = None,
    ) -> None:
        """Publish the robot's description and declare all subscriptions.

        Args:
            config: Configuration of the run.
            backend: The robot; guarded, as `open_backend` returns it.
            session: Connection to the network, which the caller closes.
            options: How the host runs.

        Raises:
            ConfigError: Faults are planned and not allowed.
        """
        options = options or HostOptions()
        self._config = config
        self._options = options
        self._latch = options.latch or EstopLatch(None)
        starter = options.starter or HostEnd(None)

        description = msgspec.structs.replace(
            backend.describe(), host=secrets.token_hex(8), arithmetic=measure_arithmetic()
        )
        self.description: Description = add_proof(description, own_run_key())
        self.black_box = BlackBox(self.description)
        self._state = HostState(
            config=config,
            description=self.description,
            authority=Authority(
                self.description,
                first_epoch=time.time_ns() // 1_000_000,
                awaits_reports=config.clock_mode == "realtime",
                unchecked=options.unchecked,
                cables=None if options.cables is None else options.cables.cables,
            ),
            clock=HostClock(config, self.description),
            backend_time=BackendTime(self.description.backend, config.period_ns),
            faults=options.faults or NoFaults(HAL, config, session),
            participants=Participants(config.services),
        )
        self._cycle = ControlCycle(backend, self._state.authority)
        self._published = PublishTimes()
        self._published_arm_session = 0
        self._newest_ticks: dict[str, int] = {}  # of each stream and service
        self._tick_began_ns: int | None = None  # monotonic; None after a pause
        self._last_armed_tick = 0
        self._faulted_tick: int | None = None
        self._armed_at_ns: int | None = None
        self._ended_ns = 0

        self._restore_estop()
        self._outbox = Outbox(
            session, self.description, encode_config(config), lockstep=config.clock_mode == "lockstep"
        )
        readiness = Readiness(config, self._state.participants, session)
        self._status = StatusReporter(self._state, readiness, self._outbox, starter, options.realtime_warnings)
        self._requests = RequestHandler(self._state, readiness, self._status, self._latch, self._outbox)
        self._inbox = Inbox(session, self, config.services, self._outbox.answer)
        self._network_watch = NetworkWatch(self._state, session, self._outbox)
        starter.send(HostMessage(description=self.description))
        starter.serve(self.submit_request)

    # --- for the process that runs the host ------------------------------------------------------------------

    @property
    def authority(self) -> Authority:
        """The safety core of this host."""
        return self._state.authority

    @property
    def statistics(self) -> RunStatistics:
        """Statistics of the armed ticks."""
        return self._state.statistics

    @property
    def participants(self) -> Participants:
        """The services of the run."""
        return self._state.participants

    @property
    def faults(self) -> Faults:
        """The injected faults."""
        return self._state.faults

    @property
    def requests(self) -> list[str]:
        """Requests to arm, disarm, reset, finish or stop: who sent them, and the result."""
        return self._requests.log

    @property
    def ended(self) -> Ending:
        """How the run ended."""
        return self._state.ending.status

    @property
    def ended_why(self) -> str:
        """Why the run ended; empty when it is complete."""
        return self._state.ending.reason

    @property
    def wall_s(self) -> float:
        """Wall-clock time from the first arming to the end of the run, or until now."""
        if self._armed_at_ns is None:
            return 0.0
        return ((self._ended_ns or time.monotonic_ns()) - self._armed_at_ns) * 1e-9

    def status(self) -> Status:
        """Return the present status of the robot."""
        return self._status.build()

    def stop(self) -> None:
        """End the run in order. May be called from a signal handler."""
        self._state.ending.request("stopped", "by a signal")

    def complete(self) -> None:
        """End the run as if all its time had passed."""
        self._state.ending.request("complete")

    def request_estop(self, requester: str, reply: Callable[[str], None]) -> None:
        """Request an emergency stop, as the stop port does; from any thread."""
        request = EstopRequest(requester=requester[:64] or "an unnamed client")
        self.submit_request(request, lambda answer: reply(answer.reason))

    def submit_request(self, request: Request, reply: Reply) -> None:
        """Submit a request that does not come over the network; from any thread."""
        self._inbox.put_local_request(request, reply)

    def handle_queued_input(self) -> None:
        """Handle the input that is queued now, and return."""
        self._inbox.handle_queued(inf)

    def run(self) -> None:
        """Tick until the run is over. The joints are safe when this returns."""
        for _ in self.iterate_ticks():
            pass

    def iterate_ticks(self) -> Generator[None]:
        """Run the control cycles of the host until the run is over, and close the host.

        Yields:
            Once a tick, after the clock is published, so that services can act in the same thread.
        """
        last: Samples | None = None
        self._state.clock.restart_deadlines()
        try:
            while not self._is_over():
                self._inject_faults()
                self._requests.change_simulated_time()
                if self._is_paused():
                    yield
                    self._wait_while_paused()
                    continue

                previous = last
                last = self._sample(previous)
                if last is None:
                    break
                self._publish_samples(last)
                if last is not previous:
                    self._let_services_begin()
                    self._judge(last)
                yield

                if self._awaits_first_arming():
                    self._inbox.handle_until(time.monotonic_ns() + STANDBY_PERIOD_NS)
                    self._status.publish()
                else:
                    self._wait_for_commands(last)
                    self._finish_tick(last)
        finally:
            self._close()

    # --- one tick --------------------------------------------------------------------------------------------

    def _inject_faults(self) -> None:
        """Begin and end the injected faults that are due, where faults are allowed."""
        state = self._state
        refusals = state.faults.update(state.clock.timestamp_ns, state.authority.arm_session, state.authority.state)
        for refusal in refusals:
            state.authority.record_fault(Fault(tick=state.clock.tick, what="injection_refused", cause=refusal))

    def _sample(self, last: Samples | None) -> Samples | None:
        """Return the samples of this tick; None when the backend failed. At tick 0 the same samples are used again."""
        clock = self._state.clock
        if last is not None and self._published.last_tick == clock.tick:
            return last
        started_ns = time.monotonic_ns()
        try:
            samples = self._cycle.sample(clock.tick, clock.timestamp_ns)
        except BackendError as error:
            self._on_backend_failure(error)
            return None
        took_ns = self._state.backend_time.record_read(started_ns)
        if self.authority.state == "armed":
            self.statistics.times.read.add(took_ns / 1000)
        return samples

    def _publish_samples(self, samples: Samples) -> None:
        """Publish all samples of this tick, and then the clock."""
        clock = self._state.clock
        outgoing: list[Outgoing] = [(keys.JOINTS, self.authority.replace_unreadable(samples.joints), None)]
        for key, message in samples.others.items():
            outgoing.append((key, message, samples.encoded[key]))
        for key, _, _ in outgoing:
            self._newest_ticks[key] = clock.tick
        for name, participant in self.participants.items():
            self._newest_ticks[name] = participant.service.used_output_tick(clock.tick)

        clock_message = self._clock_message(clock.tick)
        self._published_arm_session = self.authority.arm_session
        self._published.record(clock.tick, clock.safety_ns(), time.monotonic_ns())
        self._outbox.publish(*outgoing, (keys.CLOCK, clock_message, None))

    def _clock_message(self, tick: int, *, paused: bool = False) -> Clock:
        clock = self._state.clock
        lease = self.authority.lease
        return Clock(
            tick=tick,
            timestamp_ns=tick * clock.period_ns,
            period_ns=clock.period_ns,
            clock_mode=clock.clock_mode,
            lifecycle=self.authority.state,
            arm_session=self.authority.arm_session,
            lease_epoch=lease.epoch if lease.holder else 0,
            newest=self._newest_ticks,
            paused=paused,
        )

    def _let_services_begin(self) -> None:
        """Leave the interpreter to the sending threads in real time, unless a service in this process needs it."""
        clock = self._state.clock
        if clock.clock_mode == "realtime" and not self._config.in_host_services:
            self._inbox.wait(min(SEND_START_S, MAX_INPUT_FRACTION * clock.period_ns * 1e-9))

    def _judge(self, samples: Samples) -> None:
        """Let the safety core judge new samples, before any answer to them is handled; services compute meanwhile."""
        now_ns = self._state.clock.safety_ns()
        if self._options.cables is not None:
            self._options.cables.update(samples.joints)
        self._cycle.observe(samples, now_ns)

    def _finish_tick(self, samples: Samples) -> None:
        """Finish a control cycle: decide on setpoints, record and send them, and wait for the next tick.

        Args:
            samples: the samples of this tick.
        """
        state = self._state
        clock = state.clock
        command_tick = self._newest_command_tick()
        decision = self._cycle.decide(clock.safety_ns(), clock.tick, command_tick)
        if self.authority.arm_session and self._armed_at_ns is None:
            self._armed_at_ns = time.monotonic_ns()
        if self._is_recorded():
            self.black_box.record(clock.tick, clock.timestamp_ns, samples, decision)
        if self.authority.state == "armed":
            self._last_armed_tick = clock.tick
            self.statistics.ticks += 1
            awaited_tick = clock.tick if command_tick is None else command_tick
            self.statistics.answered_ticks += state.newest_answered_tick >= awaited_tick

        started_ns = time.monotonic_ns()
        try:
            self._cycle.enact(decision)
            self._outbox.publish((keys.APPLIED, make_applied_command(self.description, clock.tick, decision), None))
            self._cycle.advance()
        except BackendError as error:
            self._on_backend_failure(error)
        write_ns = state.backend_time.record_write(started_ns)
        if self.authority.state == "armed":
            self.statistics.times.write.add(write_ns / 1000)

        clock.tick += 1
        self._network_watch.note_problems()
        self._follow_fault()
        self._status.publish()
        self._wait_for_next_tick()
        clock.simulated.tick_done(clock.tick)

    def _newest_command_tick(self) -> int | None:
        """Return the newest tick whose command counts at the end of this one; None outside of lockstep: any."""
        clock = self._state.clock
        holder = self._state.lease_holder()
        if clock.clock_mode != "lockstep" or holder is None:
            return None
        return holder.service.used_output_tick(clock.tick + 1)

    def _is_recorded(self) -> bool:
        """Return whether to record this tick: a host that stays must not fill memory while it waits."""
        if self.authority.arm_session == 0:
            return False
        clock = self._state.clock
        unarmed_ns = (clock.tick - self._last_armed_tick) * clock.period_ns
        return not self._options.stay or unarmed_ns <= RECORD_AFTER_ARMED_NS

    # --- waiting ---------------------------------------------------------------------------------------------

    def _awaits_first_arming(self) -> bool:
        """Return whether lockstep still shows tick 0."""
        return self._state.clock.clock_mode == "lockstep" and self.authority.arm_session == 0

    def _next_published_tick(self) -> int:
        """Return the tick that is published next: tick 0 again and again until the first arming."""
        last_tick = self._published.last_tick
        if last_tick is None or self._awaits_first_arming():
            return 0
        return last_tick + 1

    def _is_paused(self) -> bool:
        """Return whether the next tick has to wait. Tick 0 of lockstep is shown also in a pause."""
        return self._state.clock.simulated.is_paused and not self._awaits_first_arming()

    def _wait_while_paused(self) -> None:
        """Show that the host is there, and handle input. Physics and robot time do not advance."""
        if self._published.last_tick is not None:
            self._outbox.publish((keys.CLOCK, self._clock_message(self._published.last_tick, paused=True), None))
        self._status.publish()
        self._tick_began_ns = None
        until_ns = time.monotonic_ns() + PAUSED_PERIOD_NS
        while not self._requests.simulator_requests and (left_ns := until_ns - time.monotonic_ns()) > 0:
            self._inbox.handle_next(left_ns * 1e-9)
        self._status.publish()

    def _wait_for_commands(self, samples: Samples) -> None:
        """Handle input until the commands that answer this tick are there, or until it is too late for them."""
        clock = self._state.clock
        match clock.clock_mode:
            case "lockstep":
                self._wait_for_participants(samples)
                self._inbox.handle_queued(inf)
            case "realtime":
                self._wait_for_answer()
                self._inbox.handle_queued(MAX_INPUT_FRACTION * clock.period_ns)
            case "free":
                self._inbox.handle_queued(MAX_INPUT_FRACTION * clock.period_ns)

    def _wait_for_answer(self) -> None:
        """Handle input until a command answers this tick, or until the backend needs the rest of the period."""
        state = self._state
        clock = state.clock
        write_ns = WRITE_MARGIN_FACTOR * state.backend_time.write_ns + WRITE_MARGIN_NS
        give_up_ns = clock.deadlines.start_ns(clock.tick + 1) - write_ns
        if clock.simulated.speed > 1.0 and self.authority.state == "armed":
            # If need be, a faster robot waits as long as one at speed 1.
            give_up_ns = max(give_up_ns, self._published.times_of_tick(clock.tick)[1] + clock.period_ns)
        while state.newest_answered_tick < clock.tick and not state.ending.requested:
            left_ns = give_up_ns - time.monotonic_ns()
            if left_ns <= 0 or not self._inbox.handle_next(left_ns * 1e-9):
                break

    def _wait_for_participants(self, samples: Samples) -> None:
        """Handle input until every service that is due at this tick has answered, or has stalled for too long.

        The host stops waiting for services that do not answer within `stall_limit_s`. The run's end ends the wait, too.

        Args:
            samples: the samples of this tick, which are published again if the robot is armed meanwhile.
        """
        state = self._state
        tick = state.clock.tick
        state.waiting_since_ns = time.monotonic_ns()
        give_up_ns = state.waiting_since_ns + round(self._config.stall_limit_s * 1e9)
        while not state.ending.requested:
            late_services = self.participants.behind(tick)
            if not late_services:
                break
            remaining_ns = give_up_ns - time.monotonic_ns()
            if self._published_arm_session != self.authority.arm_session:  # armed in this tick: publish it
                self._publish_samples(samples)
            if remaining_ns > 0:
                self._inbox.handle_next(min(remaining_ns * 1e-9, MAX_PARTICIPANT_WAIT_S))
                self._inject_faults()
                self._status.publish()
            else:
                for name in late_services:
                    self._stop_waiting_for(name)
        state.waiting_since_ns = None

    def _stop_waiting_for(self, service: str) -> None:
        tick = self._state.clock.tick
        self.participants[service].given_up = True
        cause = f"{service} is {self._config.stall_limit_s:g} s late with tick {tick}; no longer waited for"
        self.authority.record_fault(Fault(tick=tick, what="service_stalled", cause=cause))

    def _wait_for_next_tick(self) -> None:
        """Wait in real time until the next tick is due, and record whether this one was on time."""
        clock = self._state.clock
        is_armed = self.authority.state == "armed"
        late_ns: int | None = None
        if clock.clock_mode == "realtime":
            due_ns = clock.deadlines.start_ns(clock.tick)
            if clock.deadlines.missed(clock.tick):
                self.statistics.overruns += is_armed
            else:
                self._inbox.handle_until(due_ns)
            late_ns = time.monotonic_ns() - due_ns

        now_ns = time.monotonic_ns()
        began_ns = self._tick_began_ns
        self._tick_began_ns = now_ns
        if is_armed and began_ns is not None:
            self.statistics.times.cycle.add((now_ns - began_ns) / 1000)
        if is_armed and late_ns is not None:
            self.statistics.times.late.add(late_ns / 1000)

    # --- input, handed over by the inbox ---------------------------------------------------------------------

    def on_command(self, command: JointCommand, monotonic_ns: int) -> None:
        """Offer a command to the safety core, with the age of the joint state that it answers."""
        state = self._state
        if command.lease_epoch == self.authority.lease.epoch and self.authority.answers_arm_session(command):
            self.on_done(self.authority.lease.holder, command.tick)
        published_safety_ns, published_ns = self._published.times_of_tick(command.tick)
        now_ns = state.clock.safety_ns(monotonic_ns)
        refusal = self.authority.offer_command(
            command, now_ns=now_ns, tick=state.clock.tick, age_ns=now_ns - published_safety_ns
        )
        if refusal is None and command.tick > state.newest_answered_tick:
            state.newest_answered_tick = command.tick
            if self.authority.state == "armed":
                self.statistics.state_to_command.add((monotonic_ns - published_ns) / 1000)

    def on_done(self, service: str | None, tick: int) -> None:
        """Note that a service has completed a tick."""
        if tick <= self._state.clock.tick:
            self.participants.mark_done(service, tick)

    def on_undecodable(self, error: WireError) -> Answer:
        """Count a message that cannot be decoded, and return the answer for the case that it was a query."""
        self.authority.count_rejection(error.reason)
        return self._state.answer(ok=False, reason=str(error), refusal=error.reason)

    def on_request(self, request: Request, reply: Reply) -> None:
        """Carry a request out, and reply once, from any thread."""
        self._requests.handle(request, reply)

    def on_presence(self, service: str, present: bool) -> None:
        """Note that a service's liveliness token has appeared or vanished."""
        if present:
            self.participants.mark_present(service, self._next_published_tick())
            return
        if not self.participants.mark_absent(service):
            return
        is_holder = self.authority.lease.holder == service
        if self.authority.arm_session and not self._state.ending.requested:
            cause = f"{service} is gone: its process ended or its connection broke"
            fault = Fault(tick=self._state.clock.tick, what="service_lost", cause=cause)
            self.authority.record_fault(fault, precedes_stop=self.authority.state == "armed" and is_holder)
        if is_holder:
            self.authority.on_holder_gone(f"{service} is gone")

    # --- faults and the end ----------------------------------------------------------------------------------

    def _restore_estop(self) -> None:
        """Begin in `estop` if an earlier host of this robot was stopped and the stop was not reset."""
        latched = self._latch.left_by_earlier_host
        if latched is not None:
            request = EstopRequest(requester=f"{latched.requester[:40]}, before this host")
            self.authority.on_estop(request, max(latched.tick, 0))

    def _on_backend_failure(self, error: BackendError) -> None:
        """Stop the robot and end the run."""
        cause = str(error)[:500]
        self.authority.fault(Fault(tick=self._state.clock.tick, what="backend_failed", cause=cause))
        self._status.publish(force=True)
        self._state.ending.request("failed", cause)

    def _follow_fault(self) -> None:
        """Stop waiting for services after a fault; wait for them again after it is reset."""
        clock = self._state.clock
        if self.authority.state not in ("fault", "estop"):
            if self._faulted_tick is not None:
                clock.clock_mode = self._config.clock_mode
            self._faulted_tick = None
        elif self._faulted_tick is None:
            self._faulted_tick = clock.tick
            if clock.clock_mode != "realtime":
                clock.clock_mode = self._options.clock_mode_after_fault
                clock.restart_deadlines()

    def _is_over(self) -> bool:
        """Return whether the run is over, and note why."""
        ending = self._state.ending
        if ending.requested:
            return True
        max_ticks = self._options.max_ticks
        if max_ticks is not None and self.statistics.ticks >= max_ticks:
            ending.request("complete")
        elif max_ticks is not None and not self._options.stay and self.black_box.ticks >= max_ticks:
            ending.request("failed", "the time was over before the requested armed time was reached")
        elif self._has_rested_after_fault():
            ending.request("failed", self.authority.reason)
        return ending.requested

    def _has_rested_after_fault(self) -> bool:
        """Return whether the robot has had the time in a fault that the options allow."""
        if self._faulted_tick is None or self._options.end_after_fault_s is None:
            return False
        clock = self._state.clock
        return (clock.tick - self._faulted_tick) * clock.period_ns > self._options.end_after_fault_s * 1e9

    def _close(self) -> None:
        """Make the joints safe, and release what the host has opened."""
        self._state.ending.request("failed", "by an internal error; see host.log")
        self._ended_ns = time.monotonic_ns()
        finish = LifecycleRequest(action="finish", requester="the host")
        self.authority.on_lifecycle(finish, self._state.clock.safety_ns())
        with contextlib.suppress(BackendError):
            self._cycle.enact(self.authority.decide())
        self._status.publish(force=True)
        self._state.faults.close()
        self._latch.close()
        if self._options.cables is not None:
            self._options.cables.close()
        self._outbox.close()
