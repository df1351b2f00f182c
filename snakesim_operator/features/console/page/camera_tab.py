"""Camera images as pictures: color as it is, depth as colors from near to far."""

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.wire.messages import ColorImage, DepthImage

Picture = NDArray[np.uint8]  # (height, width, 3)

# Dark to bright as the distance grows, in steps that every eye tells apart (after the map "viridis").
STOPS = np.array([[253, 231, 37], [94, 201, 98], [33, 145, 140], [59, 82, 139], [68, 1, 84]], dtype=np.float64)
NOTHING = (24, 26, 30)  # nothing within range


def picture(image: DepthImage | ColorImage) -> Picture:
    """The picture of an image."""
    shape = image.height, image.width
    if isinstance(image, ColorImage):
        return np.frombuffer(image.rgb, np.uint8).reshape(*shape, 3)
    depth_m = np.frombuffer(image.depth, "<u2").reshape(shape) * image.scale_m
    share = np.clip((depth_m - image.range_min_m) / (image.range_max_m - image.range_min_m), 0.0, 1.0)
    # The square root: what is near matters most, and most of a picture is near.
    place = np.sqrt(share) * (len(STOPS) - 1)
    colors = np.stack([np.interp(place, np.arange(len(STOPS)), STOPS[:, i]) for i in range(3)], axis=-1)
    colors[depth_m == 0] = NOTHING
    return colors.astype(np.uint8)
