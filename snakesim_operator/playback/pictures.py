"""What a recording's cameras saw, as pictures for a data set: color as it is, depth as grey."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.errors import WireError
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder
from snakesim_hal.wire.messages import ColorImage, DepthImage
from snakesim_operator.base.png import png
from snakesim_operator.recording.reader import RecordingReader

_KINDS = {"depth": Decoder(DepthImage), "color": Decoder(ColorImage)}
Rgb = NDArray[np.uint8]


@dataclass
class Pictures:
    """Of one camera, in the order of their ticks."""

    width: int
    height: int
    ticks: list[int] = field(default_factory=list[int])
    png: list[bytes] = field(default_factory=list[bytes])
    channel_means: list[NDArray[np.float64]] = field(default_factory=list[NDArray[np.float64]])  # of each, 0 to 1
    channel_squares: list[NDArray[np.float64]] = field(default_factory=list[NDArray[np.float64]])
    least: NDArray[np.float64] = field(default_factory=lambda: np.ones(3))
    most: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))

    def take(self, tick: int, rgb: Rgb) -> None:
        """One picture, (height, width, 3)."""
        share = rgb.reshape(-1, 3) / 255.0
        self.ticks.append(tick)
        self.png.append(png(self.width, self.height, rgb.tobytes(), bits=8, color=True))
        self.channel_means.append(share.mean(axis=0))
        self.channel_squares.append(np.square(share).mean(axis=0))
        self.least, self.most = np.minimum(self.least, share.min(axis=0)), np.maximum(self.most, share.max(axis=0))


def read_pictures(path: Path) -> dict[str, Pictures]:
    """By camera, `head` or `head_depth`; those of another size than a camera's first are left out."""
    found: dict[str, Pictures] = {}
    for recorded in RecordingReader(path).messages((keys.COLOUR_ALL, keys.DEPTH_ALL)):
        _, kind, name = recorded.key.split("/")
        try:
            seen = _KINDS[kind].decode(recorded.payload, recorded.encoding)
        except WireError:
            continue
        camera = name if kind == "color" else f"{name}_depth"
        pictures = found.setdefault(camera, Pictures(seen.width, seen.height))
        data, pixel_bytes = (seen.depth, 2) if isinstance(seen, DepthImage) else (seen.rgb, 3)
        alike = (seen.width, seen.height) == (pictures.width, pictures.height)
        whole = len(data) == pixel_bytes * seen.width * seen.height
        if alike and whole and (not pictures.ticks or seen.tick > pictures.ticks[-1]):
            rgb = _grey(seen) if isinstance(seen, DepthImage) else np.frombuffer(data, np.uint8)
            pictures.take(seen.tick, rgb)
    return found


def _grey(seen: DepthImage) -> Rgb:
    """255 at the camera's longest range, 0 where nothing was measured; three channels alike, as policies want them."""
    depth_m = np.frombuffer(seen.depth, "<u2") * seen.scale_m
    share = np.clip(depth_m / seen.range_max_m, 0.0, 1.0)
    return np.repeat(np.rint(255 * share).astype(np.uint8), 3)
