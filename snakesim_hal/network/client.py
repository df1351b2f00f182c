"""The HAL client of guidance, navigation and control: ticks, readings, outputs, and the right to command.

A service loops over `ticks()`. At a tick it reads the samples that the clock names, so a lockstep run
gives every service the same inputs, however the processes were scheduled.
"""

import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator
from queue import Empty
from typing import Any, Generic

from snakesim_hal.base.errors import NotConnectedError, StalledError, WireError, short
from snakesim_hal.network.mailbox import Mailbox
from snakesim_hal.network.robot_mismatch import mismatch
from snakesim_hal.network.run_key import is_proven, own_run_key
from snakesim_hal.network.session import Arrival, Publisher, Reader, Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder, MessageT
from snakesim_hal.wire.messages import (
    Answer,
    Clock,
    ClockMode,
    Description,
    Done,
    JointCommand,
    JointState,
    LeaseRequest,
    Message,
    Mode,
)
from snakesim_hal.wire.outgoing import checked
from snakesim_hal.wire.own_sample import own_kind_at
from snakesim_hal.wire.setpoints import RequestedSetpoints

KEPT_PER_KEY = 32
NO_TICK = -1  # of messages without a tick, such as an intent: only the newest is kept
MISSING_LIMIT_S = 2.0
LEASE_RETRY_S = 0.25


class Feed(Generic[MessageT]):
    """The samples of one key, by tick."""

    def __init__(
        self, reader: Reader[MessageT], key: str, fits: Callable[[Message], bool] = lambda _message: True
    ) -> None:
        """fits: whether a message fits the robot; others are dropped."""
        self._reader = reader
        self._fits = fits
        self._kept: OrderedDict[int, MessageT] = OrderedDict()
        self.key = key

    def take_in(self, *, newest_only: bool = False) -> None:
        """Store newly arrived samples."""
        if newest_only:
            newest = self._reader.newest(self._fits)
            fitting = [] if newest is None else [newest]
            if fitting:
                self._kept.clear()
        else:
            fitting = [message for message in self._reader.drain() if self._fits(message)]
        for message in fitting:
            tick: int = getattr(message, "tick", NO_TICK)
            self._kept[tick] = message
            self._kept.move_to_end(tick)
        while len(self._kept) > KEPT_PER_KEY:
            self._kept.popitem(last=False)

    def clear(self) -> None:
        """Drop everything: the HAL has restarted."""
        self._kept.clear()

    def newest(self) -> MessageT | None:
        """The sample that arrived last."""
        return self._kept[next(reversed(self._kept))] if self._kept else None

    def at(self, tick: int) -> MessageT | None:
        """The sample of exactly this tick."""
        return self._kept.get(tick)


class RobotFilter:
    """Accepts the messages that fit a robot, and counts the others.

    It is an object of its own because a client's feeds hold it: held by them, the client would never be released.
    """

    def __init__(self, rejected: Counter[str]) -> None:
        """Count into `rejected`, by reason."""
        self._rejected = rejected
        self.robot: Description | None = None  # None: not known yet; every message is accepted

    def accepts(self, message: Message) -> bool:
        """Return whether a message fits the robot, as far as that is known."""
        if self.robot is None:
            return True
        wrong = mismatch(message, self.robot)
        if wrong is None:
            return True
        self._rejected[wrong.reason] += 1
        return False


