"""The base's pose from a motion-capture system: one JSON datagram by UDP for every captured frame.

    {"timestamp_ns": 1234567890, "position_w": [x, y, z], "orientation_wxyz": [w, x, y, z]}

in m, in the world of the scene file, of the tail end of link 0. `timestamp_ns` is the capture time by any steady
clock of the motion-capture system; `mocap_times` relates it to ours. `velocity_w` and
`angular_velocity_w` are optional; otherwise both are derived from two poses and their stamps, and a pose without a
velocity is dropped.

Any host that reaches the port can send datagrams. At most `MAX_AT_ONCE` are read per tick; unusable ones are counted by
reason and dropped.
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

MAX_BYTES = 2048
# Datagrams a tick: six times those of a camera with 1 kHz in 10 ms, and 0.6 ms at worst to reject them.
MAX_AT_ONCE = 64
RECEIVE_BUFFER_BYTES = 1 << 15  # the kernel buffers about as many: the rest of a flood is soon read
UNIT_WITHIN = 0.05  # of the length of a quaternion
LONGEST_GAP_NS = 200_000_000  # between two poses that give a velocity
MAX_SPEED_M_S = 100.0  # of the base; two poses further apart are of two bodies, or of confused markers

_log = logging.getLogger("snakesim.mocap")


def check_pose(config: RunConfig, pose_listen: str | None) -> None:
    """Raise ConfigError for poses without a stated delay."""
    if pose_listen and config.robot.sensors.pose is None:
        raise ConfigError(
            f"`{config.backend_section}.pose_listen` = {pose_listen!r} needs a section [sensors.pose] in the file of "
            f"robot {config.robot.name!r}: its `delay_s` is the age of a pose when it arrives, 0 to 1 s, from the "
            f"manual of the motion-capture system",
            code="config/missing-key",
        )


def make_receiver(
    config: RunConfig, pose_listen: str | None, *, emulators: bool, clock: Callable[[int], int]
) -> "MocapReceiver | None":
    """A receiver, if the robot has a [sensors.pose] and there is an address; emulators send to any free port."""
    address = pose_listen or ("127.0.0.1:0" if emulators else "")
    camera = config.robot.sensors.pose
    if camera is None or not address:
        return None
    return MocapReceiver(address, camera.delay_s, clock, f"{config.backend_section}.pose_listen")


class MocapReceiver:
    """Receives datagrams and returns the newest pose."""

    def __init__(self, address: str, delay_s: float, clock: Callable[[int], int], setting: str = "pose_listen") -> None:
        """address: HOST:PORT to listen on; delay_s: minimum from capture to arrival. Raises ConfigError.

        clock: the time in ns of the driver's clock, at the tick of a stamp; setting: that named the address.
        """
        host, _, port = address.rpartition(":")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
            self._socket.bind((host or "127.0.0.1", int(port)))
        except (OSError, OverflowError, ValueError) as error:
            self._socket.close()
            raise ConfigError(
                f"`{setting}` = {address!r}: {error}; choose another port", code="network/invalid-address"
            ) from error
        self._socket.setblocking(False)
        self._clock, self._setting = clock, setting
        self._delay_ns = round(delay_s * 1e9)
        self._decoder = msgspec.json.Decoder(MocapSample)
        self._times = CaptureTimes()
        self._jumps = 0  # of the other clock, as far as they are processed here
        self._last: MocapSample | None = None
        self._told_ns = -1  # the newest stamp that was returned
        self.refused: Counter[str] = Counter()  # datagrams, by reason

    @property
    def address(self) -> str:
        """Address to send to, as HOST:PORT."""
        host, port = self._socket.getsockname()
        return f"{host}:{port}"

    def read_newest(self, tick: int, timestamp_ns: int) -> Pose | None:
        """The newest pose since the last call, stamped with the robot time of its capture; None without a valid one."""
        now_ns = self._clock(timestamp_ns)
        sample = self._newest_sample(now_ns)
        if sample is None:
            return None
        before, self._last = self._last, sample
        velocities = self._velocities(before, sample)
        age_ns = self._times.lateness_ns(sample.timestamp_ns, now_ns) + self._delay_ns
        if velocities is None or age_ns > timestamp_ns:  # the latter: captured before the robot's time began
            return None
        # A late tick makes poses that arrived meanwhile seem older; but each was captured after the one before.
        self._told_ns = max(timestamp_ns - age_ns, self._told_ns + 1)
        return Pose(
            tick=tick,
            timestamp_ns=self._told_ns,
            position_w=sample.position_w,
            orientation_wxyz=sample.orientation_wxyz,
            velocity_w=velocities[0],
            angular_velocity_w=velocities[1],
        )

    def close(self) -> None:
        """Stop listening, and log the rejected datagrams."""
        if self.refused:
            counts = ", ".join(f"{count} {why}" for why, count in self.refused.most_common())
            _log.warning("pose: datagrams rejected: %s; its clock jumped %d times", counts, self._times.jumps)
        self._socket.close()

    # --- inside -----------------------------------------------------------------------------------------------

    def _newest_sample(self, now_ns: int) -> MocapSample | None:
        samples = self._read()
        newest: MocapSample | None = None
        refusals = self._times.find_refusals([sample.timestamp_ns for sample in samples], now_ns)
        for sample, refusal in zip(samples, refusals, strict=True):
            if refusal is None:
                newest = sample
            else:
                self._refuse(refusal, f"timestamp_ns = {sample.timestamp_ns}")
        if self._times.jumps != self._jumps:
            self._jumps, self._last = self._times.jumps, None
            _log.warning("pose: the clock of the motion-capture system has jumped; its new time is accepted")
        return newest

    def _read(self) -> list[MocapSample]:
        """Well-formed samples in their order of arrival; reads at most `MAX_AT_ONCE` datagrams."""
        samples: list[MocapSample] = []
        for _ in range(MAX_AT_ONCE):
            try:
                datagram = self._socket.recv(MAX_BYTES)
            except BlockingIOError:
                break
            except OSError as error:
                raise BackendError(
                    f"`{self._setting}`: poses cannot be received: {error}", code="network/port-in-use"
                ) from error
            try:
                sample = self._decoder.decode(datagram)
            except UNDECODABLE as error:
                self._refuse("malformed", str(error)[:200])
                continue
            if abs(math.hypot(*sample.orientation_wxyz) - 1.0) > UNIT_WITHIN:
                self._refuse("malformed", f"orientation_wxyz = {sample.orientation_wxyz} is not a unit quaternion")
            else:
                samples.append(sample)
        return samples

    def _refuse(self, why: str, detail: str) -> None:
        """Count it; the first of each reason is logged, and `close` logs the totals."""
        self.refused[why] += 1
        if self.refused[why] == 1:
            _log.warning("pose: first %s datagram: %s; more are only counted", why, detail)

    def _velocities(self, before: MocapSample | None, now: MocapSample) -> tuple[q.Vector, q.Vector] | None:
        """Linear and angular, in the world; None if they are neither sent nor derived from two poses."""
        if now.velocity_w is not None and now.angular_velocity_w is not None:
            return now.velocity_w, now.angular_velocity_w
        if before is None or now.timestamp_ns - before.timestamp_ns > LONGEST_GAP_NS:
            return None
        seconds = (now.timestamp_ns - before.timestamp_ns) * 1e-9
        if math.dist(before.position_w, now.position_w) > MAX_SPEED_M_S * seconds:
            self._refuse("leap", f"from {before.position_w} to {now.position_w} m in {seconds:.3g} s")
            return None
        return (
            now.velocity_w or _velocity(before, now, seconds),
            now.angular_velocity_w or _turning(before, now, seconds),
        )


def _velocity(before: MocapSample, now: MocapSample, seconds: float) -> q.Vector:
    x, y, z = ((b - a) / seconds for a, b in zip(before.position_w, now.position_w, strict=True))
    return (x, y, z)


def _turning(before: MocapSample, now: MocapSample, seconds: float) -> q.Vector:
    """Angular velocity in the world, from the turn between two orientations, which is small."""
    a, b = before.orientation_wxyz, now.orientation_wxyz
    sign = math.copysign(2.0 / seconds, sum(i * j for i, j in zip(a, b, strict=True)))
    w, x, y, z = a
    bw, bx, by, bz = b  # vector part of now * conjugate(before)
    return (
        sign * (bx * w - bw * x - by * z + bz * y),
        sign * (by * w - bw * y - bz * x + bx * z),
        sign * (bz * w - bw * z - bx * y + by * x),
    )
