"""The sensors in a robot file. docs/how-to/sensors.md describes what they publish, and how they are simulated.

All noise is a standard deviation. A delay is the time from the measurement to the arrival at the host.
"""

import math
from collections.abc import Iterator
from typing import Annotated, Any, Literal

from msgspec import Meta

from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.robot_file.links import Offset
from snakesim_hal.wire import keys
from snakesim_hal.wire.quantities import (
    MAX_BEAMS,
    MAX_CUSTOM_SENSORS,
    MAX_IMAGE_HEIGHT,
    MAX_IMAGE_WIDTH,
    MAX_JOINTS,
    above,
    bounded,
    from_zero,
)

MAX_MOUNTED = 8  # cameras, and also range sensors: a description has room for 48 keys
COLOR_PIXEL_BYTES = 3  # RGB
DEPTH_PIXEL_BYTES = 2

Angle = Annotated[float, bounded(-math.pi, math.pi, "rad")]
Model = Annotated[str, Meta(min_length=1, max_length=500)]
LinkName = Literal["head", "tail"] | Annotated[int, Meta(ge=0, le=MAX_JOINTS)]


class JointSensor(FileStruct, frozen=True, kw_only=True):
    """Angle, velocity and torque of every joint. No rate: a sample every tick."""

    delay_s: Annotated[float, from_zero(1, "s")] = 0.0
    """Time from the measurement to its arrival at the host."""

    angle_noise_rad: Annotated[float, from_zero(1, "rad")] = 0.0
    """Standard deviation of the noise of every angle."""

    velocity_noise_rad_s: Annotated[float, from_zero(10, "rad/s")] = 0.0
    """Standard deviation of the noise of every angular velocity."""

    torque_noise_nm: Annotated[float, from_zero(100, "N·m")] = 0.0
    """Standard deviation of the noise of every torque."""


class _SampledSensor(FileStruct, frozen=True, kw_only=True):
    rate_hz: Annotated[float, above(1e4, "Hz")] = 100.0
    """Number of samples per second. At most the rate of the control cycle."""

    delay_s: Annotated[float, from_zero(1, "s")] = 0.0
    """Time from the measurement to its arrival at the host."""


class ContactSensor(_SampledSensor, frozen=True, kw_only=True):
    """Contacts of the links with obstacles."""

    position_noise_m: Annotated[float, from_zero(1, "m")] = 0.0
    """Standard deviation of the noise of each coordinate of a contact."""

    force_noise_n: Annotated[float, from_zero(100, "N")] = 0.0
    """Standard deviation of the noise of each component of a contact force."""

    threshold_n: Annotated[float, from_zero(100, "N")] = 0.0
    """Force below which a contact is not detected."""


class ImuSensor(_SampledSensor, frozen=True, kw_only=True):
    """Angular velocity and acceleration (gravity included) of every link."""

    angular_velocity_noise_rad_s: Annotated[float, from_zero(10, "rad/s")] = 0.0
    """Standard deviation of the noise of each component of the angular velocity."""

    acceleration_noise_m_s2: Annotated[float, from_zero(100, "m/s²")] = 0.0
    """Standard deviation of the noise of each component of the acceleration."""


class PoseSensor(_SampledSensor, frozen=True, kw_only=True):
    """Pose of the base, from motion capture."""

    position_noise_m: Annotated[float, from_zero(1, "m")] = 0.0
    """Standard deviation of the noise of each coordinate of the base."""

    angle_noise_rad: Annotated[float, from_zero(1, "rad")] = 0.0
    """Standard deviation of the noise of the orientation, about each axis."""


class PowerSensor(FileStruct, frozen=True, kw_only=True):
    """Supply, temperatures and leaks of every joint module. Modules on a bus report them at their own rate."""

    rate_hz: Annotated[float, above(1e4, "Hz")] = 2.0
    """Number of samples per second. Modules on a bus report at a rate that their firmware sets."""

    delay_s: Annotated[float, from_zero(1, "s")] = 0.0
    """Time from the measurement to its arrival at the host."""