class Client:
    """A service's connection to one robot's HAL."""

    def __init__(
        self, session: Session, service: str, *, decimation: int = 1, clock_mode: ClockMode = "lockstep"
    ) -> None:
        """decimation: the service acts on ticks that are multiples of this, and ignores the others.

        clock mode: of the run. Clocks of another clock mode are rejected: a service would wait for a lockstep clock.
        """
        self.service = service
        self.session = session
        self._decimation, self._clock_mode = decimation, clock_mode
        self._clocks: Mailbox[Clock] = Mailbox()
        self._heard_at = time.monotonic()
        self.newest_clock: Clock | None = None  # the newest clock, due or not
        self._clock_decoder = Decoder(Clock)
        self._feeds: dict[str, Feed[Any]] = {}
        self._publishers: dict[str, Publisher[Any]] = {}
        self._filter = RobotFilter(session.rejected)
        self._clock: Clock | None = None
        self._ahead: Clock | None = None  # taken from the queue, but not due yet
        self._started_over = False
        self._host_left = False
        self.commanded_tick = -1
        self.lacks: set[str] = set()  # keys that were read at this tick, and had nothing
        session.on_urgent_arrival(keys.CLOCK, self._take_clock)
        session.on_alive(self._take_host, keys.HOST_ALL)

    def description(self, timeout_s: float = 10.0) -> Description:
        """The robot's description. Raises NotConnectedError when no HAL publishes one in time."""
        robot = self._filter.robot or self._own_description(timeout_s)
        if robot is None:
            raise NotConnectedError(f"no robot description within {timeout_s} s; is the robot's HAL host running?")
        self._filter.robot = robot
        return robot

    def subscribe(self, key: str, message: type[MessageT]) -> Feed[MessageT]:
        """Subscribe to a key; do this for all keys before `announce`."""
        feed = Feed(self.session.reader(key, message), key, self._filter.accepts)
        self._feeds[key] = feed
        return feed

    def announce(self) -> None:
        """Declare the service's liveliness token. A lockstep run waits for it from now on."""
        self.session.declare_alive(self.service)

    def ticks(self, silence_s: float | None = None, *, pauses: bool = False) -> Iterator[Clock | None]:
        """Every due tick in lockstep; the newest one otherwise. None after each `silence_s` without any clock.

        pauses: also the clocks of a paused simulator (`Clock.paused`), which are no ticks, and are not answered.
        """
        while True:
            try:
                clock = self._next_clock(silence_s)
            except Empty:
                if silence_s is None or time.monotonic() - self._heard_at >= silence_s:
                    yield None
                continue
            if clock.paused:
                if pauses:
                    yield clock
                continue
            if self._clock is not None and clock.tick < self._clock.tick:
                self._started_over = True
                for feed in self._feeds.values():
                    feed.clear()
            self._clock, self.commanded_tick = clock, -1
            self.lacks.clear()
            for feed in self._feeds.values():
                feed.take_in(newest_only=clock.clock_mode != "lockstep")
            yield clock

    def _next_clock(self, timeout_s: float | None) -> Clock:
        """The next due clock; in lockstep the newest of its tick, which is repeated while time stands still."""
        clock = self._ahead or self._clocks.get(timeout=timeout_s)
        self._ahead = None
        while not self._clocks.empty():
            following = self._clocks.get()
            another = clock.clock_mode == "lockstep" and following.tick != clock.tick
            if another or following.paused != clock.paused:
                self._ahead = following
                break
            clock = following
        return clock

    def wait_for_clock(self, timeout_s: float) -> Clock | None:
        """The newest clock, due or not; waits for the first one. None when none comes in time."""
        deadline = time.monotonic() + timeout_s
        while self.newest_clock is None and time.monotonic() < deadline:
            time.sleep(0.001)
        return self.newest_clock

    def new_description(self) -> Description | None:
        """The robot's description, if it may have another HAL host than at the last call; else None.

        Robot time that starts over shows it, and, when this service was cut off meanwhile, the token of the old host.
        """
        left = self._host_left and self._clock is not None and self._clock.lifecycle != "armed"
        if not self._started_over and not left:
            return None
        self._started_over = self._host_left = False
        self._filter.robot = self._own_description(MISSING_LIMIT_S) or self._filter.robot
        return self._filter.robot

    def _own_description(self, timeout_s: float) -> Description | None:
        """The description of our own run's host; a forged one is ignored."""
        key = own_run_key()
        return self.session.latest(keys.DESCRIPTION, Description, timeout_s, lambda found: is_proven(found, key))

    def _take_host(self, key: str, present: bool) -> None:
        """In Zenoh's thread: a host has appeared or vanished; or the network has, and with it our view of the host."""
        robot = self._filter.robot
        if not present and robot is not None and keys.service_of(key) == robot.host:
            self._host_left = True

    def _take_clock(self, arrival: Arrival) -> None:
        """Runs in Zenoh's thread: wakes the service only for its due ticks."""
        self._heard_at = arrival.monotonic_ns * 1e-9
        try:
            clock = self._clock_decoder.decode(arrival.payload, arrival.encoding)
        except WireError as error:
            self.session.rejected[error.reason] += 1
            return
        if clock.clock_mode == "lockstep" != self._clock_mode:
            self.session.rejected["other_pace"] += 1
            return
        self.newest_clock = clock
        if clock.paused or clock.tick % self._decimation == 0:
            self._clocks.put(clock)

    def read(self, feed: Feed[MessageT]) -> MessageT | None:
        """The valid sample at this tick of the feed's key; None when there is none (yet).

        Raises StalledError when in lockstep the clock names a sample that does not come.
        """
        found = self._read(feed)
        if found is None:
            self.lacks.add(feed.key)
        return found

    def _read(self, feed: Feed[MessageT]) -> MessageT | None:
        clock = self._clock
        if clock is None:
            return None
        wanted = clock.newest.get(feed.key)
        if wanted is None:
            wanted = clock.newest.get(feed.key.partition("/")[0])
        if clock.clock_mode == "lockstep" and wanted is None and feed.key.startswith("sensor/"):
            return None  # a delayed sensor has no sample yet at this tick, but the host may be at a later one already
        if clock.clock_mode != "lockstep" or wanted is None:
            return feed.newest()
        found = feed.at(wanted)
        if found is not None or clock.lifecycle != "armed":
            return found
        deadline = time.monotonic() + MISSING_LIMIT_S
        while time.monotonic() < deadline:
            time.sleep(0.0002)
            feed.take_in()
            found = feed.at(wanted)
            if found is not None:
                return found
        raise StalledError(f"{feed.key} of tick {wanted} was named by the clock of tick {clock.tick} and never came")

    def put(self, key: str, message: Message) -> None:
        """Publish an output of this service. Raises WireError, and sends nothing, when no reader would accept it."""
        try:
            robot = self._filter.robot
            payload = checked(key, message, None if robot is None else own_kind_at(key, robot))
            wrong = None if robot is None else mismatch(message, robot)
            if wrong is not None:
                raise wrong
        except WireError as error:
            tick = "" if (at := getattr(message, "tick", None)) is None else f" of tick {short(str(at), 20)}"
            raise WireError(error.reason, f"{key}{tick} cannot be published: {error.detail}") from None
        self._publisher(key, type(message)).put(message, payload)

    def done(self, tick: int) -> None:
        """Report that all output for a tick is published. A command that answers the tick implies it."""
        if self.commanded_tick != tick:
            self._publisher(keys.done(self.service), Done).put(Done(tick=tick))

    def _publisher(self, key: str, message: type[Message]) -> Publisher[Any]:
        publisher = self._publishers.get(key)
        if publisher is None:
            lossless = self._clock is not None and self._clock.clock_mode == "lockstep"
            publisher = self._publishers[key] = self.session.publisher(key, message, lossless=lossless)
        return publisher


