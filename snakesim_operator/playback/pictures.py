"""Reads the camera images of a recording for a dataset: color as recorded, depth as gray."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.errors import WireError
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MessageDecoder
from snakesim_hal.wire.messages import ColorImage, DepthImage
from snakesim_operator.base.png import encode_png
from snakesim_operator.recording.reader import RecordingReader

_DECODERS = {"depth": MessageDecoder(DepthImage), "color": MessageDecoder(ColorImage)}
Rgb = NDArray[np.uint8]


@dataclass
class CameraImages:
    """Images of one camera in the order of their ticks, and statistics of their color channels from 0 to 1."""

    width: int
    height: int
    ticks: list[int] = field(default_factory=list[int])
    png: list[bytes] = field(default_factory=list[bytes])

    # Mean and mean of squares of the color channels of each image, (3,).
    channel_means: list[NDArray[np.float64]] = field(default_factory=list[NDArray[np.float64]])
    channel_squares: list[NDArray[np.float64]] = field(default_factory=list[NDArray[np.float64]])

    # Extremes of the color channels over all images, (3,).
    channel_min: NDArray[np.float64] = field(default_factory=lambda: np.ones(3))
    channel_max: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))

    def add(self, tick: int, rgb: Rgb) -> None:
        """Add an image, (height * width * 3,) or (height, width, 3), as PNG and to the statistics."""
        pixels = rgb.reshape(-1, 3) / 255.0
        self.ticks.append(tick)
        self.png.append(encode_png(self.width, self.height, rgb.tobytes(), bits=8, color=True))
        self.channel_means.append(pixels.mean(axis=0))
        self.channel_squares.append(np.square(pixels).mean(axis=0))
        self.channel_min = np.minimum(self.channel_min, pixels.min(axis=0))
        self.channel_max = np.maximum(self.channel_max, pixels.max(axis=0))


def read_camera_images(path: Path) -> dict[str, CameraImages]:
    """Read the color and depth images of all cameras in a recording.

    An image is left out if it is damaged, if it is not newer than the previous one, or if its size differs from that of
    the first image of its camera.

    Args:
        path: Path of the recording.

    Returns:
        Images by name of the camera: color images of a camera `head` as `head`, its depth images as `head_depth`.
    """
    images_by_camera: dict[str, CameraImages] = {}
    for recorded in RecordingReader(path).read_messages((keys.COLOR_ALL, keys.DEPTH_ALL)):
        _, kind, name = recorded.key.split("/")
        try:
            image = _DECODERS[kind].decode(recorded.payload, recorded.encoding)
        except WireError:
            continue
        camera = name if kind == "color" else f"{name}_depth"
        camera_images = images_by_camera.setdefault(camera, CameraImages(image.width, image.height))
        has_same_size = (image.width, image.height) == (camera_images.width, camera_images.height)
        if not has_same_size or not _is_complete(image):
            continue
        is_newer = not camera_images.ticks or image.tick > camera_images.ticks[-1]
        if is_newer:
            camera_images.add(image.tick, _convert_to_rgb(image))
    return images_by_camera


def _is_complete(image: ColorImage | DepthImage) -> bool:
    """Return whether an image has as many bytes as its size needs."""
    pixel_count = image.width * image.height
    if isinstance(image, DepthImage):
        return len(image.depth) == 2 * pixel_count
    return len(image.rgb) == 3 * pixel_count


def _convert_to_rgb(image: ColorImage | DepthImage) -> Rgb:
    """Convert an image to RGB pixels.

    Depth becomes gray in three equal channels, as policies expect it: 255 at the maximum range of the camera, 0 where
    nothing was measured.
    """
    if not isinstance(image, DepthImage):
        return np.frombuffer(image.rgb, np.uint8)
    depth_m = np.frombuffer(image.depth, "<u2") * image.scale_m
    fraction = np.clip(depth_m / image.range_max_m, 0.0, 1.0)
    return np.repeat(np.rint(255 * fraction).astype(np.uint8), 3)
