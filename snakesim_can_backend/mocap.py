"""The base's pose from a motion-capture system: one JSON datagram by UDP for every frame that it captures.

    {"position_w": [x, y, z], "orientation_wxyz": [w, x, y, z]}

in m, in the world of the scene file, of the tail end of link 0. `velocity_w` and `angular_velocity_w` may follow; what
is left out is taken from the last two poses. What is malformed is counted and left out.
"""

import math
import socket
import time

import msgspec

from snakesim_hal import quantities as q
from snakesim_hal.errors import ConfigError
from snakesim_hal.messages import Pose

MOST_BYTES = 2048
UNIT_WITHIN = 0.05  # of the length of a quaternion
LEAST_S = 1e-3  # two datagrams that come together were not captured together


class MocapSample(msgspec.Struct, frozen=True, kw_only=True):
    """One datagram: the base (tail end of link 0) in the world. The receiver stamps it."""

    position_w: q.Vector
    orientation_wxyz: q.Quaternion
    velocity_w: q.VelocityVector | None = None
    angular_velocity_w: q.AngularVelocityVector | None = None


class MocapReceiver:
    """Listens for datagrams and keeps the newest."""

    def __init__(self, address: str) -> None:
        """address: HOST:PORT to listen on. Raises ConfigError."""
        host, _, port = address.rpartition(":")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host or "127.0.0.1", int(port)))
        except (OSError, OverflowError) as error:
            self._socket.close()
            raise ConfigError(f"`backends.can.pose_listen` = {address!r}: {error}; choose another port") from error
        self._socket.setblocking(False)
        self._decoder = msgspec.json.Decoder(MocapSample)
        self._last: tuple[MocapSample, float] | None = None
        self.malformed = 0

    @property
    def address(self) -> str:
        """Where to send to, as HOST:PORT."""
        host, port = self._socket.getsockname()
        return f"{host}:{port}"

    def newest(self, tick: int, stamp_ns: int) -> Pose | None:
        """The newest pose since the last call; None when nothing came."""
        sample: MocapSample | None = None
        while True:
            try:
                datagram = self._socket.recv(MOST_BYTES)
            except BlockingIOError:
                break
            try:
                told = self._decoder.decode(datagram)
            except msgspec.DecodeError:
                self.malformed += 1
                continue
            if abs(math.hypot(*told.orientation_wxyz) - 1.0) > UNIT_WITHIN:
                self.malformed += 1
            else:
                sample = told
        if sample is None:
            return None
        now = time.monotonic()
        (before, then), self._last = self._last or (sample, now), (sample, now)
        seconds = max(now - then, LEAST_S)
        return Pose(
            tick=tick,
            stamp_ns=stamp_ns,
            position_w=sample.position_w,
            orientation_wxyz=sample.orientation_wxyz,
            velocity_w=sample.velocity_w or _velocity(before, sample, seconds),
            angular_velocity_w=sample.angular_velocity_w or _turning(before, sample, seconds),
        )

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()


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