class MountedSensor(FileStruct, frozen=True, kw_only=True):
    """A sensor at a position on a link; its name distinguishes it from others of the same kind.

    What it measures arrives after `delay_s`, but not earlier than one control period later.
    """

    name: Annotated[str, Meta(min_length=1, max_length=40, pattern="^[A-Za-z0-9_-]+$")]
    """Name of the sensor, which ends its key. It differs from those of all sensors of the same kind."""

    link: LinkName = "head"
    """Link that carries the sensor: `head`, `tail`, or the number of a link from 0 at the tail."""

    position_m: tuple[Offset, Offset, Offset] | None = None
    """Position of the sensor in the link's frame. None: the tip of the head."""

    yaw_rad: Angle = 0.0
    """Rotation of the viewing direction, the link's x axis, about z. Positive: to the left."""

    pitch_rad: Angle = 0.0
    """Rotation of the viewing direction about y, after the yaw. Positive: downwards."""

    # Time.
    rate_hz: Annotated[float, above(1000, "Hz")] = 20.0
    """Number of samples per second. At most the rate of the control cycle."""

    delay_s: Annotated[float, from_zero(1, "s")] = 0.03
    """Time from the measurement to its arrival at the host. At least one control period."""

    settings: dict[str, Any] = {}
    """Settings of the sensor's model, which checks them."""


class DistanceSensor(MountedSensor, frozen=True, kw_only=True):
    """A sensor that measures distances from its position."""

    noise_m: Annotated[float, from_zero(1, "m")] = 0.0
    """Standard deviation of the noise of every distance."""

    dropout: Annotated[float, Meta(ge=0, le=1, extra_json_schema={"unit": "1"})] = 0.0
    """Fraction of the pixels or beams that measure nothing."""

    model: Model = "rays"
    """Model by which the simulator makes samples: `rays`, another installed model, or ./file.py:Class."""


class DepthCamera(DistanceSensor, frozen=True, kw_only=True):
    """Distances along the optical axis, in an image of square pixels without distortion."""

    # Image.
    width: Annotated[int, Meta(ge=1, le=MAX_IMAGE_WIDTH)] = 160
    """Width of the image in pixels."""

    height: Annotated[int, Meta(ge=1, le=MAX_IMAGE_HEIGHT)] = 120
    """Height of the image in pixels."""

    fov_rad: Annotated[float, above(3, "rad")] = 1.5708
    """Horizontal field of view, from the left edge of the image to its right edge."""

    # Distances.
    range_min_m: Annotated[float, from_zero(60, "m")] = 0.1
    """Shortest distance that is measured."""

    range_max_m: Annotated[float, above(60, "m")] = 5.0
    """Longest distance that is measured."""

    noise_m_per_m2: Annotated[float, from_zero(1, "m/m²")] = 0.0
    """Additional noise for each square meter of squared distance, as a standard deviation."""

    color: bool = False
    """True: the camera also publishes a color image, which the simulator renders with OpenGL."""

    def __post_init__(self) -> None:
        """Check the range. Raises ValueError, which the file reader explains."""
        _check_range(self.range_min_m, self.range_max_m)

    @property
    def focal_px(self) -> float:
        """Return the focal length of both axes, in pixels."""
        return self.width / 2 / math.tan(self.fov_rad / 2)


class RangeSensor(DistanceSensor, frozen=True, kw_only=True):
    """Distances along beams in a plane: a 2-D lidar, or with one beam a range finder."""

    beams: Annotated[int, Meta(ge=1, le=MAX_BEAMS)] = 1
    """Number of beams, evenly distributed over the field of view."""

    fov_rad: Annotated[float, from_zero(6.2832, "rad")] = 0.0
    """Field of view, from the first beam on the right to the last beam. 0 for a single beam."""

    range_min_m: Annotated[float, from_zero(1000, "m")] = 0.02
    """Shortest distance that is measured."""

    range_max_m: Annotated[float, above(1000, "m")] = 5.0
    """Longest distance that is measured."""

    def __post_init__(self) -> None:
        """Check range and beams. Raises ValueError, which the file reader explains."""
        _check_range(self.range_min_m, self.range_max_m)
        if (self.beams > 1) != (self.fov_rad > 0):
            raise ValueError(
                f"{self.beams} beams over {self.fov_rad:g} rad: one beam has `fov_rad` = 0, several have more"
            )


