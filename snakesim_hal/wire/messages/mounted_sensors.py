"""Samples of sensors that are mounted on a link: cameras, lidars, range finders and custom sensors."""

from typing import Annotated, Literal

from msgspec import Meta

from snakesim_hal.wire import quantities as q
from snakesim_hal.wire.messages.base import Message
from snakesim_hal.wire.quantities import describe

RANGE_SLACK_FRACTION = 0.05  # of the stated range of a camera or lidar: room for noise at its ends


class MountedSample(Message, frozen=True, kw_only=True):
    """Base of the samples of sensors that are mounted on a link."""

    tick: q.Tick
    timestamp_ns: Annotated[q.Stamp, describe("of the measurement (`tick` is later by the delay)")]
    link: Annotated[q.LinkIndex, describe("that carries the sensor, from 0 at the tail")]
    position_l: Annotated[q.Vector, describe("of the sensor")]
    orientation_l_wxyz: Annotated[
        q.Quaternion, describe("of the sensor's frame in that of the link")
    ]

    def find_contradiction(self) -> str:
        """Describe what is impossible although each number is within its bounds; empty if nothing is.

        The contract suite of backends calls it.
        """
        return ""


class CameraImage(MountedSample, frozen=True, kw_only=True):
    """Base of the images of a pinhole camera. DepthImage describes its frame."""

    width: Annotated[int, Meta(ge=1, le=q.MAX_IMAGE_WIDTH), describe("pixels in a row")]
    height: Annotated[int, Meta(ge=1, le=q.MAX_IMAGE_HEIGHT), describe("rows")]
    fx_px: q.FocalLength
    fy_px: q.FocalLength
    cx_px: q.Pixels
    cy_px: q.Pixels


class DepthImage(CameraImage, frozen=True, kw_only=True):
    """`sensor/depth/<name>`: distances to the surfaces that a camera sees.

    Camera frame: x forward along the optical axis, y to the left, z upwards. The ray through pixel (u, v), u to the
    right and v downwards from the middle of the top left one, is (1, -(u - cx_px) / fx_px, -(v - cy_px) / fy_px).
    """

    range_min_m: Annotated[
        q.Distance, describe("along the optical axis; what is nearer is 0 in `depth`")
    ]
    range_max_m: Annotated[
        q.Distance, describe("along the optical axis; what is further is 0 in `depth`")
    ]
    scale_m: Annotated[float, Meta(gt=0, le=1), describe("meters per count of `depth`")]
    depth: Annotated[
        bytes,
        Meta(max_length=2 * q.MAX_PIXELS),
        describe(
            "uint16, little endian, row by row from the top: distance along the optical axis in counts; "
            "0: nothing within range, or the pixel dropped out"
        ),
    ]

    def find_contradiction(self) -> str:
        whole_pixels = self.depth[: len(self.depth) // 2 * 2]
        counts = set(memoryview(whole_pixels).cast("H")) - {0}
        distances_m = [count * self.scale_m for count in counts]
        return _describe_beyond_range(self.range_min_m, self.range_max_m, distances_m)


class ColorImage(CameraImage, frozen=True, kw_only=True):
    """`sensor/color/<name>`: what a camera sees, in color. Frame and pixels are as in DepthImage."""

    rgb: Annotated[
        bytes,
        Meta(max_length=3 * q.MAX_PIXELS),
        describe("red, green and blue of each pixel, row by row from the top"),
    ]


class RangeScan(MountedSample, frozen=True, kw_only=True):
    """`sensor/range/<name>`: distances along the beams of a 2-D lidar, or along the one of a range finder.

    Beams lie in the xy plane of the sensor's frame; beam i is turned by `angle_min_rad` + i x `angle_step_rad` from x,
    positive to the left.
    """

    angle_min_rad: Annotated[q.Angle, describe("of the first beam")]
    angle_step_rad: Annotated[q.Angle, describe("from one beam to the next")]
    range_min_m: Annotated[q.Distance, describe("along the beam; what is nearer is null")]
    range_max_m: Annotated[q.Distance, describe("along the beam; what is further is null")]
    range_m: Annotated[
        list[q.Distance | None],
        Meta(min_length=1, max_length=q.MAX_BEAMS),
        describe("one entry a beam; null: nothing within range, or the beam dropped out"),
    ]

    def find_contradiction(self) -> str:
        distances_m = [distance_m for distance_m in self.range_m if distance_m is not None]
        return _describe_beyond_range(self.range_min_m, self.range_max_m, distances_m)


def _describe_beyond_range(min_m: float, max_m: float, distances_m: list[float]) -> str:
    """Describe distances that are beyond the range of their sensor; empty if all are within it."""
    slack_m = RANGE_SLACK_FRACTION * max_m
    if min_m < max_m and all(
        min_m - slack_m <= distance_m <= max_m + slack_m for distance_m in distances_m
    ):
        return ""
    measured = "nothing"
    if distances_m:
        measured = f"{min(distances_m)} to {max(distances_m)} m"
    return f"{measured} was measured, and its range is {min_m} to {max_m} m"


class CustomSample(MountedSample, frozen=True, kw_only=True):
    """`sensor/custom/<name>`: a sample of a custom sensor, with the further fields in `RobotDescription.custom`."""


class ImagePreview(Message, frozen=True, kw_only=True):
    """`preview/depth/<camera>` or `preview/color/<camera>`: a small, compressed copy of an image."""

    tick: q.Tick
    timestamp_ns: Annotated[q.Stamp, describe("of the image that it was made from")]
    width: Annotated[
        int, Meta(ge=1, le=q.MAX_IMAGE_WIDTH), describe("pixels in a row of this copy")
    ]
    height: Annotated[int, Meta(ge=1, le=q.MAX_IMAGE_HEIGHT), describe("rows of this copy")]
    format: Annotated[
        Literal["jpeg", "png"], describe("of `data`: jpeg in color, png of 16 bits for depth")
    ]
    scale_m: Annotated[
        Annotated[float, Meta(gt=0, le=1)] | None,
        describe(
            "meters per count of depth, which is 0 for nothing within range; null: it is in color"
        ),
    ] = None
    data: Annotated[bytes, Meta(max_length=q.MAX_PREVIEW_BYTES), describe("the file")]
