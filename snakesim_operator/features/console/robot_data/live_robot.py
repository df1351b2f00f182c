"""The newest message of each key of one robot. Zenoh's threads only store; decoding happens at `snapshot`.

Each key keeps a few arrivals, so that neither a slow page nor a flood costs memory, and noise on a key does not hide
its good messages.
"""

import time
from collections import Counter, deque
from typing import Any

from snakesim_hal.base.errors import WireError
from snakesim_hal.network.robot_mismatch import mismatch
from snakesim_hal.network.session import Arrival, Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder
from snakesim_hal.wire.messages import (
    Clock,
    ColorImage,
    Configuration,
    DepthImage,
    Description,
    JointState,
    OwnSample,
    Pose,
    World,
)
from snakesim_hal.wire.own_sample import own_kinds
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot, Stream

KEPT, IMAGES_KEPT = 64, 2  # arrivals of a key between two looks
MAX_CAMERAS = 16
BODIES_KEPT = 128  # joint states, to find that of the instant of a pose
RATE_PERIOD_S = 1.0
STATUS_LIMIT_S = 2.0  # a host that has been silent for longer is no impostor, only gone

LATCHED = (keys.DESCRIPTION, keys.STATUS, keys.SETTINGS_IN_FORCE, keys.CONFIG)
STREAMS = (
    *(keys.CLOCK, keys.JOINTS, keys.POSE, keys.POWER, keys.IMU, keys.CONTACTS, keys.APPLIED),
    *(keys.WORLD, keys.TRAJECTORY, keys.CONTROL_STATE),
)
IMAGES = (keys.DEPTH_ALL, keys.COLOUR_ALL)


class KeyBuffer:
    """The arrivals of one key."""

    def __init__(self, message: type[Any], kept: int) -> None:
        self.arrivals: deque[Arrival] = deque(maxlen=kept)
        self.count = 0
        self._decoder: Decoder[Any] = Decoder(message)

    def put(self, arrival: Arrival) -> None:
        """Store one; in Zenoh's threads."""
        self.count += 1
        self.arrivals.append(arrival)

    def take(self, rejected: Counter[str]) -> list[Any]:
        """What has arrived since the last call and can be decoded, oldest first."""
        found: list[Any] = []
        while self.arrivals:
            arrival = self.arrivals.popleft()
            try:
                found.append(self._decoder.decode(arrival.payload, arrival.encoding))
            except WireError as error:
                rejected[error.reason] += 1
        return found


