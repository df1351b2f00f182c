"""`snakesim start preview`: small, compressed copies of a robot's images, for viewers behind a slow link.

It runs on the robot's computer and reads the full images there. A distant viewer subscribes to `preview/**` instead of
`sensor/depth/*`: nothing changes for subscribers to the full images. This is a program of its own, because compressing
takes CPU time that must not come from a control tick. An image is read and compressed only while its preview has a
subscriber. So a new viewer gets no old picture: the first one arrives within 1/hz seconds.
"""

import io
import time
from dataclasses import replace
from typing import Any

import numpy as np

from snakesim_hal.base.errors import ConfigError, NotConnectedError
from snakesim_hal.base.terminal import print_line
from snakesim_hal.network.robot_mismatch import find_mismatch
from snakesim_hal.network.session import Session, open_session
from snakesim_hal.network.streams import Publisher, SampleReader
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MAX_IMAGE_BYTES
from snakesim_hal.wire.messages import ColorImage, DepthImage, ImagePreview, RobotDescription
from snakesim_hal.wire.quantities import MAX_PREVIEW_BYTES
from snakesim_operator.base import extras
from snakesim_operator.base.targets import RobotSelection, find_single_robot

MIN_RATE_HZ = 0.01
MAX_RATE_HZ = 10.0
MIN_WIDTH_PX = 16
MAX_WIDTH_PX = 640
JPEG_QUALITY = 70
DESCRIPTION_TIMEOUT_S = 5.0
MAX_QUEUED_IMAGES = 4  # a few invalid images do not displace the valid one


def publish_previews(selection: RobotSelection, rate_hz: float, max_width_px: int) -> int:
    """Publish small pictures of every camera of a robot, for slow networks, until Ctrl-C.

    Args:
        selection: Selects the robot.
        rate_hz: Rate of the previews of each camera.
        max_width_px: Maximum width of a preview in pixels.

    Raises:
        ConfigError: An option is out of range, or the robot has no camera.
        NotConnectedError: No robot is reachable.
    """
    extras.require_extra("console", "`snakesim start preview`")
    if not MIN_RATE_HZ <= rate_hz <= MAX_RATE_HZ:
        raise ConfigError(
            f"--hz {rate_hz:g}: give from {MIN_RATE_HZ:g} to {MAX_RATE_HZ:g} Hz",
            code="command/invalid-option",
        )
    if not MIN_WIDTH_PX <= max_width_px <= MAX_WIDTH_PX:
        raise ConfigError(
            f"--width {max_width_px}: give from {MIN_WIDTH_PX} to {MAX_WIDTH_PX} pixels",
            code="command/invalid-option",
        )
    link = find_single_robot(selection, "start preview")
    with open_session(replace(link, max_bytes=MAX_IMAGE_BYTES)) as session:
        robot = session.wait_for_latched(keys.DESCRIPTION, RobotDescription, DESCRIPTION_TIMEOUT_S)
        if robot is None:
            raise NotConnectedError(
                f"{link.namespace} does not describe itself within {DESCRIPTION_TIMEOUT_S:g} s",
                code="network/no-robot",
            )
        cameras = find_cameras(session, robot, max_width_px)
        if not cameras:
            raise ConfigError(
                f"{link.namespace} has no camera: nothing at {keys.DEPTH_ALL} or {keys.COLOR_ALL}",
                code="network/unknown-key",
            )
        print_line(
            f"{link.namespace}: previews of {', '.join(camera.key for camera in cameras)}; Ctrl-C ends it"
        )
        while True:
            for camera in cameras:
                problem = camera.publish_preview()
                if problem is not None:
                    print_line(problem)
            time.sleep(1.0 / rate_hz)


def find_cameras(
    session: Session, robot: RobotDescription, max_width_px: int
) -> list["CameraPreviewPublisher"]:
    """Return a publisher of previews for each stream of images in the description of the robot.

    Args:
        session: Session on the robot's network.
        robot: Description of the robot.
        max_width_px: Maximum width of a preview in pixels.
    """
    cameras: dict[str, CameraPreviewPublisher] = {}
    for sensor in robot.sensors:
        message = keys.find_message(sensor.key)
        if message in (DepthImage, ColorImage) and sensor.key not in cameras:
            cameras[sensor.key] = CameraPreviewPublisher(
                session, robot, sensor.key, message, max_width_px
            )
    return list(cameras.values())


class CameraPreviewPublisher:
    """Reads the images of one key, and publishes their previews."""

    def __init__(
        self,
        session: Session,
        robot: RobotDescription,
        key: str,
        image_type: type[Any],
        max_width_px: int,
    ) -> None:
        """Declare the publisher of the previews. Images are not read before the previews have a subscriber.

        Args:
            session: Session on the robot's network.
            robot: Description of the robot, which images have to agree with.
            key: Key of the full images.
            image_type: Message type of the images.
            max_width_px: Maximum width of a preview in pixels.
        """
        self.key = key
        self._session = session
        self._robot = robot
        self._image_type = image_type
        self._max_width_px = max_width_px
        self._publisher: Publisher[ImagePreview] = session.declare_publisher(
            keys.preview_key(key), ImagePreview
        )
        self._reader: SampleReader[Any] | None = None

    def publish_preview(self) -> str | None:
        """Publish a preview of the newest image if the previews have a subscriber; else stop reading images.

        Returns:
            The reason why the newest image was left out; None if it was not.
        """
        if not self._publisher.has_subscriber():
            if self._reader is not None:
                self._session.close_reader(self._reader)
                self._reader = None
            return None
        if self._reader is None:
            self._reader = self._session.declare_reader(
                self.key, self._image_type, depth=MAX_QUEUED_IMAGES
            )
        image = self._reader.pop_newest(lambda image: find_mismatch(image, self._robot) is None)
        if image is None:
            return None
        preview = encode_preview(image, self._max_width_px)
        if len(preview.data) > MAX_PREVIEW_BYTES:
            size = len(preview.data)
            return f"{self.key}: the preview has {size} bytes, at most {MAX_PREVIEW_BYTES}; give less --width"
        self._publisher.put(preview)
        return None


def encode_preview(image: DepthImage | ColorImage, max_width_px: int) -> ImagePreview:
    """Return a small, compressed copy of an image: color as JPEG, depth as PNG.

    A color image is averaged. A depth image keeps every n-th pixel unchanged, because the mean of a near and a far
    depth lies on no surface.

    Args:
        image: The full image.
        max_width_px: Maximum width of the copy in pixels.
    """
    import PIL.Image

    stride = -(-image.width // max_width_px)  # rounded up
    buffer = io.BytesIO()
    if isinstance(image, DepthImage):
        depth_counts = np.frombuffer(image.depth, dtype="<u2").reshape(image.height, image.width)
        reduced_image = PIL.Image.fromarray(np.ascontiguousarray(depth_counts[::stride, ::stride]))
        reduced_image.save(buffer, "PNG")
    else:
        full_image = PIL.Image.frombytes("RGB", (image.width, image.height), image.rgb)
        reduced_image = full_image.reduce(stride)
        reduced_image.save(buffer, "JPEG", quality=JPEG_QUALITY)
    return ImagePreview(
        tick=image.tick,
        timestamp_ns=image.timestamp_ns,
        width=reduced_image.width,
        height=reduced_image.height,
        format="png" if isinstance(image, DepthImage) else "jpeg",
        scale_m=image.scale_m if isinstance(image, DepthImage) else None,
        data=buffer.getvalue(),
    )
