"""The HAL host: runs any backend, tick by tick, and is the only process that touches it.

A tick: sample the sensors, publish them, publish the clock, judge the samples, wait for the command that answers them,
let the authority decide, hand the setpoints to the backend, let a period pass. The clock mode decides how long it
waits:

realtime  until the tick's deadline on the monotonic clock; an old command stays active until its lease ends
lockstep  until every participant whose output is due has delivered; stays at tick 0 until the first arming
free      not at all
"""

import contextlib
import secrets
import time
from collections.abc import Callable, Generator, Sequence
from math import inf
from typing import Any

import msgspec

from snakesim_hal.backend import Backend, Samples
from snakesim_hal.base.arithmetic import measured
from snakesim_hal.base.errors import BackendError, WireError
from snakesim_hal.faults.allowed import Faults, NoFaults
from snakesim_hal.host.cable_file import CableFile
from snakesim_hal.host.inbox import Inbox, Request
from snakesim_hal.host.latch import EstopLatch, replying
from snakesim_hal.host.outbox import Outbox, Outgoing
from snakesim_hal.host.participants import Participant, Participants
from snakesim_hal.host.run_statistics import RunStatistics
from snakesim_hal.host.simulated_time import Refusal, SimulatedTime
from snakesim_hal.host.status_messages import applied_message, waiting_for
from snakesim_hal.host.timing import BackendTime, Deadlines, PublishTimes
from snakesim_hal.model.fault_kinds import HAL
from snakesim_hal.model.scenario import RunConfig, written
from snakesim_hal.network.private_channel import HostEnd, HostMessage
from snakesim_hal.network.process_entries import HOST, ProcessEntries, own_entry, show_process
from snakesim_hal.network.run_key import own_run_key, proven
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
    LeaseRequest,
    LifecycleRequest,
    Power,
    SimulatorRequest,
    Status,
)

STATUS_PERIOD_NS = 200_000_000
STANDBY_PERIOD_NS = 20_000_000
STANDING_PERIOD_NS = 50_000_000  # between signs of life while a simulator is paused
HELD_UP_NS = 500_000_000  # that a tick has waited for answers until the status says so
STATUS_GAP_NS = 10_000_000  # between status messages for frequent changes, such as a contested lease
BEGIN_S = 0.0001  # for the threads that send a tick; then the host judges it while it is on its way to the services
TAKEN_SHARE = 0.25  # of a period, for late arrivals: a flood must not take all of it
MAX_REQUESTS_KEPT = 256
RECORDED_AFTER_NS = 2_000_000_000  # recorded after the last armed tick, in a host that stays


