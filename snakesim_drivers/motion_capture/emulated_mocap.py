"""An emulated motion-capture system: it measures the pose of a physics model, and sends it as `mocap` receives it."""

import contextlib
import socket
from collections import deque
from collections.abc import Sequence

import numpy as np

from snakesim_drivers.motion_capture.mocap_sample import MocapSample
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.robot_file.sensors import PoseSensor
from snakesim_hal.physics.physics_model import PhysicsModel
from snakesim_hal.wire.quantities import Quaternion


class PoseSender:
    """Sends datagrams and ignores errors: motion capture does not know whether it has receivers."""

    def __init__(self, address: str) -> None:
        """Open a socket.

        Args:
            address: HOST:PORT to send to.

        Raises:
            ConfigError: The address is malformed.
        """
        host, _, port = address.rpartition(":")
        if not host or not port.isdigit() or not 0 < int(port) < 65536:
            raise ConfigError(
                f"pose address {address!r}: give HOST:PORT, such as 127.0.0.1:7450",
                code="network/invalid-address",
            )
        self._address = (host, int(port))
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def __call__(self, datagram: bytes) -> None:
        """Send a datagram."""
        with contextlib.suppress(OSError):
            self._socket.sendto(datagram, self._address)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class PoseCamera:
    """Captures the pose of the base once in every control period, with the noise and delay of the robot file.

    The measured orientation is the true one times a small random rotation about axes of the base:

        measured = true * (1, a, b, c) / norm,   a, b, c: normal, with half of the standard deviation of the angle
    """

    def __init__(
        self, sensor: PoseSensor, physics_model: PhysicsModel, seed: Sequence[int], period_ns: int
    ) -> None:
        """Create a camera that has not captured any pose yet.

        Args:
            sensor: Pose sensor of the robot file, with its noise and delay.
            physics_model: Physics model whose base pose is measured.
            seed: Entropy for `numpy.random.default_rng`, from which the noise is drawn.
            period_ns: Time from one capture to the next.
        """
        self._physics_model = physics_model
        delay_periods = round(sensor.delay_s * 1e9 / period_ns)
        self._captured_samples: deque[MocapSample] = deque(maxlen=1 + delay_periods)
        self._draw_normal = np.random.default_rng(seed).standard_normal
        # A quaternion has half the angle.
        noise_sigma = [sensor.position_noise_m, 0.5 * sensor.angle_noise_rad]
        self._noise_sigma = np.repeat(noise_sigma, 3)

    def capture(self, timestamp_ns: int) -> MocapSample | None:
        """Capture the pose of the base, with noise, and return the delayed capture that arrives now.

        Velocities have no noise.

        Args:
            timestamp_ns: Current time of the motion-capture system.

        Returns:
            The capture that was made one delay ago; None until the first one arrives, or if the physics model has no
            world.
        """
        pose = self._physics_model.pose()
        if pose is None:
            return None
        # Position errors, then the vector part (a, b, c) of the small random rotation.
        error_x, error_y, error_z, a, b, c = (self._noise_sigma * self._draw_normal(6)).tolist()
        x, y, z = pose.position_w
        sample = MocapSample(
            timestamp_ns=timestamp_ns,
            position_w=(x + error_x, y + error_y, z + error_z),
            orientation_wxyz=_rotate_slightly(pose.orientation_wxyz, a, b, c),
            velocity_w=pose.velocity_w,
            angular_velocity_w=pose.angular_velocity_w,
        )
        self._captured_samples.append(sample)
        if len(self._captured_samples) < (
            self._captured_samples.maxlen or 0
        ):  # the delay has not passed yet
            return None
        return self._captured_samples[0]


def _rotate_slightly(wxyz: Quaternion, a: float, b: float, c: float) -> Quaternion:
    """Return the unit quaternion along wxyz * (1, a, b, c)."""
    w, x, y, z = wxyz
    product = np.array(
        (
            w - a * x - b * y - c * z,
            x + a * w + b * z - c * y,
            y + b * w + c * x - a * z,
            z + c * w + a * y - b * x,
        )
    )
    w, x, y, z = (product / np.linalg.norm(product)).tolist()
    return (w, x, y, z)
