"""Depth cameras and lidars against geometry: what they see, from where, and what they cannot see."""

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

NOSE_M = 13 * 0.11 + 0.04
CAMERA = {
    "name": "head",
    "width": 161,
    "height": 121,
    "rate_hz": 100.0,
    "delay_s": 0.0,
    "range_min_m": 0.02,
}
HEAD = keys.depth_key("head")
POST = {
    "cylinder": [
        {"position_m": [NOSE_M + 1.05, 0.0], "radius_m": 0.05, "height_m": 1.0, "name": "post"}
    ]
}


def simulate(scene=None, *, kind="depth", **sensor):
    """A straight snake along x with one camera or lidar."""
    base = CAMERA if kind == "depth" else {"name": "front", "rate_hz": 100.0, "delay_s": 0.0}
    return SimulatorRig(make_config({"sensors": {kind: [{**base, **sensor}]}}, scene or {}))


def newest(run, key=HEAD) -> Any:
    """What the sensor measured at this tick; it arrives with the next."""
    run.sample()
    run.advance()
    message = run.sample().by_key[key]
    run.sim.close()
    assert (
        MessageDecoder(type(message)).decode(encode(message), format_encoding(type(message)))
        == message
    )
    return message


def metres(image):
    """(height, width), NaN where nothing was measured."""
    assert isinstance(image, DepthImage)
    counts = np.frombuffer(image.depth, "<u2").reshape(image.height, image.width)
    return np.where(counts > 0, counts * image.scale_m, np.nan)


def test_depth_of_a_post_has_geometric_distance_and_width():
    image = newest(simulate(POST))
    depth_m = metres(image)
    row, middle = depth_m[int(image.cy_px)], int(image.cx_px)
    assert row[middle] == pytest.approx(1.0, abs=0.001)
    columns = np.flatnonzero(~np.isnan(row))
    half_px = image.fx_px * np.tan(np.arcsin(0.05 / 1.05))  # its edges are tangents
    assert columns[0] == np.ceil(middle - half_px)
    assert columns[-1] == np.floor(middle + half_px)
    across_m = (columns - middle) / image.fx_px * row[columns]  # the points lie on the circle
    assert np.hypot(row[columns] - 1.05, across_m) == pytest.approx(0.05, abs=0.0015)


def test_the_ground_is_as_far_as_height_and_pitch_say():
    """Depth is along the optical axis and not along the ray: a row has one, in the corners too."""
    image = newest(simulate(position_m=[0.095, 0.0, 0.03], pitch_rad=0.3))
    depth_m = metres(image)
    height_m = 0.04 + 0.03 - SINK_M
    up = (image.cy_px - np.arange(image.height)) / image.fy_px
    with np.errstate(divide="ignore"):
        wanted = height_m / (np.sin(0.3) - up * np.cos(0.3))
    below = (wanted > image.range_min_m) & (wanted < image.range_max_m)
    assert below.sum() > 80
    assert depth_m[below] == pytest.approx(
        np.tile(wanted[below, None], image.width), rel=0.003, abs=0.001
    )
    assert np.isnan(depth_m[~below]).all()


def test_camera_points_along_its_yaw_pitch_and_message():
    ball = {"sphere": [{"position_m": [0.7, 1.0], "radius_m": 0.1, "center_height_m": 0.9}]}
    run = simulate(ball, link=6, position_m=[0.05, 0.0, 0.1], yaw_rad=1.4, pitch_rad=-0.6)
    image = newest(run)
    depth_m = metres(image)
    v, u = np.unravel_index(np.nanargmin(depth_m), depth_m.shape)
    ray_c = np.array([1.0, -(u - image.cx_px) / image.fx_px, -(v - image.cy_px) / image.fy_px])
    point_l = (
        np.array(image.position_l)
        + rotation_from_quaternion(image.orientation_l_wxyz) @ ray_c * depth_m[v, u]
    )
    data, sim = run.sim.data, run.sim.sim
    body = sim.first_link_body + image.link
    point_w = data.xpos[body] + data.xmat[body].reshape(3, 3) @ point_l
    assert image.link == 6
    assert np.linalg.norm(point_w - [0.7, 1.0, 0.9]) == pytest.approx(0.1, abs=0.003)


def test_camera_sees_body_but_not_its_own_link():
    back = {"position_m": [0.02, 0.0, 0.2], "yaw_rad": 3.1415, "pitch_rad": 0.3}
    image = newest(simulate(**back))
    bottom = metres(image)[-1, 80]
    floor_m = (0.2 + 0.04) / (np.sin(0.3) + 60 / image.fy_px * np.cos(0.3))
    assert bottom < floor_m - 0.02  # the back of the body, not the floor
    inside = metres(newest(simulate(POST, position_m=[0.05, 0.0, 0.0])))
    assert inside[60, 80] == pytest.approx(1.0 + 0.095 - 0.05, abs=0.002)


def test_depth_outside_the_range_is_not_measured():
    for change in ({"range_min_m": 1.1}, {"range_max_m": 0.9}):
        assert np.isnan(metres(newest(simulate(POST, kind="depth", **change)))[60, 80])