class LiveRobot:
    """Everything that one robot publishes, as far as the console shows it."""

    def __init__(self, session: Session) -> None:
        self._buffers: dict[str, KeyBuffer] = {}
        self._newest: dict[str, Any] = {}
        self._bodies: deque[JointState] = deque(maxlen=BODIES_KEPT)
        self._hosts: dict[str, float] = {}
        self._heard_s = time.monotonic()
        self._rates: dict[str, float] = {}
        self._counted: tuple[float, dict[str, int]] = (self._heard_s, {})
        self.rejected = session.rejected
        for key in LATCHED:
            session.on_latched_arrival(key, self._inlet(key, keys.message_at(key), KEPT).put)
        for key in STREAMS:
            session.on_arrival(key, self._inlet(key, keys.message_at(key), KEPT).put)
        for key in (*IMAGES, keys.OWN_ALL):
            session.on_arrival(key, self._take)

    def _inlet(self, key: str, message: Any, kept: int) -> KeyBuffer:
        buffer = self._buffers[key] = KeyBuffer(message, kept)
        return buffer

    def _take(self, arrival: Arrival) -> None:
        """In Zenoh's threads: of a camera, each of which has a key of its own, or a sensor that the robot describes."""
        buffer = self._buffers.get(arrival.key)
        has_room = len(self._buffers) < len(LATCHED) + len(STREAMS) + MAX_CAMERAS
        if buffer is None and has_room and keys.row_key(arrival.key) in IMAGES:
            buffer = self._inlet(arrival.key, keys.message_at(arrival.key), IMAGES_KEPT)
        if buffer is not None:
            buffer.put(arrival)

    @property
    def robot(self) -> Description | None:
        """The newest description."""
        return self._newest.get(keys.DESCRIPTION)

    def snapshot(self) -> RobotSnapshot | None:
        """What is known now; None before the robot has described itself."""
        self._take_in()
        robot = self.robot
        if robot is None:
            return None
        now_s, newest = time.monotonic(), self._newest.get
        clock: Clock | None = newest(keys.CLOCK)
        world: World | None = newest(keys.WORLD)
        body, base = self._body(world)
        return RobotSnapshot(
            robot=robot,
            time_s=None if clock is None else clock.timestamp_ns * 1e-9,
            silent_s=now_s - self._heard_s,
            status=newest(keys.STATUS),
            joints=newest(keys.JOINTS),
            body=body,
            base=base,
            world=world,
            contacts=newest(keys.CONTACTS),
            trajectory=newest(keys.TRAJECTORY),
            control=newest(keys.CONTROL_STATE),
            applied=newest(keys.APPLIED),
            settings=newest(keys.SETTINGS_IN_FORCE),
            configuration=self._configuration(robot),
            power=newest(keys.POWER),
            imu=newest(keys.IMU),
            images={key: found for key, found in self._newest.items() if isinstance(found, DepthImage | ColorImage)},
            own={key: found for key, found in self._newest.items() if isinstance(found, OwnSample)},
            streams=self._streams(clock),
            hosts=frozenset(host for host, at_s in self._hosts.items() if now_s - at_s < STATUS_LIMIT_S),
        )

    def _configuration(self, robot: Description) -> Configuration | None:
        """Of the host that describes itself, whichever of the two came first."""
        configured: Configuration | None = self._newest.get(keys.CONFIG)
        return configured if configured is not None and configured.config_hash == robot.config_hash else None

    def _take_in(self) -> None:
        """Decode what has arrived; what does not fit the robot is counted and dropped."""
        for key, buffer in list(self._buffers.items()):
            for message in buffer.take(self.rejected):
                if key == keys.DESCRIPTION:
                    self._meet(message)
                elif self.robot is not None and (wrong := mismatch(message, self.robot)) is not None:
                    self.rejected[wrong.reason] += 1
                else:
                    self._keep(key, message)
        self._count()

    def _keep(self, key: str, message: Any) -> None:
        if keys.row_key(key) == keys.OWN_ALL and key not in self._buffers:
            return  # of another host's, which described it
        self._newest[key] = message
        if key == keys.STATUS:
            self._heard_s = time.monotonic()
            self._hosts[message.host or ""] = self._heard_s
        elif key == keys.JOINTS:
            self._bodies.append(message)

    def _meet(self, robot: Description) -> None:
        """Another host: nothing of the one before is of this robot's time."""
        if self.robot is not None and self.robot.host != robot.host:
            self._newest = {key: one for key, one in self._newest.items() if key == keys.CONFIG}  # which has a hash
            self._bodies.clear()
            self._hosts.clear()
        if self.robot is None or self.robot.own != robot.own:
            for key in [key for key in self._buffers if keys.row_key(key) == keys.OWN_ALL]:
                del self._buffers[key]
                self._newest.pop(key, None)
            for key, kind in own_kinds(robot).items():
                self._inlet(key, kind.message, KEPT)
        self._newest[keys.DESCRIPTION] = robot

    def _body(self, world: World | None) -> tuple[JointState | None, Any]:
        """The joint state of the instant of the pose, and the pose: by guidance, else by motion capture."""
        pose: Pose | None = self._newest.get(keys.POSE)
        if world is not None:
            of_ns = (
                world.timestamp_ns
                if world.base_position_sd_m is not None
                else world.pose_timestamp_ns or world.timestamp_ns
            )
            base = (world.base_position_w, world.base_orientation_wxyz)
        elif pose is not None:
            of_ns, base = pose.timestamp_ns, (pose.position_w, pose.orientation_wxyz)
        else:
            return (self._bodies[-1] if self._bodies else None), None
        return min(self._bodies, key=lambda joints: abs(joints.timestamp_ns - of_ns), default=None), base

    def _count(self) -> None:
        now_s, (since_s, before) = time.monotonic(), self._counted
        if now_s - since_s < RATE_PERIOD_S:
            return
        counts = {key: buffer.count for key, buffer in list(self._buffers.items())}
        self._rates = {key: (count - before.get(key, 0)) / (now_s - since_s) for key, count in counts.items()}
        self._counted = now_s, counts

    def _streams(self, clock: Clock | None) -> dict[str, Stream]:
        return {
            key: Stream(self._rates.get(key, 0.0), _age_s(self._newest.get(key), clock))
            for key in self._buffers
            if key in self._newest and key not in LATCHED
        }


def _age_s(message: Any, clock: Clock | None) -> float | None:
    timestamp_ns = getattr(message, "timestamp_ns", None)
    return None if clock is None or timestamp_ns is None else (clock.timestamp_ns - timestamp_ns) * 1e-9
