"""Camera images as pictures: color as it is, depth as colors from near to far."""

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.wire.messages import ColorImage, DepthImage

Picture = NDArray[np.uint8]  # (height, width, 3)

# Colors from near to far, bright to dark, that people with color blindness can distinguish too.
# Source: the color map "viridis".
COLOR_STOPS = np.array(
    [[253, 231, 37], [94, 201, 98], [33, 145, 140], [59, 82, 139], [68, 1, 84]], dtype=np.float64
)
NO_DEPTH_COLOR = (24, 26, 30)  # of pixels without an object within range


def draw_picture(image: DepthImage | ColorImage) -> Picture:
    """Return an image as colors that a page can show."""
    if isinstance(image, ColorImage):
        return np.frombuffer(image.rgb, np.uint8).reshape(image.height, image.width, 3)
    return _colorize_depth(image)


def _colorize_depth(image: DepthImage) -> Picture:
    """Return a depth image with a color for each distance."""
    depth_m = np.frombuffer(image.depth, "<u2").reshape(image.height, image.width) * image.scale_m
    fraction = (depth_m - image.range_min_m) / (image.range_max_m - image.range_min_m)
    # The square root gives near objects more colors: they matter most, and most of a picture is near.
    stop = np.sqrt(np.clip(fraction, 0.0, 1.0)) * (len(COLOR_STOPS) - 1)
    stops = np.arange(len(COLOR_STOPS))
    channels = [np.interp(stop, stops, COLOR_STOPS[:, channel]) for channel in range(3)]
    colors = np.stack(channels, axis=-1)
    colors[depth_m == 0] = NO_DEPTH_COLOR
    return colors.astype(np.uint8)
