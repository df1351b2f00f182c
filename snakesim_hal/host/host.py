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
from snakesim_hal.faults.allowed import InjectedFaults, NoFaults
from snakesim_hal.host.cable_file import CableFile
from snakesim_hal.host.control_cycle import ControlCycle
from snakesim_hal.host.host_clock import HostClock
from snakesim_hal.host.host_state import HostState
from snakesim_hal.host.inbox import HostInbox
from snakesim_hal.host.latch import EstopLatch
from snakesim_hal.host.network_watch import NetworkWatch
from snakesim_hal.host.outbox import HostOutbox, Outgoing
from snakesim_hal.host.participants import LockstepParticipants
from snakesim_hal.host.readiness import ServiceReadiness
from snakesim_hal.host.request_handler import Reply, Request, RequestHandler
from snakesim_hal.host.run_statistics import RunStatistics
from snakesim_hal.host.status_messages import make_applied_command
from snakesim_hal.host.status_reporter import StatusReporter
from snakesim_hal.host.timing import BackendTimer, PublishTimes
from snakesim_hal.model.fault_kinds import HAL
from snakesim_hal.model.scenario import RunConfig, encode_config
from snakesim_hal.network.private_channel import HostEnd, HostMessage
from snakesim_hal.network.run_key import add_proof, read_own_run_key
from snakesim_hal.network.session import Session
from snakesim_hal.run_log.black_box import BlackBox
from snakesim_hal.run_log.host_record import Ending
from snakesim_hal.safety.authority import CommandAuthority
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Answer,
    Clock,
    ClockMode,
    EstopRequest,
    Fault,
    JointCommand,
    LifecycleRequest,
    RobotDescription,
    RobotStatus,
)

# Between two looks at the services, in lockstep before the first arming.
STANDBY_PERIOD_NS = 20_000_000
PAUSED_PERIOD_NS = 50_000_000  # between two clock messages while a simulator is paused
# For the sending threads, so that the host judges a tick while it is on its way to the services.
SENDER_START_TIME_S = 0.0001
MAX_INPUT_FRACTION = 0.25  # of a period, for late input: a flood must not take all of it
WRITE_MARGIN_FACTOR = 1.5  # the backend's calls may take longer than they usually do
WRITE_MARGIN_NS = 50_000
# In a host that stays, so that it does not fill memory while it waits.
RECORD_AFTER_ARMED_NS = 2_000_000_000
MAX_PARTICIPANT_WAIT_S = 0.5  # between two looks at injected faults and the status


