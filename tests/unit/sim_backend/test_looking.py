"""Compares the measurements of simulated depth cameras, lidars and custom range sensors with geometry."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.geometry.kinematics import rotation_from_quaternion
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MessageDecoder, encode, format_encoding
from snakesim_hal.wire.messages import ColorImage, DepthImage, RangeScan
from snakesim_sim_backend.laws.flat_ground import SINK_M
from snakesim_testing.messages import raises_error
from snakesim_testing.sim.simulator_rig import SimulatorRig, make_config

NOSE_M = 13 * 0.11 + 0.04  # x of the front end of the snake
LIDAR_KEY = keys.ranges_key("front")
CAMERA = {
    "name": "head",
    "width": 161,
    "height": 121,
    "rate_hz": 100.0,
    "delay_s": 0.0,
    "range_min_m": 0.02,
}
HEAD_KEY = keys.depth_key("head")
POST = {
    "cylinder": [
        {"position_m": [NOSE_M + 1.05, 0.0], "radius_m": 0.05, "height_m": 1.0, "name": "post"}
    ]
}


def open_rig(scene=None, *, kind="depth", **sensor):
    """Return the rig of a straight snake along x with one camera or lidar."""
    base = CAMERA if kind == "depth" else {"name": "front", "rate_hz": 100.0, "delay_s": 0.0}
    return SimulatorRig(make_config({"sensors": {kind: [{**base, **sensor}]}}, scene or {}))


def measure(run, key=HEAD_KEY) -> Any:
    """Return the message of the sensor for this tick, which arrives with the next, and close the rig."""
    run.sample()
    run.advance()
    message = run.sample().by_key[key]
    run.sim.close()
    decoder = MessageDecoder(type(message))
    assert decoder.decode(encode(message), format_encoding(type(message))) == message
    return message


def get_depth_m(image):
    """Return the depths (height, width) of an image, NaN where nothing was measured."""
    assert isinstance(image, DepthImage)
    counts = np.frombuffer(image.depth, "<u2").reshape(image.height, image.width)
    return np.where(counts > 0, counts * image.scale_m, np.nan)


def test_camera_depth_of_post_has_geometric_distance_and_width():
    image = measure(open_rig(POST))
    row_m = get_depth_m(image)[int(image.cy_px)]
    middle = int(image.cx_px)
    assert row_m[middle] == pytest.approx(1.0, abs=0.001)
    columns = np.flatnonzero(~np.isnan(row_m))
    # The edges of the post are tangents.
    half_width_px = image.fx_px * np.tan(np.arcsin(0.05 / 1.05))
    assert columns[0] == np.ceil(middle - half_width_px)
    assert columns[-1] == np.floor(middle + half_width_px)
    # The points are on the circle of the post.
    across_m = (columns - middle) / image.fx_px * row_m[columns]
    assert np.hypot(row_m[columns] - 1.05, across_m) == pytest.approx(0.05, abs=0.0015)


def test_camera_depth_of_ground_follows_from_height_and_pitch():
    """Depth is measured along the optical axis and not along the ray, so that it is the same in all of a row."""
    image = measure(open_rig(position_m=[0.095, 0.0, 0.03], pitch_rad=0.3))
    depth_m = get_depth_m(image)
    height_m = 0.04 + 0.03 - SINK_M
    up_slope = (image.cy_px - np.arange(image.height)) / image.fy_px
    with np.errstate(divide="ignore"):
        expected_m = height_m / (np.sin(0.3) - up_slope * np.cos(0.3))
    below = (expected_m > image.range_min_m) & (expected_m < image.range_max_m)
    assert below.sum() > 80
    assert depth_m[below] == pytest.approx(
        np.tile(expected_m[below, None], image.width), rel=0.003, abs=0.001
    )
    assert np.isnan(depth_m[~below]).all()


def test_camera_pose_in_message_locates_the_measured_point():
    ball = {"sphere": [{"position_m": [0.7, 1.0], "radius_m": 0.1, "center_height_m": 0.9}]}
    run = open_rig(ball, link=6, position_m=[0.05, 0.0, 0.1], yaw_rad=1.4, pitch_rad=-0.6)
    image = measure(run)
    depth_m = get_depth_m(image)
    # The pixel in row v and column u is the nearest point of the ball.
    v, u = np.unravel_index(np.nanargmin(depth_m), depth_m.shape)
    ray_c = np.array([1.0, -(u - image.cx_px) / image.fx_px, -(v - image.cy_px) / image.fy_px])
    point_l = (
        np.array(image.position_l)
        + rotation_from_quaternion(image.orientation_l_wxyz) @ ray_c * depth_m[v, u]
    )
    data = run.sim.data
    body = run.sim.sim.first_link_body + image.link
    point_w = data.xpos[body] + data.xmat[body].reshape(3, 3) @ point_l
    assert image.link == 6
    assert np.linalg.norm(point_w - [0.7, 1.0, 0.9]) == pytest.approx(0.1, abs=0.003)


def test_camera_sees_body_but_not_its_own_link():
    backward = {"position_m": [0.02, 0.0, 0.2], "yaw_rad": 3.1415, "pitch_rad": 0.3}
    image = measure(open_rig(**backward))
    bottom_m = get_depth_m(image)[-1, 80]
    ground_m = (0.2 + 0.04) / (np.sin(0.3) + 60 / image.fy_px * np.cos(0.3))
    assert bottom_m < ground_m - 0.02, "the body hides the ground"
    depth_from_inside_m = get_depth_m(measure(open_rig(POST, position_m=[0.05, 0.0, 0.0])))
    assert depth_from_inside_m[60, 80] == pytest.approx(1.0 + 0.095 - 0.05, abs=0.002)


def test_camera_depth_outside_the_range_is_not_measured():
    for change in ({"range_min_m": 1.1}, {"range_max_m": 0.9}):
        assert np.isnan(get_depth_m(measure(open_rig(POST, kind="depth", **change)))[60, 80])


def test_lidar_measures_along_each_beam_from_right_to_left():
    scene = {"cylinder": [{"position_m": [NOSE_M + 1.0, 0.4], "radius_m": 0.2, "height_m": 1.0}]}
    scan = measure(open_rig(scene, kind="range", beams=181, fov_rad=3.0), LIDAR_KEY)
    assert isinstance(scan, RangeScan)
    angles_rad = scan.angle_min_rad + scan.angle_step_rad * np.arange(181)
    assert (angles_rad[0], angles_rad[-1]) == pytest.approx((-1.5, 1.5))
    # Each beam passes the center of the post at this distance along the beam.
    along_m = np.cos(angles_rad) * 1.0 + np.sin(angles_rad) * 0.4
    # Half the squared chord that the post cuts out of the beam, negative if the beam misses it.
    squared_half_chords_m2 = 0.2**2 - (1.0 + 0.4**2 - along_m**2)
    for angle_rad, range_m, center_m, squared_half_chord_m2 in zip(
        angles_rad, scan.range_m, along_m, squared_half_chords_m2, strict=True
    ):
        if squared_half_chord_m2 > 1e-4 and center_m > 0:
            expected_m = center_m - np.sqrt(squared_half_chord_m2)
            assert range_m == pytest.approx(expected_m, abs=1e-4), angle_rad
        elif squared_half_chord_m2 < -1e-4:
            assert range_m is None, angle_rad


def test_range_finder_is_a_lidar_of_one_beam():
    scan = measure(open_rig(POST, kind="range"), LIDAR_KEY)
    assert scan.range_m == [pytest.approx(1.0, abs=1e-6)]
    scan = measure(open_rig(POST, kind="range", range_max_m=0.9), LIDAR_KEY)
    assert scan.range_m == [None]


def test_camera_and_lidar_noise_is_that_of_robot_file():
    wall = {"box": [{"position_m": [NOSE_M + 2.5, 0.0], "size_m": [1.0, 19.0, 9.0]}]}
    noisy_camera = {
        "position_m": [0.095, 0.0, 3.0],
        "noise_m": 0.002,
        "noise_m_per_m2": 0.003,
        "dropout": 0.1,
    }
    depth_m = get_depth_m(measure(open_rig(wall, **noisy_camera)))
    assert np.isnan(depth_m).mean() == pytest.approx(0.1, abs=0.01)
    assert np.nanmean(depth_m) == pytest.approx(2.0, abs=0.001)
    assert np.nanstd(depth_m) == pytest.approx(0.002 + 0.003 * 2.0**2, rel=0.03)

    noisy_lidar = {"beams": 1001, "fov_rad": 0.2, "noise_m": 0.01, "dropout": 0.2}
    scan = measure(open_rig(wall, kind="range", **noisy_lidar), LIDAR_KEY)
    angles_rad = scan.angle_min_rad + scan.angle_step_rad * np.arange(1001)
    ranges_m = np.array([np.nan if range_m is None else range_m for range_m in scan.range_m])
    assert np.isnan(ranges_m).mean() == pytest.approx(0.2, abs=0.04)
    assert np.nanstd(ranges_m * np.cos(angles_rad)) == pytest.approx(0.01, rel=0.1)


def test_custom_sonar_is_one_file_and_one_robot_line():
    """The sonar is the example of docs/how-to/custom-sensors.md."""
    sonar = {
        "model": f"{Path(__file__).parents[3] / 'examples' / 'sonar.py'}:Sonar",
        "settings": {"cone_rad": 0.5},
    }
    aside = {"cylinder": [{"position_m": [NOSE_M + 1.0, 0.2], "radius_m": 0.05, "height_m": 1.0}]}
    place = {"position_m": [0.095, 0.0, 0.5], "pitch_rad": 0.0, "range_max_m": 2.0}
    scan = measure(open_rig(aside, kind="range", **place, **sonar), LIDAR_KEY)
    assert scan.range_m == [pytest.approx(np.hypot(1.0, 0.2) - 0.05, abs=0.02)]
    narrow_sonar = {**sonar, "settings": {"cone_rad": 0.2}}
    scan = measure(open_rig(aside, kind="range", **place, **narrow_sonar), LIDAR_KEY)
    assert scan.range_m == [None]


# --- rendered by OpenGL ----------------------------------------------------------------------------------------


def open_rendering_rig(**sensor):
    """Return a rig whose camera renders images. Skip the test where there is no OpenGL."""
    try:
        return open_rig(POST, position_m=[0.095, 0.0, 0.03], pitch_rad=0.2, **sensor)
    except ConfigError as error:
        pytest.skip(f"no OpenGL here: {error}")


def test_rendered_depth_equals_that_of_the_rays():
    ray_depth_m = get_depth_m(measure(open_rig(POST, position_m=[0.095, 0.0, 0.03], pitch_rad=0.2)))
    rendered_depth_m = get_depth_m(measure(open_rendering_rig(model="rendered")))
    is_in_both = ~np.isnan(ray_depth_m) & ~np.isnan(rendered_depth_m)
    # The images may differ at the outlines.
    assert (np.isnan(ray_depth_m) != np.isnan(rendered_depth_m)).mean() < 0.005
    errors_m = np.abs(ray_depth_m - rendered_depth_m)[is_in_both]
    assert np.quantile(errors_m, 0.99) < 0.004


def test_color_image_shows_the_scene_of_the_depth_image():
    run = open_rendering_rig(color=True)
    image = measure(run, keys.color_key("head"))
    assert isinstance(image, ColorImage)
    rgb = np.frombuffer(image.rgb, np.uint8).reshape(image.height, image.width, 3).astype(int)
    post_rgb = rgb[40, 80]
    ground_rgb = rgb[110, 20]
    assert post_rgb[2] > post_rgb[0] + 20, "the post is blue"
    assert ground_rgb[0] > ground_rgb[2] + 10, "the ground has the color of sand"
    assert [sensor.key for sensor in run.sim.describe().sensors][-2:] == [
        keys.depth_key("head"),
        keys.color_key("head"),
    ]


def test_rendering_without_opengl_names_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    with raises_error(ConfigError, code="simulator/no-opengl", field="head"):
        open_rig(color=True)
