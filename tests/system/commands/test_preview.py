"""Image previews keep depth values and colors, and images are fetched only while a client watches their preview."""

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

MAX_PREVIEW_BYTES = 4000
MAX_RED_ERROR = 24  # of 255, after compression
MAX_GREEN = 40  # of 255, in an image without green
CAMERA = {
    "link": 1,
    "position_l": (0.1, 0.0, 0.0),
    "orientation_l_wxyz": (1.0, 0.0, 0.0, 0.0),
    "fx_px": 80.0,
    "fy_px": 80.0,
    "cx_px": 79.5,
    "cy_px": 59.5,
}


def make_depth_image(tick: int = 0) -> DepthImage:
    """Return a depth image in which every pixel has another value."""
    depth_counts = np.arange(160 * 120, dtype="<u2").tobytes()
    limits = {"range_min_m": 0.05, "range_max_m": 4.0, "scale_m": 0.001}
    return DepthImage(
        tick=tick, timestamp_ns=tick, width=160, height=120, depth=depth_counts, **limits, **CAMERA
    )


def test_preview_of_depth_image_keeps_its_values() -> None:
    preview = encode_preview(make_depth_image(7), 80)
    decoded = np.array(PIL.Image.open(io.BytesIO(preview.data)))
    assert preview.tick == 7
    assert preview.width == 80
    assert preview.height == 60
    assert preview.format == "png"
    assert preview.scale_m == 0.001
    assert np.array_equal(decoded, np.arange(160 * 120).reshape(120, 160)[::2, ::2])


@pytest.mark.parametrize(
    ("width", "expected"), [(640, (160, 120)), (100, (80, 60)), (16, (16, 12))]
)
def test_preview_of_color_image_is_small_and_keeps_colors(
    width: int, expected: tuple[int, int]
) -> None:
    pixels = np.zeros((120, 160, 3), dtype=np.uint8)
    pixels[..., 0] = np.linspace(0, 255, 160)
    image = ColorImage(
        tick=0, timestamp_ns=0, width=160, height=120, rgb=pixels.tobytes(), **CAMERA
    )
    preview = encode_preview(image, width)
    decoded = np.array(PIL.Image.open(io.BytesIO(preview.data))).astype(int)
    assert (preview.width, preview.height) == expected
    assert preview.format == "jpeg"
    assert preview.scale_m is None
    assert len(preview.data) < MAX_PREVIEW_BYTES
    expected_red = np.linspace(0, 255, expected[0])
    middle_row = expected[1] // 2
    assert np.abs(decoded[middle_row, :, 0] - expected_red).max() < MAX_RED_ERROR
    assert decoded[..., 1].max() < MAX_GREEN


def test_preview_fetches_images_only_while_watched() -> None:
    sensor = SensorDescription(key=keys.depth_key("head"), rate_hz=20.0, delay_s=0.0)
    robot = msgspec.structs.replace(make_description(), sensors=[sensor])
    endpoint = find_free_endpoint()
    with (
        open_session(ConnectionSettings(endpoint, "worm", listen=True)) as host,
        open_session(ConnectionSettings(endpoint, "worm")) as preview_session,
    ):
        images = host.declare_publisher(keys.depth_key("head"), DepthImage)
        (camera,) = find_cameras(preview_session, robot, 80)
        camera.publish_preview()
        assert not images.has_subscriber()
        with open_session(ConnectionSettings(endpoint, "worm")) as watcher:
            previews = watcher.declare_reader(
                keys.preview_key(keys.depth_key("head")), ImagePreview
            )
            wait_until(
                lambda: camera.publish_preview() or images.has_subscriber(),
                "a subscription to the image",
            )
            images.put(make_depth_image(3))
            received: list[ImagePreview] = []
            wait_until(
                lambda: camera.publish_preview() or received.extend(previews.drain()) or received,
                "a preview",
            )
            assert received[0].tick == 3
            assert received[0].width == 80
        wait_until(
            lambda: camera.publish_preview() or not images.has_subscriber(),
            "the end of the subscription to the image",
        )