@dataclass(frozen=True, kw_only=True)
class HostOptions:
    """How a host runs; every option has a default that suits a run of its own."""

    # The end of the run.
    max_ticks: int | None = None  # end so many ticks after the first arming; None: on request only
    # Robot time; None: stay, so that a person can reset the fault.
    end_after_fault_s: float | None = None
    clock_mode_after_fault: ClockMode = "realtime"  # of ticks that wait for no service
    # Count only armed ticks, and record little in between; else count all from the first arming.
    stays_after_run: bool = False

    # What connects the host with its surroundings.
    latch: EstopLatch | None = None  # stores an emergency stop for later hosts
    starter_channel: HostEnd | None = None  # private channel to the process that started this host
    realtime_warnings: Sequence[str] = ()  # real-time measures that the operating system refused

    # The robot.
    # Injected ones, as `create_host_faults` returns them; None: requests are refused.
    faults: InjectedFaults | None = None
    unchecked_reason: str = (
        ""  # why only an explicit word arms it, as `find_unchecked_reason` returns it
    )
    cable_file: CableFile | None = None  # of joints without end stops


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
            options: Options of the run. None means the defaults.

        Raises:
            ConfigError: Faults are planned and not allowed.
        """
        options = options or HostOptions()
        self._config = config
        self._options = options
        self._latch = options.latch or EstopLatch(None)
        starter = options.starter_channel or HostEnd(None)

        description = msgspec.structs.replace(
            backend.describe(), host=secrets.token_hex(8), arithmetic=measure_arithmetic()
        )
        self.description: RobotDescription = add_proof(description, read_own_run_key())
        self.black_box = BlackBox(self.description)
        self._state = HostState(
            config=config,
            description=self.description,
            authority=CommandAuthority(
                self.description,
                first_epoch=time.time_ns() // 1_000_000,
                awaits_reports=config.clock_mode == "realtime",
                unchecked_reason=options.unchecked_reason,
                cables=None if options.cable_file is None else options.cable_file.tracker,
            ),
            clock=HostClock(config, self.description),
            backend_time=BackendTimer(self.description.backend, config.period_ns),
            faults=options.faults or NoFaults(HAL, config, session),
            participants=LockstepParticipants(config.services),
        )
        self._cycle = ControlCycle(backend, self._state.authority)
        self._published = PublishTimes()
        self._published_arm_session = 0
        self._newest_ticks: dict[str, int] = {}  # of each stream and service
        self._tick_start_ns: int | None = None  # monotonic; None after a pause
        self._last_armed_tick = 0
        self._faulted_tick: int | None = None
        self._armed_at_ns: int | None = None
        self._ended_ns = 0

        self._restore_estop()
        self._outbox = HostOutbox(
            session,
            self.description,
            encode_config(config),
            lockstep=config.clock_mode == "lockstep",
        )
        readiness = ServiceReadiness(config, self._state.participants, session)
        self._status = StatusReporter(
            self._state, readiness, self._outbox, starter, options.realtime_warnings
        )
        self._requests = RequestHandler(
            self._state, readiness, self._status, self._latch, self._outbox
        )
        self._inbox = HostInbox(session, self, config.services, self._outbox.send_answer)
        self._network_watch = NetworkWatch(self._state, session, self._outbox)
        starter.send(HostMessage(description=self.description))
        starter.start_serving(self.submit_request)

    # --- for the process that runs the host ------------------------------------------------------------------

    @property
    def authority(self) -> CommandAuthority:
        """The safety core of this host."""
        return self._state.authority

    @property
    def statistics(self) -> RunStatistics:
        """Statistics of the armed ticks."""
        return self._state.statistics

    @property
    def participants(self) -> LockstepParticipants:
        """The services of the run."""
        return self._state.participants

    @property
    def faults(self) -> InjectedFaults:
        """The injected faults."""
        return self._state.faults

    @property
    def request_log(self) -> list[str]:
        """Requests to arm, disarm, reset, finish or stop: who sent them, and the result."""
        return self._requests.log

    @property
    def ending_status(self) -> Ending:
        """How the run ended."""
        return self._state.ending.status

    @property
    def ending_reason(self) -> str:
        """Why the run ended; empty when it is complete."""
        return self._state.ending.reason

    @property
    def armed_wall_time_s(self) -> float:
        """Wall-clock time from the first arming to the end of the run, or until now."""
        if self._armed_at_ns is None:
            return 0.0
        return ((self._ended_ns or time.monotonic_ns()) - self._armed_at_ns) * 1e-9

    def build_status(self) -> RobotStatus:
        """Return the present status of the robot."""
        return self._status.build_status()

    def request_stop(self) -> None:
        """End the run in order. May be called from a signal handler."""
        self._state.ending.request("stopped", "by a signal")

    def request_completion(self) -> None:
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
            None once in each tick, after the clock is published, so that services in the same thread can act. Also once
            in each wait while a simulator is paused.
        """
        samples: Samples | None = None
        self._state.clock.restart_deadlines()
        try:
            while not self._check_for_end():
                self._inject_faults()
                self._requests.execute_simulator_requests()
                if self._is_paused():
                    yield
                    self._wait_while_paused()
                    continue

                previous_samples = samples
                samples = self._sample(previous_samples)
                if samples is None:
                    break  # the backend has failed
                self._publish_samples(samples)
                if samples is not previous_samples:
                    self._wait_for_senders()
                    self._check_samples(samples)
                yield

                if self._awaits_first_arming():
                    self._inbox.handle_until(time.monotonic_ns() + STANDBY_PERIOD_NS)
                    self._status.publish_if_due()
                else:
                    self._wait_for_commands(samples)
                    self._complete_control_cycle(samples)
        finally:
            self._close()

    # --- one tick --------------------------------------------------------------------------------------------

    def _inject_faults(self) -> None:
        """Begin and end the injected faults that are due, and log requests for faults that are refused."""
        state = self._state
        refusals = state.faults.update(
            state.clock.timestamp_ns, state.authority.arm_session, state.authority.state
        )
        for refusal in refusals:
            state.authority.log_fault(
                Fault(tick=state.clock.tick, what="injection_refused", cause=refusal)
            )

    def _sample(self, last_samples: Samples | None) -> Samples | None:
        """Read the sensors, and return the samples of this tick. A tick that is repeated keeps its samples.

        Args:
            last_samples: Samples of the last cycle. None in the first cycle.

        Returns:
            The samples, or None if the backend has failed.
        """
        clock = self._state.clock
        if last_samples is not None and self._published.last_tick == clock.tick:
            return last_samples
        started_ns = time.monotonic_ns()
        try:
            samples = self._cycle.sample(clock.tick, clock.timestamp_ns)
        except BackendError as error:
            self._on_backend_failure(error)
            return None
        duration_ns = self._state.backend_time.record_read(started_ns)
        if self.authority.state == "armed":
            self.statistics.times.read.add(duration_ns / 1000)
        return samples

    def _publish_samples(self, samples: Samples) -> None:
        """Publish all samples of this tick, and then the clock."""
        clock = self._state.clock
        outgoing: list[Outgoing] = [
            (keys.JOINTS, self.authority.replace_non_finite_values(samples.joints), None)
        ]
        for key, message in samples.by_key.items():
            outgoing.append((key, message, samples.encoded_by_key[key]))
        for key, _, _ in outgoing:
            self._newest_ticks[key] = clock.tick
        for name, participant in self.participants.items():
            self._newest_ticks[name] = participant.service.used_output_tick(clock.tick)

        clock_message = self._make_clock_message(clock.tick)
        self._published_arm_session = self.authority.arm_session
        self._published.record(clock.tick, clock.safety_ns(), time.monotonic_ns())
        self._outbox.publish(*outgoing, (keys.CLOCK, clock_message, None))

    def _make_clock_message(self, tick: int, *, paused: bool = False) -> Clock:
        """Return the clock of a tick, with the newest samples and the current lease."""
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

    def _wait_for_senders(self) -> None:
        """Let the sending threads run first in real time, unless a service runs in this process."""
        clock = self._state.clock
        if clock.clock_mode == "realtime" and not self._config.in_host_services:
            self._inbox.wait(min(SENDER_START_TIME_S, MAX_INPUT_FRACTION * clock.period_ns * 1e-9))

    def _check_samples(self, samples: Samples) -> None:
        """Pass new samples to the safety core, before any command that answers them is handled."""
        now_ns = self._state.clock.safety_ns()
        if self._options.cable_file is not None:
            self._options.cable_file.update(samples.joints)
        self._cycle.process_samples(samples, now_ns)

    def _complete_control_cycle(self, samples: Samples) -> None:
        """Compute, record and send the setpoints of this tick, let the period pass, and wait for the next tick.

        Args:
            samples: Samples of this tick.
        """
        state = self._state
        clock = state.clock
        command_tick = self._newest_command_tick()
        tick_output = self._cycle.compute_setpoints(clock.safety_ns(), clock.tick, command_tick)
        if self.authority.arm_session and self._armed_at_ns is None:
            self._armed_at_ns = time.monotonic_ns()
        if self._is_recorded():
            self.black_box.record_tick(clock.tick, clock.timestamp_ns, samples, tick_output)
        if self.authority.state == "armed":
            self._last_armed_tick = clock.tick
            self.statistics.ticks += 1
            awaited_tick = clock.tick if command_tick is None else command_tick
            is_answered = state.newest_answered_tick >= awaited_tick
            self.statistics.answered_ticks += is_answered

        started_ns = time.monotonic_ns()
        try:
            self._cycle.enact(tick_output)
            self._outbox.publish(
                (
                    keys.APPLIED,
                    make_applied_command(self.description, clock.tick, tick_output),
                    None,
                )
            )
            self._cycle.advance()
        except BackendError as error:
            self._on_backend_failure(error)
        write_ns = state.backend_time.record_write(started_ns)
        if self.authority.state == "armed":
            self.statistics.times.write.add(write_ns / 1000)

        clock.tick += 1
        self._network_watch.report_new_problems()
        self._update_clock_mode_after_fault()
        self._status.publish_if_due()
        self._wait_for_next_tick()
        clock.simulated.on_tick_end(clock.tick)

    def _newest_command_tick(self) -> int | None:
        """Return the newest tick whose command may be used now. None outside of lockstep, where the newest one is."""
        clock = self._state.clock
        holder = self._state.find_lease_holder()
        if clock.clock_mode != "lockstep" or holder is None:
            return None
        return holder.service.used_output_tick(clock.tick + 1)

    def _is_recorded(self) -> bool:
        """Return whether to record this tick. A host that stays after a run must not fill memory while it waits."""
        if self.authority.arm_session == 0:
            return False
        clock = self._state.clock
        unarmed_ns = (clock.tick - self._last_armed_tick) * clock.period_ns
        return not self._options.stays_after_run or unarmed_ns <= RECORD_AFTER_ARMED_NS

    # --- waiting ---------------------------------------------------------------------------------------------

    def _awaits_first_arming(self) -> bool:
        """Return whether the host is in lockstep, and repeats tick 0 until the first arming."""
        return self._state.clock.clock_mode == "lockstep" and self.authority.arm_session == 0

    def _next_published_tick(self) -> int:
        """Return the tick that is published next. In lockstep, tick 0 is repeated until the first arming."""
        last_tick = self._published.last_tick
        if last_tick is None or self._awaits_first_arming():
            return 0
        return last_tick + 1

    def _is_paused(self) -> bool:
        """Return whether the next tick has to wait. A pause does not stop the repetition of tick 0 in lockstep."""
        return self._state.clock.simulated.is_paused and not self._awaits_first_arming()

    def _wait_while_paused(self) -> None:
        """Publish the last clock as a sign of life, and handle input. Physics and robot time do not advance."""
        if self._published.last_tick is not None:
            self._outbox.publish(
                (keys.CLOCK, self._make_clock_message(self._published.last_tick, paused=True), None)
            )
        self._status.publish_if_due()
        self._tick_start_ns = None
        deadline_ns = time.monotonic_ns() + PAUSED_PERIOD_NS
        while (
            not self._requests.simulator_requests
            and (remaining_ns := deadline_ns - time.monotonic_ns()) > 0
        ):
            self._inbox.handle_next_item(remaining_ns * 1e-9)
        self._status.publish_if_due()

    def _wait_for_commands(self, samples: Samples) -> None:
        """Handle input until the commands that answer this tick have arrived, or until it is too late for them."""
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
        deadline_ns = clock.deadlines.start_ns(clock.tick + 1) - write_ns
        if clock.simulated.speed > 1.0 and self.authority.state == "armed":
            # If need be, a faster robot waits as long as one at speed 1.
            _, published_ns = self._published.find_publish_times_ns(clock.tick)
            deadline_ns = max(deadline_ns, published_ns + clock.period_ns)
        while state.newest_answered_tick < clock.tick and not state.ending.requested:
            remaining_ns = deadline_ns - time.monotonic_ns()
            if remaining_ns <= 0 or not self._inbox.handle_next_item(remaining_ns * 1e-9):
                break

    def _wait_for_participants(self, samples: Samples) -> None:
        """Handle input until every service that is due at this tick has answered, or has stalled for too long.

        Services that do not answer within `stall_limit_s` are abandoned: the run continues without them. The end of the
        run ends the wait, too.

        Args:
            samples: Samples of this tick, which are published again if the robot is armed during the wait.
        """
        state = self._state
        tick = state.clock.tick
        state.waiting_since_ns = time.monotonic_ns()
        stall_deadline_ns = state.waiting_since_ns + round(self._config.stall_limit_s * 1e9)
        while not state.ending.requested:
            late_services = self.participants.find_services_behind(tick)
            if not late_services:
                break
            remaining_ns = stall_deadline_ns - time.monotonic_ns()
            # Armed in this tick: publish it.
            if self._published_arm_session != self.authority.arm_session:
                self._publish_samples(samples)
            if remaining_ns > 0:
                self._inbox.handle_next_item(min(remaining_ns * 1e-9, MAX_PARTICIPANT_WAIT_S))
                self._inject_faults()
                self._status.publish_if_due()
            else:
                for name in late_services:
                    self._abandon_service(name)
        state.waiting_since_ns = None

    def _abandon_service(self, service: str) -> None:
        """Stop waiting for a service that has stalled, and log that as a fault."""
        tick = self._state.clock.tick
        self.participants[service].is_abandoned = True
        cause = f"{service} is {self._config.stall_limit_s:g} s late with tick {tick}; no longer waited for"
        self.authority.log_fault(Fault(tick=tick, what="service_stalled", cause=cause))

    def _wait_for_next_tick(self) -> None:
        """Handle input in real time until the next tick is due, and update the statistics of cycle times and delays.

        `clock.tick` is the next tick already. In other clock modes than real time nothing waits.
        """
        clock = self._state.clock
        is_armed = self.authority.state == "armed"
        start_delay_ns: int | None = None
        if clock.clock_mode == "realtime":
            due_ns = clock.deadlines.start_ns(clock.tick)
            if clock.deadlines.missed(clock.tick):
                self.statistics.overruns += is_armed
            else:
                self._inbox.handle_until(due_ns)
            start_delay_ns = time.monotonic_ns() - due_ns

        now_ns = time.monotonic_ns()
        last_start_ns = self._tick_start_ns
        self._tick_start_ns = now_ns
        if is_armed and last_start_ns is not None:
            self.statistics.times.cycle.add((now_ns - last_start_ns) / 1000)
        if is_armed and start_delay_ns is not None:
            self.statistics.times.late.add(start_delay_ns / 1000)

    # --- input, handed over by the inbox ---------------------------------------------------------------------

    def on_command(self, command: JointCommand, monotonic_ns: int) -> None:
        """Pass a command to the safety core, with the age of the joint state that it answers.

        Args:
            command: Command of a client.
            monotonic_ns: Monotonic time at which the command arrived.
        """
        state = self._state
        if command.lease_epoch == self.authority.lease.epoch and self.authority.matches_arm_session(
            command
        ):
            self.on_tick_done(self.authority.lease.holder, command.tick)
        published_safety_ns, published_ns = self._published.find_publish_times_ns(command.tick)
        now_ns = state.clock.safety_ns(monotonic_ns)
        rejection_reason = self.authority.process_command(
            command, now_ns=now_ns, tick=state.clock.tick, age_ns=now_ns - published_safety_ns
        )
        if rejection_reason is None and command.tick > state.newest_answered_tick:
            state.newest_answered_tick = command.tick
            if self.authority.state == "armed":
                self.statistics.state_to_command.add((monotonic_ns - published_ns) / 1000)

    def on_tick_done(self, service: str | None, tick: int) -> None:
        """Mark a tick as completed by a service."""
        if tick <= self._state.clock.tick:
            self.participants.mark_done(service, tick)

    def on_undecodable_message(self, error: WireError) -> Answer:
        """Count a message that cannot be decoded, and return the answer to send if the message was a query."""
        self.authority.count_rejection(error.reason)
        return self._state.make_answer(ok=False, reason=str(error), refusal=error.reason)

    def on_request(self, request: Request, reply: Reply) -> None:
        """Execute a request, and reply once, from any thread."""
        self._requests.handle_request(request, reply)

    def on_service_presence(self, service: str, present: bool) -> None:
        """Mark a service as connected or disconnected. If the lease holder disconnects, log that and free the lease."""
        if present:
            self.participants.mark_present(service, self._next_published_tick())
            return
        if not self.participants.mark_absent(service):
            return
        is_holder = self.authority.lease.holder == service
        if self.authority.arm_session and not self._state.ending.requested:
            cause = f"{service} is gone: its process ended or its connection broke"
            fault = Fault(tick=self._state.clock.tick, what="service_lost", cause=cause)
            self.authority.log_fault(
                fault, precedes_stop=self.authority.state == "armed" and is_holder
            )
        if is_holder:
            self.authority.handle_lease_holder_exit(f"{service} is gone")

    # --- faults and the end ----------------------------------------------------------------------------------

    def _restore_estop(self) -> None:
        """Start in `estop` if an earlier host of this robot was stopped and the stop was not reset."""
        latched_stop = self._latch.left_by_earlier_host
        if latched_stop is not None:
            request = EstopRequest(requester=f"{latched_stop.requester[:40]}, before this host")
            self.authority.handle_estop_request(request, max(latched_stop.tick, 0))

    def _on_backend_failure(self, error: BackendError) -> None:
        """Latch the failure of the backend as a fault, publish the status, and end the run."""
        cause = str(error)[:500]
        self.authority.latch_fault(
            Fault(tick=self._state.clock.tick, what="backend_failed", cause=cause)
        )
        self._status.publish_if_due(force=True)
        self._state.ending.request("failed", cause)

    def _update_clock_mode_after_fault(self) -> None:
        """Use the clock mode for faults, which waits for no service, until the fault is reset."""
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

    def _check_for_end(self) -> bool:
        """Return whether the run is over, and request its end if a condition of the options is met."""
        ending = self._state.ending
        if ending.requested:
            return True
        max_ticks = self._options.max_ticks
        if max_ticks is not None and self.statistics.ticks >= max_ticks:
            ending.request("complete")
        elif (
            max_ticks is not None
            and not self._options.stays_after_run
            and self.black_box.row_count >= max_ticks
        ):
            ending.request(
                "failed", "the time was over before the requested armed time was reached"
            )
        elif self._has_fault_time_passed():
            ending.request("failed", self.authority.reason)
        return ending.requested

    def _has_fault_time_passed(self) -> bool:
        """Return whether the robot has been in a fault for longer than the options allow."""
        if self._faulted_tick is None or self._options.end_after_fault_s is None:
            return False
        clock = self._state.clock
        return (
            clock.tick - self._faulted_tick
        ) * clock.period_ns > self._options.end_after_fault_s * 1e9

    def _close(self) -> None:
        """Disarm the robot, send it safe setpoints, publish the last status, and release all resources."""
        self._state.ending.request("failed", "by an internal error; see host.log")
        self._ended_ns = time.monotonic_ns()
        finish = LifecycleRequest(action="finish", requester="the host")
        self.authority.handle_lifecycle_request(finish, self._state.clock.safety_ns())
        with contextlib.suppress(BackendError):
            self._cycle.enact(self.authority.compute_setpoints())
        self._status.publish_if_due(force=True)
        self._state.faults.close()
        self._latch.close()
        if self._options.cable_file is not None:
            self._options.cable_file.close()
        self._outbox.close(self._state.clock.tick)