def test_a_lidar_measures_along_each_beam_from_right_to_left():
    scene = {"cylinder": [{"position_m": [NOSE_M + 1.0, 0.4], "radius_m": 0.2, "height_m": 1.0}]}
    scan = newest(simulate(scene, kind="range", beams=181, fov_rad=3.0), keys.ranges_key("front"))
    assert isinstance(scan, RangeScan)
    angles = scan.angle_min_rad + scan.angle_step_rad * np.arange(181)
    assert (angles[0], angles[-1]) == pytest.approx((-1.5, 1.5))
    along = np.cos(angles) * 1.0 + np.sin(angles) * 0.4
    behind = 0.2**2 - (1.0 + 0.4**2 - along**2)
    for angle, found, foot, room in zip(angles, scan.range_m, along, behind, strict=True):
        if room > 1e-4 and foot > 0:
            assert found == pytest.approx(foot - np.sqrt(room), abs=1e-4), angle
        elif room < -1e-4:
            assert found is None, angle


def test_a_range_finder_is_a_lidar_of_one_beam():
    scan = newest(simulate(POST, kind="range"), keys.ranges_key("front"))
    assert scan.range_m == [pytest.approx(1.0, abs=1e-6)]
    assert newest(
        simulate(POST, kind="range", range_max_m=0.9), keys.ranges_key("front")
    ).range_m == [None]


def test_noise_and_dropouts_have_the_size_of_the_robot_file():
    wall = {"box": [{"position_m": [NOSE_M + 2.5, 0.0], "size_m": [1.0, 19.0, 9.0]}]}
    place = {
        "position_m": [0.095, 0.0, 3.0],
        "noise_m": 0.002,
        "noise_m_per_m2": 0.003,
        "dropout": 0.1,
    }
    depth_m = metres(newest(simulate(wall, **place)))
    assert np.isnan(depth_m).mean() == pytest.approx(0.1, abs=0.01)
    assert np.nanmean(depth_m) == pytest.approx(2.0, abs=0.001)
    assert np.nanstd(depth_m) == pytest.approx(0.002 + 0.003 * 2.0**2, rel=0.03)
    noisy = {"beams": 1001, "fov_rad": 0.2, "noise_m": 0.01, "dropout": 0.2}
    scan = newest(simulate(wall, kind="range", **noisy), keys.ranges_key("front"))
    angles = scan.angle_min_rad + scan.angle_step_rad * np.arange(1001)
    found = np.array([np.nan if x is None else x for x in scan.range_m])
    assert np.isnan(found).mean() == pytest.approx(0.2, abs=0.04)
    assert np.nanstd(found * np.cos(angles)) == pytest.approx(0.01, rel=0.1)


def test_custom_sonar_is_one_file_and_one_robot_line():
    """The example of docs/how-to/custom-sensors.md."""
    sonar = {
        "model": f"{Path(__file__).parents[3] / 'examples' / 'sonar.py'}:Sonar",
        "settings": {"cone_rad": 0.5},
    }
    aside = {"cylinder": [{"position_m": [NOSE_M + 1.0, 0.2], "radius_m": 0.05, "height_m": 1.0}]}
    place = {"position_m": [0.095, 0.0, 0.5], "pitch_rad": 0.0, "range_max_m": 2.0}
    heard = newest(simulate(aside, kind="range", **place, **sonar), keys.ranges_key("front"))
    assert heard.range_m == [pytest.approx(np.hypot(1.0, 0.2) - 0.05, abs=0.02)]
    narrow = {**sonar, "settings": {"cone_rad": 0.2}}
    assert newest(
        simulate(aside, kind="range", **place, **narrow), keys.ranges_key("front")
    ).range_m == [None]


# --- by OpenGL -------------------------------------------------------------------------------------------------


def rendered(**sensor):
    try:
        return simulate(POST, position_m=[0.095, 0.0, 0.03], pitch_rad=0.2, **sensor)
    except ConfigError as error:
        pytest.skip(f"no OpenGL here: {error}")


def test_rendered_depth_is_that_of_the_rays():
    cast = metres(newest(simulate(POST, position_m=[0.095, 0.0, 0.03], pitch_rad=0.2)))
    drawn = metres(newest(rendered(model="rendered")))
    both = ~np.isnan(cast) & ~np.isnan(drawn)
    assert (np.isnan(cast) != np.isnan(drawn)).mean() < 0.005  # outlines
    off_m = np.abs(cast - drawn)[both]
    assert np.quantile(off_m, 0.99) < 0.004


def test_color_image_accompanies_depth_and_shows_the_same():
    run = rendered(color=True)
    image = newest(run, keys.color_key("head"))
    assert isinstance(image, ColorImage)
    rgb = np.frombuffer(image.rgb, np.uint8).reshape(image.height, image.width, 3).astype(int)
    post, ground = rgb[40, 80], rgb[110, 20]
    assert post[2] > post[0] + 20  # blue
    assert ground[0] > ground[2] + 10  # sand
    assert [sensor.key for sensor in run.sim.describe().sensors][-2:] == [
        keys.depth_key("head"),
        keys.color_key("head"),
    ]


def test_without_opengl_the_error_names_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    with raises_error(ConfigError, code="simulator/no-opengl", field="head"):
        simulate(color=True)
