"""The HAL client of guidance, navigation and control: ticks, samples, outputs, and the right to command.

A service loops over `HostClient.iterate_ticks()`. At each tick it reads the samples that the clock names, so a lockstep
run gives every service the same inputs, no matter how the operating system scheduled the processes.

Threads: the service calls every public method from one thread, its own. Zenoh's threads call `_store_clock` and
`_on_host_token` alone; these hand over a clock by a queue, and everything else by setting one attribute.
"""

import time
from collections.abc import Iterator
from queue import Empty
from typing import Any

from snakesim_hal.base.errors import NotConnectedError, StalledError, WireError, shorten
from snakesim_hal.network.feed import RobotFilter, SampleFeed
from snakesim_hal.network.mailbox import Mailbox
from snakesim_hal.network.robot_mismatch import find_mismatch
from snakesim_hal.network.run_key import has_valid_proof, read_own_run_key
from snakesim_hal.network.session import Session
from snakesim_hal.network.streams import Publisher, ReceivedSample
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import EncodedMessage, MessageDecoder, MessageT
from snakesim_hal.wire.custom_sample import find_custom_message
from snakesim_hal.wire.messages import (
    Answer,
    Clock,
    ClockMode,
    JointCommand,
    JointMode,
    JointState,
    LeaseRequest,
    Message,
    RobotDescription,
    TickDone,
)
from snakesim_hal.wire.outgoing import encode_checked
from snakesim_hal.wire.setpoints import RequestedSetpoints

MISSING_SAMPLE_TIMEOUT_S = 2.0  # in lockstep, for a sample or a description that must exist
SAMPLE_POLL_S = 0.0002  # between two looks for such a sample
CLOCK_POLL_S = 0.001
LEASE_RETRY_S = 0.25  # between two requests of the lease
NO_COMMANDED_TICK = -1


