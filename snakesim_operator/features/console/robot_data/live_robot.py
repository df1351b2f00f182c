"""The newest message of each key of one robot.

Zenoh's threads only store what arrives; the display loop decodes it when it takes a snapshot. Each key keeps a few
arrivals. So neither a slow page nor a flood of messages costs memory, and invalid messages on a key do not hide valid
ones.
"""

import time
from collections import Counter, deque
from typing import Any

from snakesim_hal.base.errors import WireError
from snakesim_hal.network.robot_mismatch import find_mismatch
from snakesim_hal.network.session import Session
from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MessageDecoder
from snakesim_hal.wire.custom_sample import find_custom_messages
from snakesim_hal.wire.messages import (
    Clock,
    ColorImage,
    CustomSample,
    DepthImage,
    JointState,
    Pose,
    RobotDescription,
    RunConfiguration,
    WorldModel,
)
from snakesim_hal.wire.quantities import Quaternion, Vector
from snakesim_operator.features.console.robot_data.snapshot import MessageStream, RobotSnapshot

# Arrivals of a key that are kept between two snapshots.
MAX_ARRIVALS = 64
MAX_IMAGE_ARRIVALS = 2  # images are large

MAX_CAMERAS = 16
# Enough to find the joint state of the instant of a pose, which arrives later.
MAX_JOINT_STATES = 128
RATE_PERIOD_S = 1.0  # over which the rates of messages are measured
# A host that is silent for longer has ended; it does not count as a second host.
MAX_STATUS_AGE_S = 2.0

LATCHED_MESSAGE_KEYS = (keys.DESCRIPTION, keys.STATUS, keys.PARAMETERS_IN_FORCE, keys.CONFIG)
STREAM_KEYS = (
    keys.CLOCK,
    keys.JOINTS,
    keys.POSE,
    keys.POWER,
    keys.IMU,
    keys.CONTACTS,
    keys.APPLIED,
    keys.WORLD,
    keys.TRAJECTORY,
    keys.CONTROL_STATE,
)
IMAGE_ROWS = (keys.DEPTH_ALL, keys.COLOR_ALL)


class KeyBuffer:
    """The arrivals of one key that are not decoded yet."""

    def __init__(self, message_type: type[Any], max_arrivals: int) -> None:
        self.count = 0  # of all arrivals
        self._arrivals: deque[ReceivedSample] = deque(maxlen=max_arrivals)
        self._decoder: MessageDecoder[Any] = MessageDecoder(message_type)

    def store(self, arrival: ReceivedSample) -> None:
        """Store an arrival; called by Zenoh's threads."""
        self.count += 1
        self._arrivals.append(arrival)

    def decode_all(self, rejected: Counter[str]) -> list[Any]:
        """Return the messages that arrived since the last call, oldest first, and forget them.

        Args:
            rejected: Counts the arrivals that cannot be decoded, by reason.
        """
        messages: list[Any] = []
        while self._arrivals:
            arrival = self._arrivals.popleft()
            try:
                messages.append(self._decoder.decode(arrival.payload, arrival.encoding))
            except WireError as error:
                rejected[error.reason] += 1
        return messages


