"""An emulated motion-capture system: it looks at a physics model, and sends what it saw as `mocap` receives it."""

import contextlib
import socket
from collections import deque
from collections.abc import Sequence

import numpy as np

from snakesim_drivers.motion_capture.mocap_sample import MocapSample
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.sensors import PoseSensor
from snakesim_hal.physics.physics_model import PhysicsModel


class PoseSender:
    """Sends datagrams and ignores errors: motion capture does not know whether it has receivers."""

    def __init__(self, address: str) -> None:
        """address: HOST:PORT. Raises ConfigError."""
        host, _, port = address.rpartition(":")
        if not host or not port.isdigit() or not 0 < int(port) < 65536:
            raise ConfigError(
                f"pose address {address!r}: give HOST:PORT, such as 127.0.0.1:7450", code="network/invalid-address"
            )
        self._address = (host, int(port))
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def __call__(self, datagram: bytes) -> None:
        """Send one."""
        with contextlib.suppress(OSError):
            self._socket.sendto(datagram, self._address)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class PoseCamera:
    """Motion capture of the base, at every Sync, with the delay of the robot file."""

    def __init__(self, sensor: PoseSensor, physics_model: PhysicsModel, seed: Sequence[int], period_ns: int) -> None:
        self._physics_model = physics_model
        self._under_way: deque[MocapSample] = deque(maxlen=1 + round(sensor.delay_s * 1e9 / period_ns))
        self._noise = np.random.default_rng(seed).standard_normal
        self._sigma = np.repeat([sensor.position_noise_m, 0.5 * sensor.angle_noise_rad], 3)  # quaternions halve angles

    def capture(self, timestamp_ns: int) -> MocapSample | None:
        """The sample that arrives at this Sync: the base's pose before the delay; None at first, or without a world.

        Velocities carry no noise of their own.
        """
        pose = self._physics_model.pose()
        if pose is None:
            return None
        ex, ey, ez, a, b, c = (self._sigma * self._noise(6)).tolist()
        px, py, pz = pose.position_w
        w, x, y, z = pose.orientation_wxyz
        turned = np.array(
            (
                w - a * x - b * y - c * z,
                x + a * w + b * z - c * y,
                y + b * w + c * x - a * z,
                z + c * w + a * y - b * x,
            )
        )
        w, x, y, z = (turned / np.linalg.norm(turned)).tolist()
        sample = MocapSample(
            timestamp_ns=timestamp_ns,
            position_w=(px + ex, py + ey, pz + ez),
            orientation_wxyz=(w, x, y, z),
            velocity_w=pose.velocity_w,
            angular_velocity_w=pose.angular_velocity_w,
        )
        self._under_way.append(sample)
        return self._under_way[0] if len(self._under_way) == self._under_way.maxlen else None