class Commander:
    """The right to command: acquires the lease, and stamps every command with it."""

    def __init__(self, client: Client, description: Description) -> None:
        self._client = client
        self._description = description
        self._epoch = 0
        self._sequence = 0
        self._asked_at = 0.0
        self.refusal: str | None = None

    def holds(self, clock: Clock) -> bool:
        """Whether the lease is ours at this tick; requests it when it is free."""
        if self._epoch and clock.lease_epoch == self._epoch:
            return True
        now = time.monotonic()
        if clock.lifecycle == "armed" or now - self._asked_at < LEASE_RETRY_S:
            return False
        self._asked_at = now
        request = LeaseRequest(action="acquire", holder=self._client.service)
        try:
            answer: Answer = self._client.session.ask(keys.LEASE, request, host=self._description.host)
        except NotConnectedError as error:
            self.refusal = str(error)
            return False
        self.refusal = None if answer.ok else answer.reason
        self._epoch = answer.epoch if answer.ok else 0
        return answer.ok

    def send(self, clock: Clock, joints: JointState, setpoints: RequestedSetpoints) -> None:
        """Publish setpoints that answer a joint state; they are valid for one lease term after its publishing."""
        self._sequence += 1
        command = JointCommand(
            tick=joints.tick,
            arm_session=clock.arm_session,
            sequence=self._sequence,
            lease_epoch=self._epoch,
            layout=self._description.layout,
            valid_for_ns=self._description.lease_ns,
            mode=setpoints.mode,
            target=setpoints.target,
            torque_limit_nm=setpoints.torque_limit_nm,
        )
        self._client.put(keys.JOINT_COMMAND, command)
        self._client.commanded_tick = joints.tick

    def stay(self, joints: JointState) -> RequestedSetpoints:
        """RequestedSetpoints that hold every joint at its angle: sent while the robot is not armed."""
        count = len(self._description.joints)
        limits = [joint.torque_limit_nm for joint in self._description.joints]
        return RequestedSetpoints([Mode.POSITION] * count, list(joints.angle_rad), limits)