class Host:
    """One robot, one backend, one session."""

    def __init__(
        self,
        config: RunConfig,
        backend: Backend,
        session: Session,
        *,
        max_ticks: int | None = None,
        end_after_fault_s: float | None = None,
        pace_after_fault: ClockMode = "realtime",
        stay: bool = False,
        latch: EstopLatch | None = None,
        starter: HostEnd | None = None,
        realtime_warnings: Sequence[str] = (),
        faults: Faults | None = None,
        unchecked: str = "",
        cables: CableFile | None = None,
    ) -> None:
        """backend: guarded, as by `open_backend`.

        max_ticks: end this many ticks after the first arming; None: go on until asked to finish.

        end_after_fault_s: end after so much robot time in a fault; None: stay, so that a person can clear it.
        pace_after_fault: of ticks that wait for no service.
        stay: count only armed ticks, and record little in between; else count all ticks from the first arming.
        latch: stores an emergency stop for later hosts.
        starter: the private channel to the process that started this host.
        realtime_warnings: real-time measures that the system refused.
        unchecked: why only an explicit word arms it, by `why_unchecked`.
        cables: of joints without end stops.
        faults: injected ones, of `faults_of_host`, as the backend is then; None: refused on request.
        """
        described = msgspec.structs.replace(backend.describe(), host=secrets.token_hex(8), arithmetic=measured())
        self.description: Description = proven(described, own_run_key())
        self.authority = Authority(
            self.description,
            first_epoch=time.time_ns() // 1_000_000,
            awaits_reports=config.clock_mode == "realtime",
            unchecked=unchecked,
            cables=None if cables is None else cables.cables,
        )
        self.black_box = BlackBox(self.description)
        self.statistics = RunStatistics()
        self.requests: list[str] = []  # who requested to arm, disarm, clear, finish or stop, and the result
        self.participants = Participants(config.services)
        self._config = config
        self.faults: Faults = faults or NoFaults(HAL, config, session)
        self._backend = backend
        self._max_ticks = max_ticks
        self._end_after_fault_s = end_after_fault_s
        self._pace_after_fault: ClockMode = pace_after_fault
        self._stay = stay
        self._latch = latch or EstopLatch(None)
        self._cables = cables
        self._starter = starter or HostEnd(None)
        self._realtime_warnings = list(realtime_warnings)
        self._clock_mode: ClockMode = config.clock_mode
        self._period_ns = config.period_ns
        self._tick = 0
        self._time = SimulatedTime(self.description, config.clock_mode, time.monotonic_ns)
        self._time_requests: list[tuple[SimulatorRequest, Callable[[Answer], None]]] = []  # until the next tick begins
        self._deadlines = Deadlines(config.period_ns)
        self._published = PublishTimes()
        self._published_arm_session = 0
        self._tick_began_ns: int | None = None  # unless time stood since
        self._waiting_since_ns: int | None = None  # for the services' answers that end this tick
        self._newest: dict[str, int] = {}
        self._last_armed_tick = 0
        self._other_hosts: set[str] = set()
        self._network_faults: set[str] = set()
        self._answered = -1  # newest tick that an accepted command answered
        self._backend_time = BackendTime(self.description.backend, self._period_ns)
        self._stopping = False
        self.ended: Ending = "running"
        self.ended_why = ""
        self._armed_at_ns: int | None = None
        self._ended_ns = 0
        self._faulted_at: int | None = None  # tick
        self._status_due_ns = 0
        self._status_shown: Any = None
        if (found := self._latch.found) is not None:
            self.authority.on_estop(EstopRequest(who=f"{found.who[:40]}, before this host"), max(found.tick, 0))
        self._outbox = Outbox(session, self.description, written(config), lockstep=config.clock_mode == "lockstep")
        self._entry = own_entry(HOST, config)
        show_process(session, self._entry)
        self._processes = ProcessEntries(session)
        self._inbox = Inbox(session, self, config.services, self._outbox.answer)
        session.on_alive(self._another_host, keys.HOST_ALL)
        self._starter.say(HostMessage(description=self.description))
        self._starter.serve(self.ask)

    def stop(self) -> None:
        """End the run in order; may be called from a signal handler."""
        self._end("stopped", "by a signal")

    def complete(self) -> None:
        """End the run as after all of its time: what was to be done is done."""
        self._end("complete")

    def _end(self, ended: Ending, why: str = "") -> None:
        """End the run in order. The first reason is kept."""
        if self.ended == "running":
            self.ended, self.ended_why = ended, why
        self._stopping = True

    def take_stop(self, who: str, reply: Callable[[str], None]) -> None:
        """An emergency stop from the stop port; from any thread."""
        self.ask(EstopRequest(who=who[:64] or "an unnamed client"), lambda answer: reply(answer.reason))

    def ask(self, request: Request, reply: Callable[[Answer], None]) -> None:
        """A request that does not come over the network; from any thread."""
        self._inbox.ask(request, reply)

    def run(self) -> None:
        """Tick until the run is over. The joints are safe when this returns."""
        for _ in self.turns():
            pass

    def turns(self) -> Generator[None]:
        """Like `run`; yields in each tick when the clock is out, for those who act in the same thread."""
        last: Samples | None = None
        self._deadlines.begin(0)
        try:
            while not self._over():
                self._inject()
                self._change_time()
                if self._is_held():
                    yield
                    self._wait_held()
                    continue
                before, last = last, self._sample(last)
                if last is None:
                    break
                self._publish(last)
                if last is not before:
                    self._let_services_begin()
                    self._judge(last)
                yield
                if self._clock_mode == "lockstep" and self.authority.arm_session == 0:
                    self._inbox.take_until(time.monotonic_ns() + STANDBY_PERIOD_NS)
                    self._show_status()
                    continue
                self._wait_for_answers(last)
                self._finish_tick(last)
        finally:
            self._end("failed", "by an internal error; see host.log")
            self._ended_ns = time.monotonic_ns()
            self.authority.on_lifecycle(LifecycleRequest(action="finish", who="the host"), self._safety_now())
            with contextlib.suppress(BackendError):
                self._backend.enact(self.authority.decide().setpoints, self.authority.state)
            self._show_status(force=True)
            self.faults.close()
            self._latch.close()
            if self._cables is not None:
                self._cables.close()
            self._outbox.close()

    def take_in(self) -> None:
        """Handle what has come in, and return."""
        self._inbox.take_all(inf)

    @property
    def wall_s(self) -> float:
        """Wall-clock time from the first arming to the end of the run, or until now."""
        if self._armed_at_ns is None:
            return 0.0
        return ((self._ended_ns or time.monotonic_ns()) - self._armed_at_ns) * 1e-9

    # --- one tick ------------------------------------------------------------------------------------------

    def _sample(self, last: Samples | None) -> Samples | None:
        """Samples of this tick. While waiting at tick 0 the same sample is used again."""
        if last is not None and self._published.last_tick == self._tick:
            return last
        started = time.monotonic_ns()
        try:
            samples = self._backend.sample(self._tick, self._tick * self._period_ns)
            took_ns = self._backend_time.read(started)
            if self.authority.state == "armed":
                self.statistics.times.read.add(took_ns / 1000)
        except BackendError as error:
            self._backend_failed(error)
            return None
        return samples

    def _let_services_begin(self) -> None:
        """In real time: leave the interpreter to the threads that send, unless a service in this process wants it."""
        if self._clock_mode == "realtime" and not self._config.beside:
            self._inbox.wait(min(BEGIN_S, TAKEN_SHARE * self._period_ns * 1e-9))

    def _judge(self, samples: Samples) -> None:
        """The authority's view of new samples, before any answer to them is taken in; services compute meanwhile."""
        now_ns = self._safety_now()
        if self._cables is not None:
            self._cables.take(samples.joints)
        self.authority.observe(samples.joints, now_ns)
        power = samples.others.get(keys.POWER)
        if isinstance(power, Power):
            self.authority.observe_power(power, now_ns)

    def _inject(self) -> None:
        """Faults on request, where they are allowed."""
        for why in self.faults.turn(self._tick * self._period_ns, self.authority.arm_session, self.authority.state):
            self.authority.note(Fault(tick=self._tick, what="injection_refused", cause=why))

    def _is_held(self) -> bool:
        """Whether the next tick has to wait. In lockstep tick 0 is shown until it is armed, also in a pause."""
        return self._time.stands and not (self._clock_mode == "lockstep" and self.authority.arm_session == 0)

    def _wait_held(self) -> None:
        """Paused: show that the host is there, and take in what comes; physics and robot time stand."""
        if self._published.last_tick is not None:
            self._outbox.put((keys.CLOCK, self._clock(self._published.last_tick, paused=True), None))
        self._show_status()
        self._tick_began_ns = None
        until_ns = time.monotonic_ns() + STANDING_PERIOD_NS
        while not self._time_requests and (left_ns := until_ns - time.monotonic_ns()) > 0:
            self._inbox.take(left_ns * 1e-9)
        self._show_status()

    def _change_time(self) -> None:
        """Carry out what was asked of the simulator's time, between two ticks."""
        requests, self._time_requests = self._time_requests, []
        for request, reply in requests:
            outcome = self._time.take(request, self._tick)
            if isinstance(outcome, Refusal):
                answer = self._answer(ok=False, reason=outcome.why, refusal=outcome.word)
            else:
                self._deadlines.begin(self._tick, self._time.speed)
                if request.action == "reset":
                    self.authority.on_lifecycle(LifecycleRequest(action="finish", who=request.who), self._safety_now())
                    self._end("reset", f"by {request.who}")
                answer = self._answer(ok=True, reason=outcome)
            self._keep(request, answer)
            self._show_status()
            reply(answer)

    def _publish(self, samples: Samples) -> None:
        tick = self._tick
        encoded = samples.encoded
        outgoing: list[Outgoing] = [(keys.JOINTS, self.authority.readable(samples.joints), None)]
        outgoing += [(key, message, encoded[key]) for key, message in samples.others.items()]
        for key, _, _ in outgoing:
            self._newest[key] = tick
        for name, participant in self.participants.items():
            self._newest[name] = participant.service.used_output_tick(tick)
        clock = self._clock(tick)
        self._published_arm_session = self.authority.arm_session
        self._published.put(tick, self._safety_now(), time.monotonic_ns())
        self._outbox.put(*outgoing, (keys.CLOCK, clock, None))

    def _clock(self, tick: int, *, paused: bool = False) -> Clock:
        return Clock(
            tick=tick,
            timestamp_ns=tick * self._period_ns,
            period_ns=self._period_ns,
            clock_mode=self._clock_mode,
            lifecycle=self.authority.state,
            arm_session=self.authority.arm_session,
            lease_epoch=self.authority.lease.epoch if self.authority.lease.holder else 0,
            newest=self._newest,
            paused=paused,
        )

    def _finish_tick(self, samples: Samples) -> None:
        self.authority.expire(self._safety_now(), self._tick)
        counting = self._used_command_tick()
        decision = self.authority.decide(counting)
        if self.authority.arm_session:
            self._armed_at_ns = self._armed_at_ns or time.monotonic_ns()
        if self._recorded():
            self.black_box.record(self._tick, self._tick * self._period_ns, samples, decision)
        if self.authority.state == "armed":
            self._last_armed_tick = self._tick
            self.statistics.ticks += 1
            self.statistics.answered_ticks += self._answered >= (self._tick if counting is None else counting)
        started = time.monotonic_ns()
        try:
            self._backend.enact(decision.setpoints, self.authority.state)
            self._outbox.put((keys.APPLIED, applied_message(self.description, self._tick, decision), None))
            self._backend.advance()
            for fault in self._backend.faults():
                self.authority.fault(fault)
        except BackendError as error:
            self._backend_failed(error)
        took_ns = self._backend_time.written(started)
        if self.authority.state == "armed":
            self.statistics.times.write.add(took_ns / 1000)
        self._tick += 1
        self._watch_network()
        self._watch_fault()
        self._show_status()
        self._wait_for_deadline()
        self._time.tick_done(self._tick)

    def _wait_for_deadline(self) -> None:
        """Of the next tick, in real time; and count how this one kept time."""
        armed, late_ns = self.authority.state == "armed", None
        if self._clock_mode == "realtime":
            due_ns = self._deadlines.of(self._tick)
            if self._deadlines.missed(self._tick):
                self.statistics.overruns += armed
            else:
                self._inbox.take_until(due_ns)
            late_ns = time.monotonic_ns() - due_ns
        now_ns, began_ns = time.monotonic_ns(), self._tick_began_ns
        self._tick_began_ns = now_ns
        if armed and began_ns is not None:
            self.statistics.times.cycle.add((now_ns - began_ns) / 1000)
        if armed and late_ns is not None:
            self.statistics.times.late.add(late_ns / 1000)

    def _recorded(self) -> bool:
        """Whether to record this tick: a host that stays must not fill memory while it waits."""
        waited_ns = (self._tick - self._last_armed_tick) * self._period_ns
        return self.authority.arm_session > 0 and not (self._stay and waited_ns > RECORDED_AFTER_NS)

    def _wait_for_answers(self, samples: Samples) -> None:
        if self._clock_mode == "lockstep":
            self._wait_for_participants(samples)
        elif self._clock_mode == "realtime":
            give_up_ns = self._deadlines.of(self._tick + 1) - 1.5 * self._backend_time.write_ns - 50_000
            if self._time.speed > 1.0 and self.authority.state == "armed":  # as much time as at speed 1, if need be
                give_up_ns = max(give_up_ns, self._published.of(self._tick)[1] + self._period_ns)
            while self._answered < self._tick and not self._stopping:
                left_ns = give_up_ns - time.monotonic_ns()
                if left_ns <= 0 or not self._inbox.take(left_ns * 1e-9):
                    break
        self._inbox.take_all(inf if self._clock_mode == "lockstep" else TAKEN_SHARE * self._period_ns)

    def _wait_for_participants(self, samples: Samples) -> None:
        self._waiting_since_ns = time.monotonic_ns()
        give_up_ns = self._waiting_since_ns + round(self._config.stall_limit_s * 1e9)
        while (behind := self.participants.behind(self._tick)) and not self._stopping:
            left_ns = give_up_ns - time.monotonic_ns()
            if self._published_arm_session != self.authority.arm_session:  # armed in this tick: publish it
                self._publish(samples)
            if left_ns > 0:
                self._inbox.take(min(left_ns * 1e-9, 0.5))
                self._inject()
                self._show_status()
                continue
            for name in behind:
                self.participants[name].given_up = True
                cause = f"{name} is {self._config.stall_limit_s:g} s late with tick {self._tick}; no longer waited for"
                self.authority.note(Fault(tick=self._tick, what="service_stalled", cause=cause))
        self._waiting_since_ns = None

    # --- inputs --------------------------------------------------------------------------------------------

    def take_command(self, command: JointCommand, monotonic_ns: int) -> None:
        """A command, and its time of arrival."""
        if command.lease_epoch == self.authority.lease.epoch and self.authority.answers_arm_session(command):
            self.take_done(self.authority.lease.holder, command.tick)
        safety_ns, published_ns = self._published.of(command.tick)
        now_ns = self._safety_now(monotonic_ns)
        refusal = self.authority.offer(command, now_ns=now_ns, tick=self._tick, age_ns=now_ns - safety_ns)
        if refusal is None and command.tick > self._answered:
            self._answered = command.tick
            if self.authority.state == "armed":
                self.statistics.state_to_command.add((monotonic_ns - published_ns) / 1000)

    def take_done(self, service: str | None, tick: int) -> None:
        """A service has completed a tick."""
        if tick <= self._tick:
            self.participants.delivered(service, tick)

    def refuse(self, error: WireError) -> Answer:
        """A message cannot be decoded; returns the answer if it was a query."""
        self.authority.reject(error.reason)
        return self._answer(ok=False, reason=str(error), refusal=error.reason)

    def _answer(self, *, ok: bool, reason: str, refusal: str | None = None) -> Answer:
        return Answer(
            ok=ok,
            reason=reason[:500],
            refusal=refusal,
            lifecycle=self.authority.state,
            host=self.description.host,
        )

    def answer(self, request: Request, reply: Callable[[Answer], None]) -> None:
        """A request for the lease, for another state, or for a stop; replies once, from any thread."""
        now_ns = self._safety_now()
        if isinstance(request, LeaseRequest):
            self.authority.expire(now_ns, self._tick)  # first: an expired lease is a fault
            answer = self.authority.on_lease(request, now_ns)
        elif isinstance(request, EstopRequest):
            answer = self.authority.on_estop(request, self._tick)
        elif request.host not in (None, self.description.host):
            meant = f"this is host {self.description.host}, the request is for {request.host}: two have one name"
            answer = self._answer(ok=False, reason=meant, refusal="wrong_host")
        elif isinstance(request, SimulatorRequest):
            self._time_requests.append((request, reply))
            return
        elif request.action == "arm" and (missing := self._missing()):
            waiting = f"waiting for {', '.join(missing)}"
            answer = self._answer(ok=False, reason=waiting, refusal="not_ready")
        elif request.action == "arm" and (differing := self._differing()):
            answer = self._answer(ok=False, reason="; ".join(differing), refusal="settings_differ")
        else:
            answer = self.authority.on_lifecycle(request, now_ns)
            if request.action == "arm" and answer.ok and (holder := self._holder()) is not None:
                holder.done_tick = self._answered = -1  # commands from before the arming do not answer its tick
            if request.action == "finish":
                by = f" by {request.who}" if request.who else ""
                self._end("finished", f"on request{by}")
        answer = msgspec.structs.replace(answer, host=self.description.host)
        if not isinstance(request, LeaseRequest):
            self._keep(request, answer)
        self._show_status()
        if isinstance(request, EstopRequest):
            self._latch.engage(request.who, self._tick, replying(reply, answer))
        elif isinstance(request, LifecycleRequest) and request.action == "clear" and answer.ok:
            self._latch.release(replying(reply, answer))
        else:
            reply(answer)

    def _keep(self, request: LifecycleRequest | EstopRequest | SimulatorRequest, answer: Answer) -> None:
        """Store a request and its result, for the record and the log."""
        action = "estop" if isinstance(request, EstopRequest) else request.action
        outcome = "done" if answer.ok else f"refused: {answer.reason}"
        asked = f"tick {self._tick}: {action} by {request.who!r}, {outcome}"
        if len(self.requests) < MAX_REQUESTS_KEPT:
            self.requests.append(asked)
            self._outbox.log(asked)

    def _holder(self) -> Participant | None:
        return self.participants.get(self.authority.lease.holder or "")

    def _used_command_tick(self) -> int | None:
        """In lockstep: the newest tick whose command is used at the end of this one."""
        holder = self._holder()
        if self._clock_mode != "lockstep" or holder is None:
            return None
        return holder.service.used_output_tick(self._tick + 1)

    def presence_changed(self, service: str, present: bool) -> None:
        """A service's liveliness token has appeared or vanished."""
        if present:
            self.participants.came(service)
            return
        if not self.participants.went(service):
            return
        if self.authority.arm_session and not self._stopping:
            cause = f"{service} is gone: its process ended or its connection broke"
            commands = self.authority.state == "armed" and self.authority.lease.holder == service
            self.authority.note(Fault(tick=self._tick, what="service_lost", cause=cause), precedes_stop=commands)
        if self.authority.lease.holder == service:
            self.authority.holder_gone(f"{service} is gone")

    def _another_host(self, key: str, present: bool) -> None:
        """In Zenoh's thread: a host process of this robot's name appeared or vanished."""
        host = keys.service_of(key)
        if host != self.description.host:
            (self._other_hosts.add if present else self._other_hosts.discard)(host)

    def _watch_network(self) -> None:
        """Note problems of the network, once when each begins."""
        # In lockstep a lease counts in simulated time: a slow computer is not a blocked network.
        held_up = self._clock_mode != "lockstep" and self._outbox.held_up_s() * 1e9 > self._config.lease_ns
        if not (held_up or self._other_hosts or self._network_faults):
            return
        wrong = {f"another HAL host has this robot's name: {host}": "second_host" for host in set(self._other_hosts)}
        if held_up:
            wrong["the network accepts no message: it is congested, or under attack"] = "network_held_up"
        for cause in wrong.keys() - self._network_faults:
            self.authority.note(Fault(tick=self._tick, what=wrong[cause], cause=cause))
        self._network_faults = set(wrong)

    # --- outputs -------------------------------------------------------------------------------------------

    def status(self) -> Status:
        """The present status of the robot."""
        authority, robot = self.authority, self.description
        against = authority.against_arming(self._time.safety_ns(self._tick))
        missing, differing = self._missing(), self._differing()
        slow_backend = self._backend_time.too_slow() if self._clock_mode == "realtime" else []
        why = authority.why
        if authority.state == "disarmed" and (against or missing or differing):
            lacks = self._processes.waits()
            waits = [waiting_for(name, lacks.get(name, ())) for name in missing]
            why = "; ".join([why, *slow_backend, *differing, *waits, *against])[:500]
        return Status(
            tick=self._tick,
            timestamp_ns=self._tick * robot.period_ns,
            robot=robot.robot,
            backend=robot.backend,
            clock_mode=self._clock_mode,
            rate_hz=1e9 / robot.period_ns,
            lifecycle=authority.state,
            why=why,
            lease_holder=authority.lease.holder,
            lease_epoch=authority.lease.epoch,
            commands_accepted=authority.accepted,
            commands_standby=authority.standby,
            commands_rejected=dict(authority.rejected),
            commands_limited=dict(authority.limited),
            faults=authority.faults,
            faults_left_out=authority.since_clear.left_out,
            alive=self.participants.present(),
            waiting_for=missing,
            overruns=self.statistics.overruns,
            tick_times=self.statistics.times.timings(),
            realtime_warnings=[*self._realtime_warnings, *slow_backend, *self._time.slow()],
            injected=list(self.faults.on),
            ready_to_arm=not against and not missing and not differing,
            derated=authority.derated,
            isolated=authority.isolated,
            host=robot.host,
            paused_by=self._time.paused_by if self._time.stands else None,
            speed=self._time.speed,
            real_time_factor=self._time.factor,
            held_up=self._held_up()[:500],
            unchecked=authority.unchecked[:500],
        )

    def _held_up(self) -> str:
        """What lockstep has been waiting for, if for longer than HELD_UP_NS."""
        waited_ns = 0 if self._waiting_since_ns is None else time.monotonic_ns() - self._waiting_since_ns
        if waited_ns < HELD_UP_NS:
            return ""
        return f"tick {self._tick} waits for {self.participants.awaited(self._tick)}, for {waited_ns * 1e-9:.1f} s"

    def _show_status(self, *, force: bool = False) -> None:
        """Publish the status: at once when the lifecycle changed, else a few times a second."""
        now_ns, was = time.monotonic_ns(), self._status_shown
        time_now = self._time.stands, self._time.speed
        mark = (self.authority.state, self.authority.lease.epoch, len(self.authority.faults), time_now)
        due_ns = self._status_due_ns if mark == was else self._status_due_ns - STATUS_PERIOD_NS + STATUS_GAP_NS
        if not force and now_ns < due_ns and was is not None and mark[0] == was[0]:
            return
        self._status_shown = mark
        self._status_due_ns = now_ns + STATUS_PERIOD_NS
        status = self.status()
        self._outbox.put((keys.STATUS, status, None))
        self._starter.say(HostMessage(status=status))

    # --- time and endings ----------------------------------------------------------------------------------

    def _safety_now(self, monotonic_ns: int | None = None) -> int:
        """Time of leases and ages: simulated in lockstep, else the monotonic clock, as long as it is not paused."""
        return self._time.safety_ns(self._tick, monotonic_ns)

    def _missing(self) -> list[str]:
        """Participants that are not connected, or in lockstep have not answered tick 0 yet."""
        return self.participants.missing(must_have_answered=self._config.clock_mode == "lockstep")

    def _differing(self) -> list[str]:
        """How processes of the services that it waits for differ from this host, or that they have not said yet."""
        return self._processes.against(self._entry, self.participants)

    def _backend_failed(self, error: BackendError) -> None:
        self.authority.fault(Fault(tick=self._tick, what="backend_failed", cause=str(error)[:500]))
        self._show_status(force=True)
        self._end("failed", str(error)[:500])

    def _watch_fault(self) -> None:
        """After a fault the host stops waiting for services, goes on in real time, and may end the run."""
        if self.authority.state not in ("fault", "estop"):
            if self._faulted_at is not None:
                self._clock_mode = self._config.clock_mode
            self._faulted_at = None
        elif self._faulted_at is None:
            self._faulted_at = self._tick
            if self._clock_mode != "realtime":
                self._clock_mode = self._pace_after_fault
                self._deadlines.begin(self._tick)

    def _over(self) -> bool:
        if self._stopping:
            return True
        if self._max_ticks is not None and self.statistics.ticks >= self._max_ticks:
            self._end("complete")
        elif self._max_ticks is not None and not self._stay and self.black_box.ticks >= self._max_ticks:
            self._end("failed", "the time was over before the requested armed time was reached")
        elif self._settled_after_fault():
            self._end("failed", self.authority.why)
        return self._stopping

    def _settled_after_fault(self) -> bool:
        if self._faulted_at is None or self._end_after_fault_s is None:
            return False
        return (self._tick - self._faulted_at) * self._period_ns > self._end_after_fault_s * 1e9
