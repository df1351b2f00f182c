"""Reads the pictures of a recording's cameras for a data set: color as it is, depth as gray."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.errors import WireError
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder
from snakesim_hal.wire.messages import ColorImage, DepthImage
from snakesim_operator.base.png import encode_png
from snakesim_operator.recording.reader import RecordingReader

_DECODERS = {"depth": Decoder(DepthImage), "color": Decoder(ColorImage)}
Rgb = NDArray[np.uint8]


@dataclass
class Pictures:
    """The pictures of one camera, in the order of their ticks. All numbers are 0 to 1."""

    width: int
    height: int
    ticks: list[int] = field(default_factory=list[int])
    png: list[bytes] = field(default_factory=list[bytes])

    # Mean and mean of squares of each picture, (3,).
    channel_means: list[NDArray[np.float64]] = field(default_factory=list[NDArray[np.float64]])
    channel_squares: list[NDArray[np.float64]] = field(default_factory=list[NDArray[np.float64]])

    # Extremes over all pictures, (3,).
    channel_min: NDArray[np.float64] = field(default_factory=lambda: np.ones(3))
    channel_max: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))

    def add(self, tick: int, rgb: Rgb) -> None:
        """Add a picture, (height * width * 3,) or (height, width, 3)."""
        pixels = rgb.reshape(-1, 3) / 255.0
        self.ticks.append(tick)
        self.png.append(encode_png(self.width, self.height, rgb.tobytes(), bits=8, color=True))
        self.channel_means.append(pixels.mean(axis=0))
        self.channel_squares.append(np.square(pixels).mean(axis=0))
        self.channel_min = np.minimum(self.channel_min, pixels.min(axis=0))
        self.channel_max = np.maximum(self.channel_max, pixels.max(axis=0))


def read_pictures(path: Path) -> dict[str, Pictures]:
    """Read the color and depth images of all cameras in a recording.

    Pictures are left out if they are damaged, if they are not newer than the one before, or if their size differs from
    the camera's first.

    Args:
        path: The recording.

    Returns:
        Pictures by camera. A camera `head` has its color images at `head`, and its depth images at `head_depth`.
    """
    pictures_by_camera: dict[str, Pictures] = {}
    for recorded in RecordingReader(path).read_messages((keys.COLOR_ALL, keys.DEPTH_ALL)):
        _, kind, name = recorded.key.split("/")
        try:
            image = _DECODERS[kind].decode(recorded.payload, recorded.encoding)
        except WireError:
            continue
        camera = name if kind == "color" else f"{name}_depth"
        pictures = pictures_by_camera.setdefault(camera, Pictures(image.width, image.height))
        has_same_size = (image.width, image.height) == (pictures.width, pictures.height)
        if not has_same_size or not _is_complete(image):
            continue
        is_newer = not pictures.ticks or image.tick > pictures.ticks[-1]
        if is_newer:
            pictures.add(image.tick, _rgb_of(image))
    return pictures_by_camera


def _is_complete(image: ColorImage | DepthImage) -> bool:
    """Return whether an image has as many bytes as its size needs."""
    pixel_count = image.width * image.height
    if isinstance(image, DepthImage):
        return len(image.depth) == 2 * pixel_count
    return len(image.rgb) == 3 * pixel_count


def _rgb_of(image: ColorImage | DepthImage) -> Rgb:
    """Return the pixels of an image.

    Depth is gray in three equal channels, as policies want it: 255 at the camera's maximum range, 0 where nothing was
    measured.
    """
    if not isinstance(image, DepthImage):
        return np.frombuffer(image.rgb, np.uint8)
    depth_m = np.frombuffer(image.depth, "<u2") * image.scale_m
    fraction = np.clip(depth_m / image.range_max_m, 0.0, 1.0)
    return np.repeat(np.rint(255 * fraction).astype(np.uint8), 3)
