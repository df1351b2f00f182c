"""A scene for one robot is fitted to another robot, and values that a user sets are kept."""

from pathlib import Path

import pytest

from snakesim_hal.model.scenario import (
    RunConfig,
    load_scenario,
    parse_set_option,
    place_obstacles,
    write_config,
)
from snakesim_hal.model.scene_file.fitting import compute_joint_spacing_m
from snakesim_hal.model.scene_file.scene import SineRoute


def load_clutter(*options: str) -> RunConfig:
    return load_scenario("surveyed_clutter", [parse_set_option(text) for text in options]).config


def get_sine_route(config: RunConfig) -> SineRoute:
    assert isinstance(config.scene.route, SineRoute)
    return config.scene.route


def test_fitting_scene_for_same_or_longer_robot_is_unchanged() -> None:
    original_scene = load_clutter().scene
    for joints in (8, 13, 30):
        scene = load_clutter(f"robot.chain.modules={joints}").scene
        assert scene.route == original_scene.route
        assert scene.pegs_along_route == original_scene.pegs_along_route
        assert scene.reference_robot == original_scene.reference_robot


def test_fitting_scene_for_other_joints_and_radius_scales_it() -> None:
    original = load_clutter()
    config = load_clutter("robot=mamba")
    scale = 0.2 / 0.11  # every second joint of this robot is a yaw joint
    assert compute_joint_spacing_m(config.robot) == pytest.approx(0.2)
    for name in ("amplitude_m", "wavelength_m", "length_m"):
        assert getattr(get_sine_route(config), name) == pytest.approx(
            scale * getattr(get_sine_route(original), name)
        )
    (row,) = config.scene.pegs_along_route
    (field,) = config.scene.random_field
    assert row.corridor_m == pytest.approx(0.035 + scale * 0.005)
    beyond_m = original.scene.random_field[0].min_corner_m[0] - get_sine_route(original).length_m
    assert field.min_corner_m == pytest.approx((get_sine_route(config).length_m + beyond_m, -1.0))
    assert field.max_corner_m[0] - field.min_corner_m[0] == pytest.approx(4.6)
    assert field.clearance_m == pytest.approx(0.11)
    assert len(place_obstacles(config)) > 40  # the robot does not touch them


def test_fitting_keeps_values_set_by_flags_and_marks_others() -> None:
    loaded = load_scenario(
        "surveyed_clutter",
        [parse_set_option("robot=mamba"), parse_set_option("scene.route.wavelength_m=0.7")],
    )
    assert get_sine_route(loaded.config).wavelength_m == 0.7
    origin = {key: source for key, _, source in loaded.list_effective_values()}
    assert origin["scene.route.wavelength_m"] == "--set scene.route.wavelength_m=0.7"
    assert origin["scene.route.amplitude_m"] == "fitted to robot 'mamba'"
    assert "clutter.toml" in origin["scene.ground.friction"]


def test_fitting_an_already_fitted_scene_changes_nothing(tmp_path: Path) -> None:
    config = load_clutter("robot=mamba")
    write_config(config, tmp_path / "run.json")
    assert load_scenario(str(tmp_path / "run.json")).config == config
