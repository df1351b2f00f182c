"""The HAL host: runs any backend, tick by tick, and is the only process that touches it.

A tick: sample the sensors, publish them, publish the clock, wait for the command that answers them, let the authority
decide, hand the set-points to the backend, let a period pass. How long it waits is the pace:

realtime  until the tick's deadline on the monotonic clock; an old command goes on until its lease ends
lockstep  until every participant that owes something has delivered; frozen at tick 0 until the first arming
free      not at all
"""

import contextlib
import time
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import Any

from snakesim_hal import keys
from snakesim_hal.authority import Authority
from snakesim_hal.backend import Backend, Samples
from snakesim_hal.blackbox import BlackBox
from snakesim_hal.codec import Decoder
from snakesim_hal.errors import BackendError, WireError
from snakesim_hal.messages import (
    Answer,
    AppliedCommand,
    Clock,
    Description,
    Done,
    EstopRequest,
    Fault,
    JointCommand,
    LeaseRequest,
    LifecycleRequest,
    Message,
    Pace,
    Status,
)
from snakesim_hal.participants import Participant, Participants
from snakesim_hal.publish_times import PublishTimes
from snakesim_hal.scenario import RunConfig
from snakesim_hal.session import Arrival, Publisher, Question, Session
from snakesim_hal.telling import applied_message, status_message

INBOX_LIMIT = 4096
STATUS_PERIOD_NS = 200_000_000
STANDBY_PERIOD_NS = 20_000_000
REANCHOR_PERIODS = 1  # later than that, time is moved: ticks that catch up in a burst would break limits of rate


