"""`snakesim preview`: small, compressed copies of a robot's images, for viewers behind a slow link.

It runs on the robot's machine, beside the host, and reads the full images there. A viewer far away subscribes to
`preview/**` instead of `sensor/depth/*`: nothing changes for those who read the full images. A program, and no part of
the host, because compressing takes CPU time that must not come from a control tick. An image is fetched and compressed
only while somebody looks at its preview, so there is no old picture for later viewers: the first one comes within
1/hz seconds.
"""

import io
import time
from dataclasses import replace
from typing import Any

import numpy as np

from snakesim_hal.base.errors import ConfigError, NotConnectedError
from snakesim_hal.base.terminal import say
from snakesim_hal.network.robot_mismatch import mismatch
from snakesim_hal.network.session import Publisher, Reader, Session, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MAX_IMAGE_BYTES
from snakesim_hal.wire.messages import ColorImage, DepthImage, Description, Preview
from snakesim_hal.wire.quantities import MAX_PREVIEW_BYTES
from snakesim_operator.base import extras
from snakesim_operator.base.targets import RobotSelection, only_robot

MAX_HZ = 10.0
WIDEST, NARROWEST = 640, 16  # pixels
JPEG_QUALITY = 70
DESCRIBED_S = 5.0
KEPT = 4  # images: a few of noise do not displace the valid one


def preview(where: RobotSelection, hz: float, width: int) -> int:
    """Publish previews of every camera of the addressed robot until Ctrl-C. Raises ConfigError, NotConnectedError."""
    extras.check("preview", "`snakesim preview`")
    if not 0.01 <= hz <= MAX_HZ:
        raise ConfigError(f"--hz {hz:g}: give from 0.01 to {MAX_HZ:g} Hz")
    if not NARROWEST <= width <= WIDEST:
        raise ConfigError(f"--width {width}: give from {NARROWEST} to {WIDEST} pixels")
    link = only_robot(where, "preview")
    with open_session(replace(link, max_bytes=MAX_IMAGE_BYTES)) as session:
        robot = session.latest(keys.DESCRIPTION, Description, DESCRIBED_S)
        if robot is None:
            raise NotConnectedError(f"{link.namespace} does not describe itself within {DESCRIBED_S:g} s")
        cameras = cameras_of(session, robot, width)
        if not cameras:
            raise ConfigError(f"{link.namespace} has no camera: nothing at {keys.DEPTH_ALL} or {keys.COLOUR_ALL}")
        say(f"{link.namespace}: previews of {', '.join(camera.key for camera in cameras)}; Ctrl-C ends it")
        while True:
            for camera in cameras:
                if (why := camera.turn()) is not None:
                    say(why)
            time.sleep(1.0 / hz)


def cameras_of(session: Session, robot: Description, width: int) -> list["Camera"]:
    """One for each stream of images."""
    kinds = {sensor.key: keys.message_at(sensor.key) for sensor in robot.sensors}
    return [Camera(session, robot, key, kind, width) for key, kind in kinds.items() if kind in (DepthImage, ColorImage)]


class Camera:
    """The images of one key, and their previews."""

    def __init__(self, session: Session, robot: Description, key: str, kind: type[Any], width: int) -> None:
        self._session, self._robot, self._kind, self._width = session, robot, kind, width
        self.key = key
        self._publisher: Publisher[Preview] = session.publisher(keys.preview(key), Preview)
        self._reader: Reader[Any] | None = None

    def turn(self) -> str | None:
        """Publish a preview of the newest image, if anybody looks at it. Returns why it was left out."""
        if not self._publisher.heard():
            if self._reader is not None:
                self._session.stop_reading(self._reader)
                self._reader = None
            return None
        if self._reader is None:
            self._reader = self._session.reader(self.key, self._kind, depth=KEPT)
        image = self._reader.newest(lambda image: mismatch(image, self._robot) is None)
        if image is None:
            return None
        made = preview_of(image, self._width)
        if len(made.data) > MAX_PREVIEW_BYTES:
            return f"{self.key}: the preview has {len(made.data)} bytes, at most {MAX_PREVIEW_BYTES}; give less --width"
        self._publisher.put(made)
        return None


def preview_of(image: DepthImage | ColorImage, width: int) -> Preview:
    """A copy of at most this width. Depth: every n-th pixel as it is, since a mean of near and far is neither."""
    import PIL.Image

    step = -(-image.width // width)
    file = io.BytesIO()
    if isinstance(image, DepthImage):
        counts = np.frombuffer(image.depth, dtype="<u2").reshape(image.height, image.width)[::step, ::step]
        small = PIL.Image.fromarray(np.ascontiguousarray(counts))
        small.save(file, "PNG")
    else:
        small = PIL.Image.frombytes("RGB", (image.width, image.height), image.rgb)
        small = small.reduce(step)
        small.save(file, "JPEG", quality=JPEG_QUALITY)
    return Preview(
        tick=image.tick,
        timestamp_ns=image.timestamp_ns,
        width=small.width,
        height=small.height,
        format="png" if isinstance(image, DepthImage) else "jpeg",
        scale_m=image.scale_m if isinstance(image, DepthImage) else None,
        data=file.getvalue(),
    )