class LiveRobot:
    """Everything that one robot publishes, as far as the console shows it.

    Zenoh's threads call `_store_sensor_arrival` and the `store` of each buffer; all else belongs to the display loop.
    """

    def __init__(self, session: Session) -> None:
        """Subscribe to everything that a robot publishes.

        Messages are stored on arrival, and decoded for each snapshot.

        Args:
            session: Session on the robot's network.
        """
        now_s = time.monotonic()
        self.rejected = session.rejected
        # Messages, by key.
        self._buffer_by_key: dict[str, KeyBuffer] = {}
        self._newest_by_key: dict[str, Any] = {}
        self._joint_states: deque[JointState] = deque(maxlen=MAX_JOINT_STATES)
        # When a status arrived, from any host and from each host.
        self._last_status_time_s = now_s
        self._last_status_time_by_host_s: dict[str, float] = {}
        # Rates, and the counts of arrivals from which they were measured.
        self._rate_by_key_hz: dict[str, float] = {}
        self._last_count_time_s = now_s
        self._count_by_key: dict[str, int] = {}
        for key in LATCHED_MESSAGE_KEYS:
            buffer = self._add_buffer(key, keys.find_message(key), MAX_ARRIVALS)
            session.on_latched_arrival(key, buffer.store)
        for key in STREAM_KEYS:
            buffer = self._add_buffer(key, keys.find_message(key), MAX_ARRIVALS)
            session.on_arrival(key, buffer.store)
        for key in (*IMAGE_ROWS, keys.CUSTOM_ALL):
            session.on_arrival(key, self._store_sensor_arrival)

    def _add_buffer(self, key: str, message_type: Any, max_arrivals: int) -> KeyBuffer:
        buffer = KeyBuffer(message_type, max_arrivals)
        self._buffer_by_key[key] = buffer
        return buffer

    def _store_sensor_arrival(self, arrival: ReceivedSample) -> None:
        """Store an arrival of a camera or a custom sensor; called by Zenoh's threads.

        Each camera has a key of its own, and gets a buffer with its first image. A custom sensor has a buffer only if
        the robot describes it.
        """
        buffer = self._buffer_by_key.get(arrival.key)
        has_room = (
            len(self._buffer_by_key) < len(LATCHED_MESSAGE_KEYS) + len(STREAM_KEYS) + MAX_CAMERAS
        )
        if buffer is None and has_room and keys.find_row_key(arrival.key) in IMAGE_ROWS:
            buffer = self._add_buffer(
                arrival.key, keys.find_message(arrival.key), MAX_IMAGE_ARRIVALS
            )
        if buffer is not None:
            buffer.store(arrival)

    @property
    def robot(self) -> RobotDescription | None:
        """The newest description."""
        return self._newest_by_key.get(keys.DESCRIPTION)

    def take_snapshot(self) -> RobotSnapshot | None:
        """Decode the messages that have arrived, and return the newest state of the robot.

        Returns:
            The newest message of each kind; a field is None if none has arrived. None until the description of the
            robot has been received.
        """
        self._decode_arrivals()
        self._measure_rates()
        robot = self.robot
        if robot is None:
            return None
        now_s = time.monotonic()
        get_newest = self._newest_by_key.get  # returns None for a key without messages
        clock: Clock | None = get_newest(keys.CLOCK)
        world: WorldModel | None = get_newest(keys.WORLD)
        body, base = self._find_body_and_base(world)
        return RobotSnapshot(
            robot=robot,
            # What the host reports.
            time_s=None if clock is None else clock.timestamp_ns * 1e-9,
            time_since_status_s=now_s - self._last_status_time_s,
            status=get_newest(keys.STATUS),
            configuration=self._find_configuration(robot),
            hosts=self._list_hosts(now_s),
            # What the robot measures.
            joints=get_newest(keys.JOINTS),
            body=body,
            base=base,
            contacts=get_newest(keys.CONTACTS),
            applied=get_newest(keys.APPLIED),
            power=get_newest(keys.POWER),
            imu=get_newest(keys.IMU),
            images={
                key: image
                for key, image in self._newest_by_key.items()
                if isinstance(image, DepthImage | ColorImage)
            },
            custom={
                key: sample
                for key, sample in self._newest_by_key.items()
                if isinstance(sample, CustomSample)
            },
            # What guidance and control publish.
            world=world,
            trajectory=get_newest(keys.TRAJECTORY),
            control=get_newest(keys.CONTROL_STATE),
            parameters=get_newest(keys.PARAMETERS_IN_FORCE),
            # What this process measures.
            streams=self._list_streams(clock),
        )

    # --- arrivals --------------------------------------------------------------------------------------------

    def _decode_arrivals(self) -> None:
        """Decode what has arrived. A message that does not fit the robot is counted and dropped."""
        for key, buffer in list(self._buffer_by_key.items()):
            for message in buffer.decode_all(self.rejected):
                if key == keys.DESCRIPTION:
                    self._update_description(message)
                    continue
                difference = None if self.robot is None else find_mismatch(message, self.robot)
                if difference is not None:
                    self.rejected[difference.reason] += 1
                else:
                    self._keep_message(key, message)

    def _keep_message(self, key: str, message: Any) -> None:
        if keys.find_row_key(key) == keys.CUSTOM_ALL and key not in self._buffer_by_key:
            return  # a custom sensor of a former host, whose description this host has just replaced
        self._newest_by_key[key] = message
        if key == keys.STATUS:
            self._last_status_time_s = time.monotonic()
            self._last_status_time_by_host_s[message.host or ""] = self._last_status_time_s
        elif key == keys.JOINTS:
            self._joint_states.append(message)

    def _update_description(self, robot: RobotDescription) -> None:
        """Keep a description. One of another host makes the messages of the former host void."""
        former = self.robot
        if former is not None and former.host != robot.host:
            # The configuration has a hash, by which `_find_configuration` knows whether it is of this host.
            self._newest_by_key = {
                key: message for key, message in self._newest_by_key.items() if key == keys.CONFIG
            }
            self._joint_states.clear()
            self._last_status_time_by_host_s.clear()
        if former is None or former.custom != robot.custom:
            self._replace_sensor_buffers(robot)
        self._newest_by_key[keys.DESCRIPTION] = robot

    def _replace_sensor_buffers(self, robot: RobotDescription) -> None:
        """Add a buffer for each custom sensor that the robot describes, in the place of the former ones."""
        former_keys = [
            key for key in self._buffer_by_key if keys.find_row_key(key) == keys.CUSTOM_ALL
        ]
        for key in former_keys:
            del self._buffer_by_key[key]
            self._newest_by_key.pop(key, None)
        for key, kind in find_custom_messages(robot).items():
            self._add_buffer(key, kind.message, MAX_ARRIVALS)

    # --- parts of a snapshot ---------------------------------------------------------------------------------

    def _find_configuration(self, robot: RobotDescription) -> RunConfiguration | None:
        """Return the configuration of the host that describes itself, whichever of the two messages came first."""
        configuration: RunConfiguration | None = self._newest_by_key.get(keys.CONFIG)
        if configuration is None or configuration.config_hash != robot.config_hash:
            return None
        return configuration

    def _list_hosts(self, now_s: float) -> frozenset[str]:
        """Return the ids of all hosts that have published a status lately."""
        return frozenset(
            host
            for host, time_s in self._last_status_time_by_host_s.items()
            if now_s - time_s < MAX_STATUS_AGE_S
        )

    def _find_body_and_base(
        self, world: WorldModel | None
    ) -> tuple[JointState | None, tuple[Vector, Quaternion] | None]:
        """Return the pose of the base, and the joint state that was measured nearest to the pose's time.

        The pose is that of guidance, else that of motion capture. Without a pose, the joint state is the newest one.
        """
        pose: Pose | None = self._newest_by_key.get(keys.POSE)
        if world is not None:
            pose_ns = _find_base_time_ns(world)
            base = (world.base_position_w, world.base_orientation_wxyz)
        elif pose is not None:
            pose_ns = pose.timestamp_ns
            base = (pose.position_w, pose.orientation_wxyz)
        else:
            newest = self._joint_states[-1] if self._joint_states else None
            return newest, None
        body = min(
            self._joint_states, key=lambda joints: abs(joints.timestamp_ns - pose_ns), default=None
        )
        return body, base

    def _measure_rates(self) -> None:
        """Measure the rate of each key, once a period."""
        now_s = time.monotonic()
        elapsed_s = now_s - self._last_count_time_s
        if elapsed_s < RATE_PERIOD_S:
            return
        counts = {key: buffer.count for key, buffer in list(self._buffer_by_key.items())}
        self._rate_by_key_hz = {
            key: (count - self._count_by_key.get(key, 0)) / elapsed_s
            for key, count in counts.items()
        }
        self._last_count_time_s = now_s
        self._count_by_key = counts

    def _list_streams(self, clock: Clock | None) -> dict[str, MessageStream]:
        """Return rate and age of each key that has published a message and is not latched."""
        streams: dict[str, MessageStream] = {}
        for key in list(self._buffer_by_key):
            message = self._newest_by_key.get(key)
            if message is not None and key not in LATCHED_MESSAGE_KEYS:
                streams[key] = MessageStream(
                    self._rate_by_key_hz.get(key, 0.0), _find_age_s(message, clock)
                )
        return streams


def _find_base_time_ns(world: WorldModel) -> int:
    """Return the robot time of the base's pose in a world.

    If guidance gives a standard deviation, it has moved the pose on to the world's own timestamp by dead reckoning.
    Else the pose is that of the newest sample of motion capture.
    """
    if world.base_position_sd_m is not None:
        return world.timestamp_ns
    return world.pose_timestamp_ns or world.timestamp_ns


def _find_age_s(message: Any, clock: Clock | None) -> float | None:
    """Return the age of a message in robot time; None if the time is not known, or the message has no timestamp."""
    timestamp_ns = getattr(message, "timestamp_ns", None)
    if clock is None or timestamp_ns is None:
        return None
    return (clock.timestamp_ns - timestamp_ns) * 1e-9
