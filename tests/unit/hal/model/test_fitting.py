"""A scene that was laid out for one robot suits another one as well, and what a user sets stays as it is."""

from pathlib import Path

import pytest

from snakesim_hal.model.fitting import compute_joint_spacing_m
from snakesim_hal.model.scenario import (
    RunConfig,
    load_scenario,
    parse_set_option,
    place_obstacles,
    write_config,
)
from snakesim_hal.model.scene import SineRoute


def clutter(*sets: str) -> RunConfig:
    return load_scenario("surveyed_clutter", [parse_set_option(text) for text in sets]).config


def sine(config: RunConfig) -> SineRoute:
    assert isinstance(config.scene.route, SineRoute)
    return config.scene.route


def test_fitting_scene_for_same_or_longer_robot_is_unchanged() -> None:
    as_it_is = clutter().scene
    for joints in (8, 13, 30):
        scene = clutter(f"robot.chain.modules={joints}").scene
        assert scene.route == as_it_is.route
        assert scene.pegs_along_route == as_it_is.pegs_along_route
        assert scene.reference_robot == as_it_is.reference_robot


def test_fitting_scene_for_other_joints_and_radius_scales_it() -> None:
    before, config = clutter(), clutter("robot=mamba")
    share = 0.2 / 0.11  # its yaw joints are every second one
    assert compute_joint_spacing_m(config.robot) == pytest.approx(0.2)
    for name in ("amplitude_m", "wavelength_m", "length_m"):
        assert getattr(sine(config), name) == pytest.approx(share * getattr(sine(before), name))
    (row,), (field,) = config.scene.pegs_along_route, config.scene.random_field
    assert row.corridor_m == pytest.approx(0.035 + share * 0.005)
    beyond_m = before.scene.random_field[0].min_corner_m[0] - sine(before).length_m
    assert field.min_corner_m == pytest.approx((sine(config).length_m + beyond_m, -1.0))
    assert field.max_corner_m[0] - field.min_corner_m[0] == pytest.approx(4.6)
    assert field.clearance_m == pytest.approx(0.11)
    assert len(place_obstacles(config)) > 40  # and it lies clear of them


def test_fitting_keeps_values_set_by_flags_and_marks_others() -> None:
    loaded = load_scenario(
        "surveyed_clutter",
        [parse_set_option("robot=mamba"), parse_set_option("scene.route.wavelength_m=0.7")],
    )
    assert sine(loaded.config).wavelength_m == 0.7
    origin = {key: source for key, _, source in loaded.list_effective_values()}
    assert origin["scene.route.wavelength_m"] == "--set scene.route.wavelength_m=0.7"
    assert origin["scene.route.amplitude_m"] == "fitted to robot 'mamba'"
    assert "clutter.toml" in origin["scene.ground.friction"]


def test_fitting_an_already_fitted_scene_changes_nothing(tmp_path: Path) -> None:
    config = clutter("robot=mamba")
    write_config(config, tmp_path / "run.json")
    assert load_scenario(str(tmp_path / "run.json")).config == config