class CustomSensor(MountedSensor, frozen=True, kw_only=True):
    """A custom sensor: the class in `model` defines its message, see docs/how-to/sensors.md."""

    model: Model
    """Class that defines the sensor and its message: the name of an installed sensor, or ./file.py:Class."""


def _check_range(min_m: float, max_m: float) -> None:
    """Raise ValueError if the range of a sensor is empty."""
    if min_m >= max_m:
        raise ValueError(f"`range_min_m` = {min_m:g} m must be below `range_max_m` = {max_m:g} m")


AnyMounted = DepthCamera | RangeSensor | CustomSensor
BodySensor = ContactSensor | ImuSensor | PoseSensor | PowerSensor
AnySensor = BodySensor | AnyMounted


class SensorSections(FileStruct, frozen=True, kw_only=True):
    """The sensors of the robot. Without its section a sensor is absent."""

    joints: JointSensor = JointSensor()
    """Angle, velocity and torque of every joint, in every control cycle."""

    contacts: ContactSensor | None = None
    """Contacts of the links with obstacles. None: they are not measured."""

    imu: ImuSensor | None = None
    """Angular velocity and acceleration of every link. None: they are not measured."""

    pose: PoseSensor | None = None
    """Pose of the base from motion capture. None: it is not measured."""

    power: PowerSensor | None = None
    """Supply, temperatures and leaks of the joint modules. None: they are not measured."""

    depth: Annotated[list[DepthCamera], Meta(max_length=MAX_MOUNTED)] = []
    """Depth cameras, each an entry `[[sensors.depth]]`."""

    range: Annotated[list[RangeSensor], Meta(max_length=MAX_MOUNTED)] = []
    """Range sensors, each an entry `[[sensors.range]]`."""

    custom: Annotated[list[CustomSensor], Meta(max_length=MAX_CUSTOM_SENSORS)] = []
    """Custom sensors, each an entry `[[sensors.custom]]`."""

    def __post_init__(self) -> None:
        """Check that no two sensors of a kind have the same name. Raises ValueError, which the file reader explains."""
        for kind, sensors in (
            ("depth", self.depth),
            ("range", self.range),
            ("custom", self.custom),
        ):
            names = [sensor.name for sensor in sensors]
            for name in names:
                if names.count(name) > 1:
                    raise ValueError(
                        f"two entries of [[sensors.{kind}]] have the name {name!r}; give each its own"
                    )

    def iterate_published(self) -> Iterator[tuple[str, AnySensor]]:
        """Yield every sensor except for the joint sensor, with the key under which its samples are published."""
        if self.contacts is not None:
            yield keys.CONTACTS, self.contacts
        if self.imu is not None:
            yield keys.IMU, self.imu
        if self.pose is not None:
            yield keys.POSE, self.pose
        if self.power is not None:
            yield keys.POWER, self.power
        yield from self.iterate_mounted()

    def iterate_mounted(self) -> Iterator[tuple[str, AnyMounted]]:
        """Yield the sensors at positions on links, with their keys. A color camera has two keys, so it comes twice."""
        for camera in self.depth:
            yield keys.depth_key(camera.name), camera
            if camera.color:
                yield keys.color_key(camera.name), camera
        for sensor in self.range:
            yield keys.ranges_key(sensor.name), sensor
        for sensor in self.custom:
            yield keys.custom_key(sensor.name), sensor

    @property
    def max_image_bytes(self) -> int:
        """Return the size of the pixels of the largest image; 0 without cameras."""
        max_bytes = 0
        for camera in self.depth:
            bytes_per_pixel = COLOR_PIXEL_BYTES if camera.color else DEPTH_PIXEL_BYTES
            max_bytes = max(max_bytes, camera.width * camera.height * bytes_per_pixel)
        return max_bytes