@dataclass
class Tally:
    """What the host measures of itself while armed."""

    ticks: int = 0
    overruns: int = 0
    answered_ticks: int = 0  # commands that came within their own tick
    state_to_command_us: list[float] = field(default_factory=list[float])
    inbox_dropped: int = 0


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
    ) -> None:
        """max_ticks: end this many ticks after the first arming; None: go on until asked to finish.

        end_after_fault_s: end so long after a fault; None: stay, so that a person can clear it.
        """
        self.description: Description = backend.describe()
        self.authority = Authority(self.description, first_epoch=time.time_ns() // 1_000_000)
        self.black_box = BlackBox(self.description)
        self.tally = Tally()
        self.participants = Participants(config.services)
        self._config = config
        self._backend = backend
        self._session = session
        self._max_ticks = max_ticks
        self._end_after_fault_s = end_after_fault_s
        self._pace: Pace = config.pace
        self._period_ns = config.period_ns
        self._tick = 0
        self._anchor_ns = 0  # monotonic time of tick 0 in realtime
        self._published = PublishTimes()
        self._published_arming = 0
        self._newest: dict[str, int] = {}
        self._answered = -1  # newest tick that a good command answered
        self._advance_ns = 0.0  # how long a period takes the backend, smoothed
        self._inbox: SimpleQueue[Any] = SimpleQueue()
        self._stopping = False
        self._armed_at_ns: int | None = None
        self._ended_ns = 0
        self._faulted_at_ns: int | None = None
        self._status_due_ns = 0
        self._status_shown: Any = None
        self._applied_heard = False
        self._publishers: dict[str, Publisher[Any]] = {}
        self._command_decoder = Decoder(JointCommand)
        self._done_decoder = Decoder(Done)
        self._request_decoders: dict[str, Decoder[Any]] = {
            keys.LEASE: Decoder(LeaseRequest),
            keys.LIFECYCLE: Decoder(LifecycleRequest),
            keys.ESTOP: Decoder(EstopRequest),
        }
        self._declare()

    def stop(self) -> None:
        """End the run in order; may be called from a signal handler."""
        self._stopping = True

    def run(self) -> None:
        """Tick until the run is over. The joints are safe when this returns."""
        last: Samples | None = None
        self._anchor_ns = time.monotonic_ns()
        try:
            while not self._over():
                last = self._sample(last)
                if last is None:
                    break
                self._publish(last)
                if self._pace == "lockstep" and self.authority.arming == 0:
                    self._take_until(time.monotonic_ns() + STANDBY_PERIOD_NS)
                    self._show_status()
                    continue
                self._wait_for_answers(last)
                self._finish_tick(last)
        finally:
            self._ended_ns = time.monotonic_ns()
            self.authority.on_lifecycle(LifecycleRequest(action="finish"), self._safety_now())
            with contextlib.suppress(BackendError):
                self._backend.enact(self.authority.decide().set_points, self.authority.state)
            self._show_status(force=True)

    @property
    def wall_s(self) -> float:
        """Wall-clock time from the first arming to the end of the run."""
        return 0.0 if self._armed_at_ns is None else (self._ended_ns - self._armed_at_ns) * 1e-9

    # --- one tick ------------------------------------------------------------------------------------------

    def _sample(self, last: Samples | None) -> Samples | None:
        """Sensors of this tick. While frozen at tick 0 the same sample serves again."""
        if last is not None and self._published.last_tick == self._tick:
            return last
        try:
            samples = self._backend.sample(self._tick, self._tick * self._period_ns)
        except BackendError as error:
            self._backend_failed(error)
            return None
        self.authority.observe(samples.joints)
        return samples

    def _publish(self, samples: Samples) -> None:
        tick = self._tick
        self._put(keys.JOINTS, samples.joints)
        self._newest[keys.JOINTS] = tick
        for key, message in samples.others.items():
            self._put(key, message)
            self._newest[key] = tick
        for name, participant in self.participants.items():
            self._newest[name] = participant.service.counting_at(tick)
        clock = Clock(
            tick=tick,
            stamp_ns=tick * self._period_ns,
            period_ns=self._period_ns,
            pace=self._pace,
            lifecycle=self.authority.state,
            arming=self.authority.arming,
            lease_epoch=self.authority.lease.epoch if self.authority.lease.holder else 0,
            newest=self._newest,
        )
        self._published_arming = self.authority.arming
        self._published.put(tick, self._safety_now(), time.monotonic_ns())
        self._put(keys.CLOCK, clock)

    def _finish_tick(self, samples: Samples) -> None:
        self.authority.expire(self._safety_now(), self._tick)
        counting = self._counting_tick()
        decision = self.authority.decide(counting)
        if self.authority.arming:
            self._armed_at_ns = self._armed_at_ns or time.monotonic_ns()
            self.black_box.record(self._tick, self._tick * self._period_ns, samples, decision)
        if self.authority.state == "armed":
            self.tally.ticks += 1
            self.tally.answered_ticks += self._answered >= (self._tick if counting is None else counting)
        if self._applied_heard:
            self._put(keys.APPLIED, applied_message(self.description, self._tick, decision))
        started = time.monotonic_ns()
        try:
            self._backend.enact(decision.set_points, self.authority.state)
            self._backend.advance()
        except BackendError as error:
            self._backend_failed(error)
        self._advance_ns += 0.1 * (time.monotonic_ns() - started - self._advance_ns)
        for fault in self._backend.faults():
            self.authority.fault(fault)
        self._tick += 1
        self._watch_fault()
        self._show_status()
        if self._pace == "realtime":
            self._wait_for_deadline()

    def _wait_for_answers(self, samples: Samples) -> None:
        if self._pace == "lockstep":
            self._wait_for_participants(samples)
        elif self._pace == "realtime":
            spare_ns = 1.5 * self._advance_ns + 50_000
            while self._answered < self._tick and not self._stopping:
                left_ns = self._deadline_ns() - spare_ns - time.monotonic_ns()
                if left_ns <= 0 or not self._take(left_ns * 1e-9):
                    break
        self._take_all()

    def _wait_for_participants(self, samples: Samples) -> None:
        give_up_ns = time.monotonic_ns() + round(self._config.stall_limit_s * 1e9)
        while (behind := self.participants.behind(self._tick)) and not self._stopping:
            left_ns = give_up_ns - time.monotonic_ns()
            if self._published_arming != self.authority.arming:  # armed in this very tick: tell everybody
                self._publish(samples)
            if left_ns > 0:
                self._take(min(left_ns * 1e-9, 0.5))
                self._show_status()
                continue
            for name in behind:
                self.participants[name].given_up = True
                cause = f"{name} owes tick {self._tick} for {self._config.stall_limit_s:g} s; not waited for any more"
                self.authority.note(Fault(tick=self._tick, what="service_stalled", cause=cause))

    def _deadline_ns(self) -> int:
        return self._anchor_ns + (self._tick + 1) * self._period_ns

    def _wait_for_deadline(self) -> None:
        """Absolute deadlines: a late tick does not push the next ones back, until it is hopeless."""
        deadline = self._anchor_ns + self._tick * self._period_ns
        late_ns = time.monotonic_ns() - deadline
        if late_ns > 0:
            if self.authority.state == "armed":
                self.tally.overruns += 1
            if late_ns > REANCHOR_PERIODS * self._period_ns:
                self._anchor_ns += late_ns
            return
        self._take_until(deadline)

    # --- what comes in -------------------------------------------------------------------------------------

    def _declare(self) -> None:
        session, inbox = self._session, self._inbox

        def take(item: Any) -> None:
            # Only samples may be dropped: a flood of commands must not keep an emergency stop out.
            if not isinstance(item, Arrival) or inbox.qsize() < INBOX_LIMIT:
                inbox.put(item)
            else:
                self.tally.inbox_dropped += 1

        session.on_arrival(keys.JOINT_COMMAND, take)
        session.on_arrival(keys.DONE_ALL, take)
        for key in self._request_decoders:
            session.on_question(key, take)
        session.on_alive(lambda key, present: take((keys.service_of(key), present)))
        self._publishers[keys.STATUS] = session.latched_publisher(keys.STATUS, Status)
        description = session.latched_publisher(keys.DESCRIPTION, Description)
        description.put(self.description)
        session.declare_alive("hal")

    def _take(self, timeout_s: float) -> bool:
        """Handle the next thing that comes in; False when nothing came in time."""
        try:
            item = self._inbox.get(timeout=timeout_s)
        except Empty:
            return False
        self._handle(item)
        return True

    def _take_until(self, monotonic_ns: int) -> None:
        """Handle everything that comes in until a moment has come."""
        while (left_ns := monotonic_ns - time.monotonic_ns()) > 0 and self._take(left_ns * 1e-9):
            pass

    def _take_all(self) -> None:
        for _ in range(self._inbox.qsize()):
            self._handle(self._inbox.get())

    def _handle(self, item: Any) -> None:
        if isinstance(item, Question):
            self._answer(item)
        elif not isinstance(item, Arrival):
            self._came_or_went(*item)
        elif item.key == keys.JOINT_COMMAND:
            self._take_command(item)
        else:
            self._take_done(item)

    def _take_command(self, arrival: Arrival) -> None:
        try:
            command = self._command_decoder.decode(arrival.payload, arrival.encoding)
        except WireError as error:
            self.authority.reject(error.reason)
            return
        if command.lease_epoch == self.authority.lease.epoch and self.authority.answers_arming(command):
            self._delivered(self.authority.lease.holder, command.tick)
        safety_ns, monotonic_ns = self._published.of(command.tick)
        now_ns = self._safety_now(arrival.monotonic_ns)
        refusal = self.authority.offer(command, now_ns=now_ns, tick=self._tick, age_ns=now_ns - safety_ns)
        if refusal is None and command.tick > self._answered:
            self._answered = command.tick
            if self.authority.state == "armed":
                self.tally.state_to_command_us.append((arrival.monotonic_ns - monotonic_ns) / 1000)

    def _take_done(self, arrival: Arrival) -> None:
        try:
            self._delivered(
                keys.service_of(arrival.key),
                self._done_decoder.decode(arrival.payload, arrival.encoding).tick,
            )
        except WireError as error:
            self.authority.reject(error.reason)

    def _delivered(self, service: str | None, tick: int) -> None:
        if tick <= self._tick:
            self.participants.delivered(service, tick)

    def _answer(self, question: Question) -> None:
        now_ns = self._safety_now()
        try:
            request = self._request_decoders[question.key].decode(question.payload, question.encoding)
        except WireError as error:
            self.authority.reject(error.reason)
            question.reply(Answer(ok=False, reason=str(error)[:500], lifecycle=self.authority.state))
            return
        if isinstance(request, LeaseRequest):
            answer = self.authority.on_lease(request, now_ns)
        elif isinstance(request, EstopRequest):
            answer = self.authority.on_estop(request, self._tick)
        elif request.action == "arm" and (missing := self._missing()):
            answer = Answer(ok=False, reason=f"waiting for {', '.join(missing)}", lifecycle=self.authority.state)
        else:
            answer = self.authority.on_lifecycle(request, now_ns)
            if request.action == "arm" and answer.ok:
                self._expect_first_command()
            if request.action == "finish":
                self._stopping = True
        self._show_status(force=True)
        question.reply(answer)

    def _holder(self) -> Participant | None:
        return self.participants.get(self.authority.lease.holder or "")

    def _expect_first_command(self) -> None:
        """What was streamed before the arming does not answer the tick of arming."""
        holder = self._holder()
        if holder is not None:
            holder.done_tick = self._answered = -1

    def _counting_tick(self) -> int | None:
        """In lockstep: the newest tick whose command counts at the end of this one."""
        holder = self._holder()
        if self._pace != "lockstep" or holder is None:
            return None
        return holder.service.counting_at(self._tick + 1)

    def _came_or_went(self, service: str, present: bool) -> None:
        if present:
            self.participants.came(service)
            return
        if not self.participants.went(service):
            return
        if self.authority.arming and not self._stopping:
            cause = f"{service} is gone: its process ended or its connection broke"
            self.authority.note(Fault(tick=self._tick, what="service_lost", cause=cause))
        if self.authority.lease.holder == service:
            self.authority.holder_gone(f"{service} is gone")

    # --- what goes out -------------------------------------------------------------------------------------

    def _put(self, key: str, message: Message) -> None:
        self._publisher(key, type(message)).put(message)

    def _publisher(self, key: str, message: type[Message]) -> Publisher[Any]:
        publisher = self._publishers.get(key)
        if publisher is None:
            publisher = self._session.publisher(key, message, lossless=self._config.pace == "lockstep")
            self._publishers[key] = publisher
        return publisher

    def status(self) -> Status:
        """How the robot is now, and why."""
        return status_message(
            self.authority,
            self.participants,
            tick=self._tick,
            pace=self._pace,
            safety_now_ns=self._safety_now(),
            missing=self._missing(),
            overruns=self.tally.overruns,
        )

    def _show_status(self, *, force: bool = False) -> None:
        """Publish the status when it matters: at once when the lifecycle changed, else a few times a second."""
        now_ns = time.monotonic_ns()
        mark = (self.authority.state, self.authority.lease.epoch, len(self.authority.faults))
        if not force and mark == self._status_shown and now_ns < self._status_due_ns:
            return
        self._status_shown = mark
        self._status_due_ns = now_ns + STATUS_PERIOD_NS
        self._publishers[keys.STATUS].put(self.status())
        self._applied_heard = self._publisher(keys.APPLIED, AppliedCommand).heard()

    # --- time and endings ----------------------------------------------------------------------------------

    def _safety_now(self, monotonic_ns: int | None = None) -> int:
        """Time that leases and ages count in: simulated in lockstep, else the monotonic clock."""
        if self._config.pace == "lockstep":
            return self._tick * self._period_ns
        return time.monotonic_ns() if monotonic_ns is None else monotonic_ns

    def _missing(self) -> list[str]:
        """Participants that are not here, or in lockstep have not answered tick 0 yet."""
        return self.participants.missing(must_have_answered=self._config.pace == "lockstep")

    def _backend_failed(self, error: BackendError) -> None:
        self.authority.fault(Fault(tick=self._tick, what="backend_failed", cause=str(error)[:500]))
        self._show_status(force=True)
        self._stopping = True

    def _watch_fault(self) -> None:
        """After a fault nobody is waited for: what follows is shown in real time, and may end the run."""
        if self.authority.state not in ("fault", "estop"):
            if self._faulted_at_ns is not None:
                self._pace = self._config.pace
            self._faulted_at_ns = None
        elif self._faulted_at_ns is None:
            self._faulted_at_ns = time.monotonic_ns()
            if self._pace != "realtime":
                self._pace = "realtime"
                self._anchor_ns = time.monotonic_ns() - self._tick * self._period_ns

    def _over(self) -> bool:
        if self._stopping:
            return True
        if self._max_ticks is not None and self.black_box.ticks >= self._max_ticks:
            return True
        if self._faulted_at_ns is None or self._end_after_fault_s is None:
            return False
        return time.monotonic_ns() - self._faulted_at_ns > self._end_after_fault_s * 1e9
