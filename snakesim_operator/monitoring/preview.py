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
from snakesim_hal.network.streams import Publisher, Reader
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MAX_IMAGE_BYTES
from snakesim_hal.wire.messages import ColorImage, DepthImage, Description, Preview
from snakesim_hal.wire.quantities import MAX_PREVIEW_BYTES
from snakesim_operator.base import extras
from snakesim_operator.base.targets import RobotSelection, only_robot

MIN_HZ = 0.01
MAX_HZ = 10.0
MIN_WIDTH_PX = 16
MAX_WIDTH_PX = 640
JPEG_QUALITY = 70
DESCRIPTION_TIMEOUT_S = 5.0
QUEUED_IMAGES = 4  # a few invalid images do not displace the valid one


def preview(where: RobotSelection, hz: float, width: int) -> int:
    """Publish small pictures of every camera of a robot, for slow networks, until Ctrl-C.

    Args:
        where: selects the robot.
        hz: rate of the previews.
        width: maximum width in pixels.

    Raises:
        ConfigError: an option is out of range, or the robot has no camera.
        NotConnectedError: no robot is reachable.
    """
    extras.require("console", "`snakesim start preview`")
    if not MIN_HZ <= hz <= MAX_HZ:
        raise ConfigError(f"--hz {hz:g}: give from {MIN_HZ:g} to {MAX_HZ:g} Hz", code="command/invalid-option")
    if not MIN_WIDTH_PX <= width <= MAX_WIDTH_PX:
        raise ConfigError(
            f"--width {width}: give from {MIN_WIDTH_PX} to {MAX_WIDTH_PX} pixels", code="command/invalid-option"
        )
    link = only_robot(where, "start preview")
    with open_session(replace(link, max_bytes=MAX_IMAGE_BYTES)) as session:
        robot = session.latest(keys.DESCRIPTION, Description, DESCRIPTION_TIMEOUT_S)
        if robot is None:
            raise NotConnectedError(
                f"{link.namespace} does not describe itself within {DESCRIPTION_TIMEOUT_S:g} s", code="network/no-robot"
            )
        cameras = cameras_of(session, robot, width)
        if not cameras:
            raise ConfigError(
                f"{link.namespace} has no camera: nothing at {keys.DEPTH_ALL} or {keys.COLOR_ALL}",
                code="network/unknown-key",
            )
        print_line(f"{link.namespace}: previews of {', '.join(camera.key for camera in cameras)}; Ctrl-C ends it")
        while True:
            for camera in cameras:
                problem = camera.publish_preview()
                if problem is not None:
                    print_line(problem)
            time.sleep(1.0 / hz)


def cameras_of(session: Session, robot: Description, width: int) -> list["Camera"]:
    """Return a camera for each stream of images that the robot publishes."""
    cameras: dict[str, Camera] = {}
    for sensor in robot.sensors:
        message = keys.find_message(sensor.key)
        if message in (DepthImage, ColorImage) and sensor.key not in cameras:
            cameras[sensor.key] = Camera(session, robot, sensor.key, message, width)
    return list(cameras.values())


class Camera:
    """Reads the images of one key, and publishes their previews."""

    def __init__(self, session: Session, robot: Description, key: str, kind: type[Any], width: int) -> None:
        """Publish previews, not read images yet. kind: the message of the images; width: the maximum in pixels."""
        self.key = key
        self._session = session
        self._robot = robot
        self._kind = kind
        self._width = width
        self._publisher: Publisher[Preview] = session.publisher(keys.preview_key(key), Preview)
        self._reader: Reader[Any] | None = None

    def publish_preview(self) -> str | None:
        """Publish a preview of the newest image, if there is a subscriber.

        Returns:
            Why the image was left out, or None.
        """
        if not self._publisher.has_subscriber():
            if self._reader is not None:
                self._session.stop_reading(self._reader)
                self._reader = None
            return None
        if self._reader is None:
            self._reader = self._session.reader(self.key, self._kind, depth=QUEUED_IMAGES)
        image = self._reader.newest(lambda image: find_mismatch(image, self._robot) is None)
        if image is None:
            return None
        preview = preview_of(image, self._width)
        if len(preview.data) > MAX_PREVIEW_BYTES:
            size = len(preview.data)
            return f"{self.key}: the preview has {size} bytes, at most {MAX_PREVIEW_BYTES}; give less --width"
        self._publisher.put(preview)
        return None


def preview_of(image: DepthImage | ColorImage, width: int) -> Preview:
    """Return a compressed copy of an image: color as JPEG, depth as PNG.

    A depth image keeps every n-th pixel unchanged, because the mean of a near and a far point is neither.

    Args:
        image: the image.
        width: maximum width of the copy in pixels.
    """
    import PIL.Image

    step = -(-image.width // width)  # rounded up
    file = io.BytesIO()
    if isinstance(image, DepthImage):
        counts = np.frombuffer(image.depth, dtype="<u2").reshape(image.height, image.width)
        reduced_image = PIL.Image.fromarray(np.ascontiguousarray(counts[::step, ::step]))
        reduced_image.save(file, "PNG")
    else:
        full_image = PIL.Image.frombytes("RGB", (image.width, image.height), image.rgb)
        reduced_image = full_image.reduce(step)
        reduced_image.save(file, "JPEG", quality=JPEG_QUALITY)
    return Preview(
        tick=image.tick,
        timestamp_ns=image.timestamp_ns,
        width=reduced_image.width,
        height=reduced_image.height,
        format="png" if isinstance(image, DepthImage) else "jpeg",
        scale_m=image.scale_m if isinstance(image, DepthImage) else None,
        data=file.getvalue(),
    )
