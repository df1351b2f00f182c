"""The base's pose from a motion-capture system: one JSON datagram by UDP for every captured frame.

    {"timestamp_ns": 1234567890, "position_w": [x, y, z], "orientation_wxyz": [w, x, y, z]}

The pose is that of the tail end of link 0, in m, in the world of the scene file. `timestamp_ns` is the capture time by
any steady clock of the motion-capture system; `mocap_times` relates it to the driver's clock. `velocity_w` and
`angular_velocity_w` are optional. Otherwise both are derived from two poses and their timestamps, and a pose without a
velocity is dropped.

Any host that reaches the port can send datagrams. At most `MAX_DATAGRAMS_PER_CYCLE` are read in a control cycle.
Unusable ones are counted by reason and dropped.
"""

import logging
import math
import socket
from collections import Counter
from collections.abc import Callable

import msgspec

from snakesim_drivers.motion_capture.mocap_sample import MocapSample
from snakesim_drivers.motion_capture.mocap_times import CaptureTimes
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire import quantities as q
from snakesim_hal.wire.codec import UNDECODABLE
from snakesim_hal.wire.messages import Pose

MAX_DATAGRAM_BYTES = 2048  # of a datagram
# Datagrams a control cycle: six times those of a camera with 1 kHz in 10 ms. Rejecting them takes 0.6 ms at worst.
MAX_DATAGRAMS_PER_CYCLE = 64
# The kernel buffers about as many datagrams, so that the rest of a flood is soon read.
RECEIVE_BUFFER_BYTES = 1 << 15
MAX_NORM_ERROR = 0.05  # of a unit quaternion
MAX_VELOCITY_INTERVAL_NS = 200_000_000  # between two poses that give a velocity
# Of the base; poses that are further apart are of two bodies, or of confused markers.
MAX_SPEED_M_S = 100.0
MAX_DETAIL_CHARACTERS = 200  # of the error of a malformed datagram in the log

_log = logging.getLogger("snakesim.mocap")


def validate_pose_settings(config: RunConfig, pose_listen: str | None) -> None:
    """Check that the robot file has the delay of motion capture if a setting names its address.

    Args:
        config: Configuration of the run, with the robot and the settings of its backend.
        pose_listen: Address HOST:PORT of the setting; None or empty if poses are not received.

    Raises:
        ConfigError: The robot file has no pose sensor.
    """
    if pose_listen and config.robot.sensors.pose is None:
        raise ConfigError(
            f"`{config.backend_section}.pose_listen` = {pose_listen!r} needs a section [sensors.pose] in the file of "
            f"robot {config.robot.name!r}: its `delay_s` is the age of a pose when it arrives, 0 to 1 s, from the "
            f"manual of the motion-capture system",
            code="config/missing-key",
        )


def make_receiver(
    config: RunConfig, pose_listen: str | None, *, are_emulated: bool, clock: Callable[[int], int]
) -> "MocapReceiver | None":
    """Create a receiver of motion capture if the robot has a pose sensor and there is an address.

    Args:
        config: Configuration of the run, with the robot and the settings of its backend.
        pose_listen: HOST:PORT to listen on. If None or empty, emulated motion capture uses any free port, and poses
            from a real system are not received.
        are_emulated: Whether this process emulates the drives, and motion capture with them.
        clock: Function that converts a robot time to the time of the driver's clock, both in ns.

    Returns:
        The open receiver; None if the robot has no pose sensor or there is no address.

    Raises:
        ConfigError: The address cannot be used.
    """
    address = pose_listen or ("127.0.0.1:0" if are_emulated else "")
    pose_sensor = config.robot.sensors.pose
    if pose_sensor is None or not address:
        return None
    return MocapReceiver(
        address, pose_sensor.delay_s, clock, f"{config.backend_section}.pose_listen"
    )