class HostClient:
    """A service's connection to one robot's HAL host.

    Example:
        client = Client(session, "guidance")
        poses = client.subscribe(keys.POSE, Pose)
        client.wait_for_description()
        client.announce()
        for clock in client.iterate_ticks():
            pose = client.read(poses)
            ...  # publish with client.publish
            client.report_done(clock.tick)
    """

    def __init__(
        self,
        session: Session,
        service: str,
        *,
        decimation: int = 1,
        clock_mode: ClockMode = "lockstep",
    ) -> None:
        """Subscribe to the robot's clock.

        Args:
            session: Session in the robot's namespace.
            service: Name of this service.
            decimation: Number of ticks between two ticks that the service processes. The other ticks are skipped.
            clock_mode: Clock mode of the run. In any other mode than lockstep, lockstep clocks are rejected: their
                publisher would wait for this service.
        """
        self.service = service
        self.session = session
        self._decimation = decimation
        self._clock_mode = clock_mode
        # Written by Zenoh's threads.
        # Clocks of ticks that this service has to process, and clocks of a paused simulator.
        self._due_clocks: Mailbox[Clock] = Mailbox()
        self.newest_clock: Clock | None = None  # the last clock that arrived, due or not
        self._last_clock_s = time.monotonic()  # monotonic time in s at which it arrived
        self._has_host_left = False  # whether the liveliness token of the host has vanished
        self._clock_decoder = MessageDecoder(Clock)

        # Written by the thread of the service.
        self._current_clock: Clock | None = None  # clock of the tick that the service processes
        # Clock that was popped from `_due_clocks` too early: the next call of `_pop_next_clock` returns it.
        self._postponed_clock: Clock | None = None
        # Whether robot time has restarted since the last `fetch_changed_description`.
        self._has_restarted = False

        # Inputs and outputs, written by the thread of the service.
        self._feeds: dict[str, SampleFeed[Any]] = {}
        self._publishers: dict[str, Publisher[Any]] = {}
        self._filter = RobotFilter(session.rejected)
        self.commanded_tick = NO_COMMANDED_TICK  # last tick that a command of this service answered
        self.missing_keys: set[str] = set()  # keys that were read in this tick, and had no sample

        # From here on, Zenoh's threads call these two.
        session.on_urgent_arrival(keys.CLOCK, self._store_clock)
        session.on_token_change(self._on_host_token, keys.HOST_ALL)

    # --- the robot -------------------------------------------------------------------------------------------

    def wait_for_description(self, timeout_s: float = 10.0) -> RobotDescription:
        """Return the robot's description. The first call waits for it.

        Args:
            timeout_s: Maximum time to wait, in s.

        Raises:
            NotConnectedError: No HAL host publishes a description in time.
        """
        robot = self._filter.robot or self._fetch_description(timeout_s)
        if robot is None:
            raise NotConnectedError(
                f"no robot description within {timeout_s} s; is the robot's HAL host running?",
                code="network/no-robot",
            )
        self._filter.robot = robot
        return robot

    def fetch_changed_description(self) -> RobotDescription | None:
        """Fetch and return the robot's description if its HAL host may have been replaced since the last call.

        The host may have been replaced if robot time has restarted, or if the liveliness token of the host has vanished
        while this service was disconnected.

        Returns:
            The new description, or None if the host is the same.
        """
        # An armed robot still has its host, whose token has only been lost on the network.
        is_host_replaced = (
            self._has_host_left
            and self._current_clock is not None
            and self._current_clock.lifecycle != "armed"
        )
        if not self._has_restarted and not is_host_replaced:
            return None
        self._has_restarted = False
        self._has_host_left = False
        self._filter.robot = self._fetch_description(MISSING_SAMPLE_TIMEOUT_S) or self._filter.robot
        return self._filter.robot

    def _fetch_description(self, timeout_s: float) -> RobotDescription | None:
        """Return the description that the host of this run publishes, or None after the timeout.

        A description without the proof of this run is ignored.
        """
        run_key = read_own_run_key()

        def is_of_this_run(robot: RobotDescription) -> bool:
            return has_valid_proof(robot, run_key)

        return self.session.wait_for_latched(
            keys.DESCRIPTION, RobotDescription, timeout_s, is_of_this_run
        )

    def _on_host_token(self, key: str, present: bool) -> None:
        """Set a flag, in Zenoh's thread, if the liveliness token of the robot's host has vanished."""
        robot = self._filter.robot
        if not present and robot is not None and keys.parse_service(key) == robot.host:
            self._has_host_left = True

    # --- ticks -----------------------------------------------------------------------------------------------

    def announce(self) -> None:
        """Declare the service's liveliness token. A lockstep run waits for its answers from the next tick on."""
        self.session.declare_alive(self.service)

    def iterate_ticks(
        self, silence_timeout_s: float | None = None, *, include_paused: bool = False
    ) -> Iterator[Clock | None]:
        """Iterate over the clocks of the ticks that this service processes, without an end.

        Each tick first fetches the samples that have arrived.

        Args:
            silence_timeout_s: Time in s to wait for a clock before None is yielded instead. None waits without a limit.
            include_paused: Whether to yield also the clocks of a paused simulator (`Clock.paused`). They are not
                ticks, and the service must not answer them.

        Yields:
            The clock of every due tick in lockstep, and of the newest due tick otherwise. None after each
            `silence_timeout_s` without a clock.
        """
        while True:
            try:
                clock = self._pop_next_clock(silence_timeout_s)
            except Empty:
                if (
                    silence_timeout_s is None
                    or time.monotonic() - self._last_clock_s >= silence_timeout_s
                ):
                    yield None
                continue
            if clock.paused:
                if include_paused:
                    yield clock
                continue
            self._start_tick(clock)
            yield clock

    def _start_tick(self, clock: Clock) -> None:
        """Make a clock the current one, and store the samples that have arrived. Drop old samples after a restart."""
        if self._current_clock is not None and clock.tick < self._current_clock.tick:
            self._has_restarted = True
            for feed in self._feeds.values():
                feed.clear()
        self._current_clock = clock
        self.commanded_tick = NO_COMMANDED_TICK
        self.missing_keys.clear()
        newest_only = clock.clock_mode != "lockstep"
        for feed in self._feeds.values():
            feed.store_arrived_samples(newest_only=newest_only)

    def _pop_next_clock(self, timeout_s: float | None) -> Clock:
        """Pop the next due clock from the queue, and drop the clocks that it replaces.

        In lockstep this is the newest clock of the next tick, because the host repeats a tick's clock while time
        is paused. Otherwise it is the newest clock of all. A pause is never skipped.

        Raises:
            Empty: No clock arrived in time.
        """
        clock = self._postponed_clock or self._due_clocks.get(timeout=timeout_s)
        self._postponed_clock = None
        while not self._due_clocks.empty():
            later_clock = self._due_clocks.get()
            is_next_lockstep_tick = (
                clock.clock_mode == "lockstep" and later_clock.tick != clock.tick
            )
            if is_next_lockstep_tick or later_clock.paused != clock.paused:
                self._postponed_clock = later_clock  # the next call returns it
                break
            clock = later_clock
        return clock

    def wait_for_clock(self, timeout_s: float) -> Clock | None:
        """Wait for the first clock, and return the newest one, due or not. Return None if none arrives in time."""
        deadline_s = time.monotonic() + timeout_s
        while self.newest_clock is None and time.monotonic() < deadline_s:
            time.sleep(CLOCK_POLL_S)
        return self.newest_clock

    def _store_clock(self, arrival: ReceivedSample) -> None:
        """Store a clock, in Zenoh's thread, and queue it if its tick is due for this service."""
        self._last_clock_s = arrival.monotonic_ns * 1e-9
        try:
            clock = arrival.decode(self._clock_decoder)
        except WireError as error:
            self.session.rejected[error.reason] += 1
            return
        if clock.clock_mode == "lockstep" and self._clock_mode != "lockstep":
            self.session.rejected["other_clock_mode"] += 1
            return
        self.newest_clock = clock
        if clock.paused or clock.tick % self._decimation == 0:
            self._due_clocks.put(clock)

    # --- inputs ----------------------------------------------------------------------------------------------

    def subscribe(self, key: str, message: type[MessageT]) -> SampleFeed[MessageT]:
        """Subscribe to a key. Do this for all keys before `announce`.

        Args:
            key: The key, without the namespace.
            message: The class of its messages.

        Returns:
            What `read` takes.
        """
        feed = SampleFeed(self.session.declare_reader(key, message), key, self._filter.accepts)
        self._feeds[key] = feed
        return feed

    def read(self, feed: SampleFeed[MessageT]) -> MessageT | None:
        """Return the sample of a feed that is valid at this tick, or None if there is none (yet).

        In real time this is the newest sample. In lockstep it is exactly the sample that the clock names, and an armed
        robot waits for it: a run must not depend on which process was faster.

        Raises:
            StalledError: The clock of an armed robot in lockstep names a sample that does not arrive in time.
        """
        sample = self._find_current_sample(feed)
        if sample is None:
            self.missing_keys.add(feed.key)
        return sample

    def _find_current_sample(self, feed: SampleFeed[MessageT]) -> MessageT | None:
        """Return the sample of a feed that belongs to the current tick, or None if there is none yet.

        In real time this is the newest sample. In lockstep, `Clock.newest` names the tick of the sample, by its key or
        by the first part of its key. While the robot is armed, this waits for the named sample.

        Raises:
            StalledError: A named sample does not arrive in time.
        """
        clock = self._current_clock
        if clock is None:
            return None
        if clock.clock_mode != "lockstep":
            return feed.newest()
        sample_tick = clock.newest.get(feed.key)
        if sample_tick is None:
            key_prefix = feed.key.partition("/")[0]
            sample_tick = clock.newest.get(key_prefix)
        if sample_tick is None:
            if feed.key.startswith("sensor/"):
                # A delayed sensor has no sample yet at this tick. A sample in the feed is from a later tick.
                return None
            return feed.newest()
        sample = feed.get_at_tick(sample_tick)
        if sample is None and clock.lifecycle == "armed":
            sample = self._wait_for_sample(feed, sample_tick, clock)
        return sample

    def _wait_for_sample(self, feed: SampleFeed[MessageT], tick: int, clock: Clock) -> MessageT:
        deadline_s = time.monotonic() + MISSING_SAMPLE_TIMEOUT_S
        while time.monotonic() < deadline_s:
            time.sleep(SAMPLE_POLL_S)
            feed.store_arrived_samples()
            sample = feed.get_at_tick(tick)
            if sample is not None:
                return sample
        raise StalledError(
            f"{feed.key} of tick {tick} was named by the clock of tick {clock.tick} and never came"
        )

    # --- outputs ---------------------------------------------------------------------------------------------

    def publish(self, key: str, message: Message) -> None:
        """Publish an output of this service.

        Args:
            key: The key, without the namespace.
            message: A message of this key's class.

        Raises:
            WireError: No reader would accept the message. Nothing is sent.
        """
        try:
            encoded = self._encode_for_robot(key, message)
        except WireError as error:
            output = _describe_output(key, message)
            raise WireError(error.reason, f"{output} cannot be published: {error.detail}") from None
        self._get_publisher(key, type(message)).put(message, encoded)

    def _encode_for_robot(self, key: str, message: Message) -> EncodedMessage:
        """Return the encoded message. Raises WireError if it is not valid, or does not fit a known robot."""
        robot = self._filter.robot
        if robot is None:
            return encode_checked(key, message, None)
        encoded = encode_checked(key, message, find_custom_message(key, robot))
        # The message that readers in this process check, too.
        mismatch = find_mismatch(encoded.decoded, robot)
        if mismatch is not None:
            raise mismatch
        return encoded

    def report_done(self, tick: int) -> None:
        """Report that all output for a tick is published. A command that answers the tick implies it."""
        if self.commanded_tick != tick:
            self._get_publisher(keys.done_key(self.service), TickDone).put(TickDone(tick=tick))

    def _get_publisher(self, key: str, message: type[Message]) -> Publisher[Any]:
        """Return the publisher of a key, which is declared at its first message."""
        publisher = self._publishers.get(key)
        if publisher is None:
            lossless = (
                self._current_clock is not None and self._current_clock.clock_mode == "lockstep"
            )
            publisher = self.session.declare_publisher(key, message, lossless=lossless)
            self._publishers[key] = publisher
        return publisher


