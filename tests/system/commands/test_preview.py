"""Previews of images: what is in them, and that nothing is fetched or compressed unless somebody looks."""

import io

import msgspec
import numpy as np
import PIL.Image
import pytest

from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ColorImage, DepthImage, ImagePreview, SensorDescription
from snakesim_operator.monitoring.preview import encode_preview, find_cameras
from snakesim_testing.hal.small_robots import make_description
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until

CAMERA = {
    "link": 1,
    "position_l": (0.1, 0.0, 0.0),
    "orientation_l_wxyz": (1.0, 0.0, 0.0, 0.0),
    "fx_px": 80.0,
    "fy_px": 80.0,
    "cx_px": 79.5,
    "cy_px": 59.5,
}


def depth(tick: int = 0) -> DepthImage:
    counts = np.arange(160 * 120, dtype="<u2").tobytes()
    limits = {"range_min_m": 0.05, "range_max_m": 4.0, "scale_m": 0.001}
    return DepthImage(
        tick=tick, timestamp_ns=tick, width=160, height=120, depth=counts, **limits, **CAMERA
    )


def test_depth_keeps_its_values() -> None:
    made = encode_preview(depth(7), 80)
    seen = np.array(PIL.Image.open(io.BytesIO(made.data)))
    assert made.tick == 7
    assert made.width == 80
    assert made.height == 60
    assert made.format == "png"
    assert made.scale_m == 0.001
    assert np.array_equal(seen, np.arange(160 * 120).reshape(120, 160)[::2, ::2])


@pytest.mark.parametrize(
    ("width", "expected"), [(640, (160, 120)), (100, (80, 60)), (16, (16, 12))]
)
def test_colour_is_small_and_looks_alike(width: int, expected: tuple[int, int]) -> None:
    ramp = np.zeros((120, 160, 3), dtype=np.uint8)
    ramp[..., 0] = np.linspace(0, 255, 160)
    image = ColorImage(tick=0, timestamp_ns=0, width=160, height=120, rgb=ramp.tobytes(), **CAMERA)
    made = encode_preview(image, width)
    seen = np.array(PIL.Image.open(io.BytesIO(made.data))).astype(int)
    assert (made.width, made.height) == expected
    assert made.format == "jpeg"
    assert made.scale_m is None
    assert len(made.data) < 4000
    across = np.linspace(0, 255, expected[0])
    assert np.abs(seen[expected[1] // 2, :, 0] - across).max() < 24
    assert seen[..., 1].max() < 40


def test_only_what_is_looked_at() -> None:
    sensor = SensorDescription(key=keys.depth_key("head"), rate_hz=20.0, delay_s=0.0)
    robot = msgspec.structs.replace(make_description(), sensors=[sensor])
    endpoint = find_free_endpoint()
    with (
        open_session(ConnectionSettings(endpoint, "worm", listen=True)) as hal,
        open_session(ConnectionSettings(endpoint, "worm")) as beside,
    ):
        images = hal.declare_publisher(keys.depth_key("head"), DepthImage)
        (camera,) = find_cameras(beside, robot, 80)
        camera.publish_preview()
        assert not images.has_subscriber()
        with open_session(ConnectionSettings(endpoint, "worm")) as far:
            seen = far.declare_reader(keys.preview_key(keys.depth_key("head")), ImagePreview)
            wait_until(
                lambda: camera.publish_preview() or images.has_subscriber(), "the image fetched"
            )
            images.put(depth(3))
            found: list[ImagePreview] = []
            wait_until(
                lambda: camera.publish_preview() or found.extend(seen.drain()) or found, "a preview"
            )
            assert found[0].tick == 3
            assert found[0].width == 80
        wait_until(
            lambda: camera.publish_preview() or not images.has_subscriber(),
            "the image left alone again",
        )
