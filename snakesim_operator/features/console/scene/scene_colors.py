"""Colors of the things in the 3-D scene. The legend, the force polygon and the joint charts use the same ones."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from snakesim_operator.results.page.palette import LIGHT

Color = tuple[int, int, int]  # sRGB, 0 to 255


def palette_color(name: str) -> Color:
    """Return a color of the palette that reports use."""
    text = LIGHT[name]
    return int(text[1:3], 16), int(text[3:5], 16), int(text[5:7], 16)


# The snake.
LINK = (52, 92, 138)
LINK_ALTERNATE = (70, 112, 160)  # every second link
HEAD = (22, 46, 84)
HINGE = (52, 58, 66)
FAILED_JOINT = palette_color("bad")
# Against PUSHED_OBSTACLE: blue and orange, for any kind of color vision.
PROPULSION_JOINT = 64, 190, 255

# Obstacles.
OBSTACLE = (176, 152, 112)
PUSHED_OBSTACLE = (226, 88, 12)
OBSTACLE_AHEAD = (232, 168, 56)
PERCEIVED = (0, 200, 170)

# Forces and contacts.
MEASURED_FORCE = palette_color("measured")
DESIRED_FORCE = palette_color("commanded")
RESULTANT = (20, 160, 90)
CONTACT_NORMAL = (120, 130, 142)
CONTACT_TANGENT = (170, 178, 186)

PATH = (90, 100, 112)
HILLS = (206, 198, 178)

LEGEND = (
    ("obstacle", OBSTACLE),
    ("perceived", PERCEIVED),
    ("pushed off", PUSHED_OBSTACLE),
    ("push-point ahead", OBSTACLE_AHEAD),
    ("contact force", MEASURED_FORCE),
    ("desired force; dashed: without contact", DESIRED_FORCE),
    ("resultant", RESULTANT),
    ("propulsion joint", PROPULSION_JOINT),
)


def convert_to_linear_colors(colors: Sequence[Color]) -> NDArray[np.uint8]:
    """Convert sRGB colors to linear light, (n, 3): viser expects this for instances of batches and for arrows only.

    Source: transfer function of IEC 61966-2-1.
    """
    srgb = np.array(colors) / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return np.round(255 * linear).astype(np.uint8)