class MocapReceiver:
    """Receives datagrams and returns the newest pose."""

    def __init__(
        self,
        address: str,
        delay_s: float,
        clock: Callable[[int], int],
        setting: str = "pose_listen",
    ) -> None:
        """Listen for datagrams of a motion-capture system on a UDP port.

        Args:
            address: HOST:PORT to listen on.
            delay_s: Minimum duration from the capture of a pose to its arrival.
            clock: Function that converts a robot time to the time of the driver's clock, both in ns.
            setting: Name of the setting with the address, used in error messages.

        Raises:
            ConfigError: The address cannot be used.
        """
        self._socket = _open_socket(address, setting)
        self._to_driver_time_ns = clock
        self._setting = setting
        self._min_latency_ns = round(delay_s * 1e9)
        self._decoder = msgspec.json.Decoder(MocapSample)
        self._capture_times = CaptureTimes()
        self._logged_jump_count = 0  # of the other clock, as far as they were logged
        self._last_sample: MocapSample | None = None
        self._last_timestamp_ns = -1  # of the newest pose that was returned, in robot time
        self.rejected_count_by_reason: Counter[str] = Counter()  # datagrams, by reason

    @property
    def address(self) -> str:
        """Address to send to, as HOST:PORT."""
        host, port = self._socket.getsockname()
        return f"{host}:{port}"

    def read_newest(self, tick: int, timestamp_ns: int) -> Pose | None:
        """Return the newest pose that has arrived since the last call, with the robot time of its capture.

        Args:
            tick: Number of the control cycle, which is stored in the pose.
            timestamp_ns: Current robot time, the time of the control cycle, which starts at 0.

        Returns:
            The pose; None if no valid pose has arrived, its velocity is unknown, or it was captured before
            robot time 0.

        Raises:
            BackendError: The socket has failed.
        """
        # `now_ns` is of the driver's clock, `sample.timestamp_ns` of the clock of the motion-capture system.
        now_ns = self._to_driver_time_ns(timestamp_ns)
        sample = self._find_newest_sample(now_ns)
        if sample is None:
            return None
        # Stored first: a sample without a velocity is the reference for the velocity of the next one.
        previous = self._last_sample
        self._last_sample = sample
        velocities = self._get_or_derive_velocities(previous, sample)
        if velocities is None:
            return None
        age_ns = (
            self._capture_times.compute_lateness_ns(sample.timestamp_ns, now_ns)
            + self._min_latency_ns
        )
        if age_ns > timestamp_ns:  # captured before robot time 0
            return None
        # A late control cycle makes poses that arrived meanwhile seem older. But each pose was captured after the one
        # before, so timestamps must increase.
        self._last_timestamp_ns = max(timestamp_ns - age_ns, self._last_timestamp_ns + 1)
        velocity_w, angular_velocity_w = velocities
        return Pose(
            tick=tick,
            timestamp_ns=self._last_timestamp_ns,
            position_w=sample.position_w,
            orientation_wxyz=sample.orientation_wxyz,
            velocity_w=velocity_w,
            angular_velocity_w=angular_velocity_w,
        )

    def close(self) -> None:
        """Stop listening, and log the rejected datagrams."""
        if self.rejected_count_by_reason:
            counts = ", ".join(
                f"{count} {reason}" for reason, count in self.rejected_count_by_reason.most_common()
            )
            _log.warning(
                "pose: datagrams rejected: %s; its clock jumped %d times",
                counts,
                self._capture_times.jump_count,
            )
        self._socket.close()

    # --- inside -----------------------------------------------------------------------------------------------

    def _find_newest_sample(self, now_ns: int) -> MocapSample | None:
        """Return the newest valid sample of those that have arrived; None if there is none.

        All rejected samples are counted. After a jump of the other clock the last sample is forgotten, because a
        velocity cannot be derived across the jump.
        """
        samples = self._read_samples()
        newest: MocapSample | None = None
        rejections = self._capture_times.check_timestamps(
            [sample.timestamp_ns for sample in samples], now_ns
        )
        for sample, rejection in zip(samples, rejections, strict=True):
            if rejection is None:
                newest = sample
            else:
                self._count_rejection(rejection, f"timestamp_ns = {sample.timestamp_ns}")
        if self._capture_times.jump_count != self._logged_jump_count:
            self._logged_jump_count = self._capture_times.jump_count
            self._last_sample = None
            _log.warning(
                "pose: the clock of the motion-capture system has jumped; its new time is accepted"
            )
        return newest

    def _read_samples(self) -> list[MocapSample]:
        """Return well-formed samples in their order of arrival; read at most `MAX_DATAGRAMS_PER_CYCLE` datagrams."""
        samples: list[MocapSample] = []
        for _ in range(MAX_DATAGRAMS_PER_CYCLE):
            try:
                datagram = self._socket.recv(MAX_DATAGRAM_BYTES)
            except BlockingIOError:
                break
            except OSError as error:
                raise BackendError(
                    f"`{self._setting}`: poses cannot be received: {error}",
                    code="network/port-in-use",
                ) from error
            sample = self._decode(datagram)
            if sample is not None:
                samples.append(sample)
        return samples

    def _decode(self, datagram: bytes) -> MocapSample | None:
        """Return the sample of a datagram; None if it is malformed."""
        try:
            sample = self._decoder.decode(datagram)
        except UNDECODABLE as error:
            self._count_rejection("malformed", str(error)[:MAX_DETAIL_CHARACTERS])
            return None
        norm = math.hypot(*sample.orientation_wxyz)
        if abs(norm - 1.0) > MAX_NORM_ERROR:
            self._count_rejection(
                "malformed",
                f"orientation_wxyz = {sample.orientation_wxyz} is not a unit quaternion",
            )
            return None
        return sample

    def _count_rejection(self, reason: str, detail: str) -> None:
        """Count a rejected datagram. The first of each reason is logged, and `close` logs the totals."""
        self.rejected_count_by_reason[reason] += 1
        if self.rejected_count_by_reason[reason] == 1:
            _log.warning("pose: first %s datagram: %s; more are only counted", reason, detail)

    def _get_or_derive_velocities(
        self, previous: MocapSample | None, sample: MocapSample
    ) -> tuple[q.Vector, q.Vector] | None:
        """Return linear and angular velocity in the world, as sent or as derived from two poses; None if impossible."""
        if sample.velocity_w is not None and sample.angular_velocity_w is not None:
            return sample.velocity_w, sample.angular_velocity_w
        if (
            previous is None
            or sample.timestamp_ns - previous.timestamp_ns > MAX_VELOCITY_INTERVAL_NS
        ):
            return None
        duration_s = (sample.timestamp_ns - previous.timestamp_ns) * 1e-9
        if math.dist(previous.position_w, sample.position_w) > MAX_SPEED_M_S * duration_s:
            self._count_rejection(
                "leap", f"from {previous.position_w} to {sample.position_w} m in {duration_s:.3g} s"
            )
            return None
        velocity_w = sample.velocity_w or _derive_velocity(previous, sample, duration_s)
        angular_velocity_w = sample.angular_velocity_w or _derive_angular_velocity(
            previous, sample, duration_s
        )
        return velocity_w, angular_velocity_w