def _describe_output(key: str, message: Message) -> str:
    """Return the key of an output for an error message, with its tick if it has one."""
    tick = getattr(message, "tick", None)
    if tick is None:
        return key
    return f"{key} of tick {shorten(str(tick), 20)}"


class Commander:
    """Holds the right to command: acquires the lease, and adds its epoch to every command.

    The service calls it from its own thread, the one that calls its client.
    """

    def __init__(self, client: HostClient, description: RobotDescription) -> None:
        """Start without the lease.

        Args:
            client: Client that sends the requests and commands.
            description: Description of the robot, with the id of its host.
        """
        self._client = client
        self._description = description
        self._lease_epoch = 0  # epoch of the lease of this service; 0 if it never held the lease
        self._sequence = 0
        self._last_request_time_s = 0.0
        self.lease_refusal: str | None = None  # why the last request for the lease was refused

    def ensure_lease(self, clock: Clock) -> bool:
        """Request the command lease if this service does not hold it.

        A request waits for the host's answer, at most two seconds. No request is sent while the robot is armed, or
        within LEASE_RETRY_S of the last request. If the host refuses, `lease_refusal` has the reason.

        Args:
            clock: Clock of the current tick, which names the lease that the host considers valid.

        Returns:
            Whether this service holds the lease now.
        """
        holds_lease = self._lease_epoch and clock.lease_epoch == self._lease_epoch
        if holds_lease:
            return True
        now_s = time.monotonic()
        has_requested_recently = now_s - self._last_request_time_s < LEASE_RETRY_S
        if clock.lifecycle == "armed" or has_requested_recently:
            return False
        self._last_request_time_s = now_s
        request = LeaseRequest(action="acquire", holder=self._client.service)
        try:
            answer: Answer = self._client.session.send_request(
                keys.LEASE, request, host=self._description.host
            )
        except NotConnectedError as error:
            self.lease_refusal = str(error)
            return False
        if answer.ok:
            self.lease_refusal = None
            self._lease_epoch = answer.epoch
        else:
            self.lease_refusal = answer.reason
            self._lease_epoch = 0
        return answer.ok

    def send_command(self, clock: Clock, joints: JointState, setpoints: RequestedSetpoints) -> None:
        """Publish setpoints that answer a joint state.

        They are valid for one lease period after the joint state was published.

        Args:
            clock: Clock of the current tick, with the arm session.
            joints: Joint state that the setpoints answer.
            setpoints: One mode, target and torque limit for each joint.
        """
        self._sequence += 1
        command = JointCommand(
            tick=joints.tick,
            arm_session=clock.arm_session,
            sequence=self._sequence,
            lease_epoch=self._lease_epoch,
            layout=self._description.layout,
            valid_for_ns=self._description.lease_ns,
            mode=setpoints.mode,
            target=setpoints.target,
            torque_limit_nm=setpoints.torque_limit_nm,
        )
        self._client.publish(keys.JOINT_COMMAND, command)
        self._client.commanded_tick = joints.tick

    def make_hold_setpoints(self, joints: JointState) -> RequestedSetpoints:
        """Return setpoints that hold every joint at its measured angle, to be sent while the robot is not armed."""
        robot_joints = self._description.joints
        modes = [JointMode.POSITION] * len(robot_joints)
        torque_limits_nm = [joint.torque_limit_nm for joint in robot_joints]
        return RequestedSetpoints(modes, list(joints.angle_rad), torque_limits_nm)