def _open_socket(address: str, setting: str) -> socket.socket:
    """Return a socket that listens on HOST:PORT. Raises ConfigError."""
    host, _, port = address.rpartition(":")
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        receiver.bind((host or "127.0.0.1", int(port)))
    except (OSError, OverflowError, ValueError) as error:
        receiver.close()
        raise ConfigError(
            f"`{setting}` = {address!r}: {error}; choose another port",
            code="network/invalid-address",
        ) from error
    receiver.setblocking(False)
    return receiver


def _derive_velocity(previous: MocapSample, sample: MocapSample, duration_s: float) -> q.Vector:
    """Return the mean velocity between two poses, in the world."""
    x, y, z = (
        (after - before) / duration_s
        for before, after in zip(previous.position_w, sample.position_w, strict=True)
    )
    return (x, y, z)


def _derive_angular_velocity(
    previous: MocapSample, sample: MocapSample, duration_s: float
) -> q.Vector:
    """Return the mean angular velocity between two poses, for a small rotation.

        angular velocity = 2 / duration * vector part of (orientation * conjugate(previous orientation))

    The sign is that of the shorter rotation, because q and -q are the same orientation.

    Args:
        previous: Sample with the earlier orientation.
        sample: Sample with the later orientation.
        duration_s: Time from the earlier to the later sample.

    Returns:
        Angular velocity in rad/s in the world frame, (x, y, z).
    """
    w1, x1, y1, z1 = previous.orientation_wxyz
    w2, x2, y2, z2 = sample.orientation_wxyz
    quaternion_dot = sum(
        i * j for i, j in zip(previous.orientation_wxyz, sample.orientation_wxyz, strict=True)
    )
    factor = math.copysign(2.0 / duration_s, quaternion_dot)
    return (
        factor * (x2 * w1 - w2 * x1 - y2 * z1 + z2 * y1),
        factor * (y2 * w1 - w2 * y1 - z2 * x1 + x2 * z1),
        factor * (z2 * w1 - w2 * z1 - x2 * y1 + y2 * x1),
    )
