"""A scenario combines files and options to one effective configuration, with the origin of each value."""

import itertools
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.host.participants import LockstepParticipants
from snakesim_hal.model.fault_plan import parse_and_validate_planned_faults
from snakesim_hal.model.files import list_shipped_names
from snakesim_hal.model.geometry.kinematics import (
    compute_link_frames,
    quaternion_from_yaw,
    rotation_from_quaternion,
)
from snakesim_hal.model.geometry.outlines import ObstacleOutlines
from snakesim_hal.model.scenario import (
    KeyOverride,
    LoadedScenario,
    ServiceSchedule,
    WaypointGoal,
    compute_config_hash,
    compute_start_pose,
    get_noisy_obstacle_map,
    load_scenario,
    make_start_capsules,
    parse_set_option,
    place_obstacles,
    read_config,
    write_config,
)
from snakesim_hal.model.scene_file.scene import make_route
from snakesim_testing.hal.small_robots import (
    ROBOT_TOML,
    SCENARIO_TOML,
    SCENE_TOML,
    make_run_config,
    write_scenario_files,
)
from snakesim_testing.messages import raises_error


def load_with_options(path: str, *flags: str) -> LoadedScenario:
    """Load a scenario with `--set` options."""
    return load_scenario(path, [parse_set_option(flag) for flag in flags])


# --- valid scenarios -------------------------------------------------------------------------------------------


def test_scenario_combines_its_files(tmp_path: Path) -> None:
    config = load_scenario(write_scenario_files(tmp_path)).config
    assert config.name == "crawl"
    assert config.robot.name == "worm"
    assert config.scene.name == "bend"
    assert config.services == {
        "control": ServiceSchedule(),
        "guidance": ServiceSchedule(decimation=2),
    }
    assert config.robot.sensors.pose is not None
    assert config.robot.sensors.contacts is None
    assert config.clock_mode == "lockstep"
    assert config.seed == 1
    assert config.start.tail_s_m == 0.1
    assert config.period_ns == 10_000_000


def test_scenario_option_changes_field_or_goal() -> None:
    first = load_with_options("clutter")
    changed = load_with_options("clutter", "scene.random_field.0.seed=7")
    assert place_obstacles(first.config) != place_obstacles(changed.config)
    points = load_with_options(
        "clutter", 'mission.goal={kind="waypoints", points_m=[[3, 0], [5, 0.5]]}'
    )
    assert points.config.mission.goal == WaypointGoal(points_m=[(3.0, 0.0), (5.0, 0.5)])
    with raises_error(ConfigError, code="config/invalid-value"):
        load_with_options("clutter", "mission.map=guessed")


def test_scenario_survey_error_is_the_same_for_all_services() -> None:
    exact = load_with_options("surveyed_clutter", "mission.map_error_m=0.0").config
    noisy = load_with_options("surveyed_clutter", "mission.map_error_m=0.005").config
    truth = np.array([placed.obstacle.position_w for placed in place_obstacles(noisy)])
    assert np.array_equal([known.position_w for known in get_noisy_obstacle_map(exact)], truth)
    errors_m = np.array([known.position_w for known in get_noisy_obstacle_map(noisy)]) - truth
    assert 0.003 < errors_m[:, :2].std() < 0.007
    assert not errors_m[:, 2].any()
    assert get_noisy_obstacle_map(noisy) == get_noisy_obstacle_map(noisy)
    with raises_error(ConfigError, code="config/invalid-value"):
        load_with_options("clutter", "mission.map_error_m=0.005")


def test_scenario_parts_beside_it_or_shipped_are_named_by_flags(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    path = write_scenario_files(
        tmp_path, scenario=SCENARIO_TOML.replace('"worm.toml"', '"planar13"')
    )
    assert load_scenario(path).config.robot.name == "planar13"
    other_robot = tmp_path / "elsewhere" / "other.toml"
    other_robot.write_text(ROBOT_TOML.replace('"worm"', '"other"'))
    flag = KeyOverride("robot", str(other_robot), f"--set robot={other_robot}")
    loaded = load_scenario(path, [flag])
    assert loaded.config.robot.name == "other"
    assert loaded.table.find_origin("robot.name") == str(other_robot)


@pytest.mark.parametrize("name", list_shipped_names("scenarios"))
def test_shipped_scenario_equals_that_of_its_effective_configuration(
    name: str, tmp_path: Path
) -> None:
    config = load_scenario(name).config
    write_config(config, tmp_path / "config.json")
    assert read_config(tmp_path / "config.json") == config
    reloaded = load_scenario(str(tmp_path / "config.json")).config
    assert reloaded == config
    assert compute_config_hash(reloaded) == compute_config_hash(config)


def test_effective_configuration_keeps_options_and_accepts_new_ones(tmp_path: Path) -> None:
    first = load_with_options(
        write_scenario_files(tmp_path), "robot.limits.torque_nm=2.5", "control.gain=3", "seed=9"
    ).config
    write_config(first, tmp_path / "config.json")
    assert read_config(tmp_path / "config.json") == first
    reloaded = load_with_options(str(tmp_path / "config.json"), "seed=10")
    assert reloaded.config == msgspec.structs.replace(first, seed=10)
    assert reloaded.table.find_origin("seed") == "--set seed=10"
    assert reloaded.table.find_origin("robot.limits.torque_nm") == str(tmp_path / "config.json")


@pytest.mark.parametrize(
    ("change", "is_same"),
    [
        ({}, True),
        ({"seed": 2}, False),
        ({"robot__limits__torque_nm": 3.0}, False),
        ({"rate_hz": 50.0}, False),
    ],
)
def test_config_hash_depends_on_every_value(change: dict[str, Any], is_same: bool) -> None:
    assert (
        compute_config_hash(make_run_config(**change)) == compute_config_hash(make_run_config())
    ) == is_same
    assert 1 <= len(compute_config_hash(make_run_config())) <= 64


def test_scenario_external_service_is_awaited_but_not_started() -> None:
    internal = load_with_options("triplet").config
    external = load_with_options("triplet", "services.control.external=true").config
    assert internal.has_internal_control
    assert internal.commander_name == "obstacle_triplet"
    assert "control" in internal.internal_services
    assert not external.has_internal_control
    assert external.commander_name == "external"
    policies = [
        load_with_options("triplet", f"controller=policy:{model}").config
        for model in ("clutter", "./mine.onnx")
    ]
    assert [policy.commander_name for policy in policies] == [
        "policy:clutter",
        "policy:./mine.onnx",
    ]
    assert set(external.services) - set(external.internal_services) == {"control"}
    assert list(LockstepParticipants(external.services)) == list(internal.services)
    for text in ("kill:control@1", "hang:control@1", "drop:actuator/joints@1"):
        parse_and_validate_planned_faults(load_with_options("triplet", f'faults=["{text}"]').config)
        with raises_error(ConfigError, code="injection/unknown-target", field="faults[0]"):
            parse_and_validate_planned_faults(
                load_with_options(
                    "triplet", f'faults=["{text}"]', "services.control.external=true"
                ).config
            )


@given(rate_hz=st.floats(20, 5000))
def test_scenario_lease_is_five_periods_between_50_and_100_ms(rate_hz: float) -> None:
    config = make_run_config(rate_hz=rate_hz)
    assert 50_000_000 <= config.lease_ns <= 100_000_000
    if 50_000_000 < config.lease_ns < 100_000_000:
        assert config.lease_ns == 5 * config.period_ns


@given(
    tick=st.integers(0, 10_000),
    decimation=st.integers(1, 50),
    latency_ticks=st.integers(1, 50),
)
def test_scenario_samples_at_a_tick_are_due_and_aged(
    tick: int, decimation: int, latency_ticks: int
) -> None:
    service = ServiceSchedule(decimation=decimation, latency_ticks=latency_ticks)
    output_tick = service.used_output_tick(tick)
    assert output_tick % decimation == 0
    assert output_tick >= 0
    assert output_tick == 0 or output_tick <= tick - latency_ticks
    assert tick - latency_ticks - output_tick < decimation  # no newer output may be used
    assert service.used_output_tick(tick + 1) >= output_tick


# --- options and origins of values -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "key", "value"),
    [
        ("seed=3", "seed", 3),
        (" rate_hz = 50.5", "rate_hz", 50.5),
        ("start.on_route=false", "start.on_route", False),
        ("start.position_m=[1.0, 2.0]", "start.position_m", [1.0, 2.0]),
        ("clock_mode=free", "clock_mode", "free"),
        ('clock_mode="free"', "clock_mode", "free"),
        ("controller=./wave.py:Wave", "controller", "./wave.py:Wave"),
        ("title=a = b", "title", "a = b"),
        ("title=", "title", ""),
        ("services={control = {}}", "services", {"control": {}}),
    ],
)
def test_set_option_value_is_toml_or_text(text: str, key: str, value: Any) -> None:
    assert parse_set_option(text) == KeyOverride(key, value, f"--set {text}")


@pytest.mark.parametrize("text", ["", "seed", "=3", " = 3"])
def test_set_option_without_key_or_value_is_refused(text: str) -> None:
    with raises_error(ConfigError, code="command/invalid-option", field="section.key"):
        parse_set_option(text)


def test_scenario_lists_every_value_with_its_origin(tmp_path: Path) -> None:
    loaded = load_with_options(
        write_scenario_files(tmp_path),
        "robot.limits.torque_nm=2.0",
        "start.tail_s_m=0.2",
        "control.gain=1",
    )
    reported = {key: (value, origin) for key, value, origin in loaded.list_effective_values()}
    assert reported["robot.limits.torque_nm"] == (2.0, "--set robot.limits.torque_nm=2.0")
    assert reported["start.tail_s_m"] == (0.2, "--set start.tail_s_m=0.2")
    assert reported["controllers.hold.gain"] == (1, "--set control.gain=1")
    assert reported["robot.limits.speed_rad_s"] == (5.0, str(tmp_path / "worm.toml"))
    assert reported["robot.sensors.pose.rate_hz"] == (50.0, str(tmp_path / "worm.toml"))
    assert reported["scene.cylinder.1.position_m"] == ((1.5, 1.0), str(tmp_path / "bend.toml"))
    assert reported["rate_hz"] == (100.0, str(tmp_path / "crawl.toml"))
    assert reported["services.guidance.decimation"] == (2, str(tmp_path / "crawl.toml"))
    for key in (
        "seed",
        "robot.motor.friction_nm",
        "services.control.decimation",
        "scene.cylinder.0.friction",
        "clock_mode",
    ):
        assert reported[key][1] == "default", key
    assert set(reported) == {key for key, _ in list_leaves(msgspec.to_builtins(loaded.config))}


def list_leaves(value: Any, prefix: str = "") -> list[tuple[str, Any]]:
    """Return the dotted keys and the values of all leaves."""
    if isinstance(value, dict) and value:
        return [
            leaf
            for key, child in value.items()
            for leaf in list_leaves(child, f"{prefix}.{key}".lstrip("."))
        ]
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return [
            leaf for i, child in enumerate(value) for leaf in list_leaves(child, f"{prefix}.{i}")
        ]
    return [(prefix, value)]


def test_scenario_control_alias_means_chosen_controller_in_any_order(tmp_path: Path) -> None:
    path = write_scenario_files(tmp_path)
    assert load_with_options(path, "control.gain=3").config.controllers == {"hold": {"gain": 3}}
    for flags in (
        ["control.gain=3", "controller=./w.py:Wave"],
        ["controller=./w.py:Wave", "control.gain=3"],
    ):
        config = load_with_options(path, *flags).config
        assert config.controllers == {"hold": {}, "Wave": {"gain": 3}}
        assert config.controller_parameters == {"gain": 3}
        assert config.control_section == "controllers.Wave"
    assert load_with_options(path, "backend.step=1").config.backends == {"sim": {"step": 1}}
    assert load_with_options(path, "backend=emulator", "backend.step=1").config.backends == {
        "emulator": {"step": 1}
    }


# --- invalid scenarios -----------------------------------------------------------------------------------------

INVALID_FILES = {
    "scenario type": ("crawl.toml", "rate_hz = 100", 'rate_hz = "100"'),
    "scenario missing": ("crawl.toml", 'controller = "hold"\n', ""),
    "not TOML": ("crawl.toml", "rate_hz = 100", "rate_hz = "),
    "robot range": ("worm.toml", "mass_kg = 0.2", "mass_kg = 200.0"),
    "robot missing": ("worm.toml", "torque_nm = 4.0\n", ""),
    "robot empty": ("worm.toml", ROBOT_TOML, ""),
    "scene list": ("bend.toml", "radius_m = 0.05\n[[", "radius_m = 0\n[["),
}


@pytest.mark.parametrize("case", INVALID_FILES)
def test_scenario_with_invalid_file_is_refused_by_file_name(case: str, tmp_path: Path) -> None:
    name, old, new = INVALID_FILES[case]
    path = write_scenario_files(tmp_path)
    text = (tmp_path / name).read_text()
    assert old in text
    (tmp_path / name).write_text(text.replace(old, new, 1))
    with raises_error(
        ConfigError,
        code=(
            "config/invalid-value",
            "config/missing-key",
            "config/out-of-range",
            "file/invalid-syntax",
        ),
    ) as refusal:
        load_scenario(path)
    message = str(refusal.value)
    # An empty file has no other value that names the file of a missing key.
    if case != "robot empty":
        assert message.startswith(f"{tmp_path / name}: "), message
    assert "\n" not in message


def test_scenario_with_missing_file_is_refused_by_file_name(tmp_path: Path) -> None:
    path = write_scenario_files(tmp_path)
    with raises_error(ConfigError, code="config/unknown-name", field="nowhere"):
        load_scenario("nowhere")
    with raises_error(ConfigError, code="file/not-found", field="none.toml"):
        load_scenario(str(tmp_path / "none.toml"))
    (tmp_path / "worm.toml").unlink()
    with raises_error(ConfigError, code="file/not-found", field="worm.toml"):
        load_scenario(path)
    with raises_error(ConfigError, code="config/unknown-name", field="wurm"):
        load_with_options(path, "robot=wurm")


INVALID_SCENES = {
    "overlap": ("position_m = [1.0, 1.0]", "position_m = [0.2, 0.0]"),
    "no route": ('[route]\nkind = "sine"\namplitude_m = 0.05\nwavelength_m = 0.8\nlength_m = 2.0\n', ""),
    "too sharp": ("wavelength_m = 0.8", "wavelength_m = 0.1"),
}  # fmt: skip


@pytest.mark.parametrize("case", INVALID_SCENES)
def test_scenario_scene_that_does_not_fit_robot_is_refused(case: str, tmp_path: Path) -> None:
    old, new = INVALID_SCENES[case]
    assert old in SCENE_TOML
    with raises_error(ConfigError, code=("config/out-of-range", "scene/no-route", "scene/overlap")):
        load_scenario(write_scenario_files(tmp_path, scene=SCENE_TOML.replace(old, new)))


# --- the start -------------------------------------------------------------------------------------------------


def test_start_pose_has_every_joint_on_the_route(tmp_path: Path) -> None:
    config = load_scenario(write_scenario_files(tmp_path)).config
    route = make_route(config.scene)
    assert route is not None
    pose = compute_start_pose(config)
    assert pose.position_w == pytest.approx(route.compute_point(0.1))
    rotation = rotation_from_quaternion(quaternion_from_yaw(pose.yaw_rad))
    lengths = config.robot.link_lengths_m
    origins, _ = compute_link_frames(
        (*pose.position_w, 0.0), rotation, pose.angles_rad, config.robot.axes, lengths
    )
    for origin in origins:
        assert (
            np.hypot(*(route.compute_positions_w(route.project_point(origin[:2])) - origin[:2]))
            < 1e-5
        )


def test_start_pose_with_pitch_joints_is_flat_on_route(tmp_path: Path) -> None:
    mixed = ROBOT_TOML.replace('axes = ["yaw"]', 'axes = ["pitch", "yaw"]').replace(
        "modules = 3", "modules = 6"
    )
    pose = compute_start_pose(load_scenario(write_scenario_files(tmp_path, robot=mixed)).config)
    assert pose.angles_rad[0::2].tolist() == [0.0, 0.0, 0.0]
    assert np.abs(pose.angles_rad[1::2]).min() > 0


def test_start_pose_off_the_route_is_straight() -> None:
    config = make_run_config(start={"on_route": False, "position_m": [1.0, 2.0], "yaw_rad": 0.5})
    pose = compute_start_pose(config)
    assert pose.position_w == (1.0, 2.0)
    assert pose.yaw_rad == 0.5
    assert not pose.angles_rad.any()
    capsules = make_start_capsules(config)
    assert len(capsules) == 4
    assert capsules[0].rear_m == (1.0, 2.0)
    assert capsules[-1].front_m == pytest.approx((1.0 + 0.3 * np.cos(0.5), 2.0 + 0.3 * np.sin(0.5)))
    assert all(
        rear_link.front_m == pytest.approx(front_link.rear_m)
        for rear_link, front_link in itertools.pairwise(capsules)
    )


def test_random_fields_keep_clearance_to_the_start_pose() -> None:
    field = {
        "seed": 1,
        "min_corner_m": [-0.3, -0.3],
        "max_corner_m": [0.7, 0.3],
        "density_per_m2": 30.0,
    }
    field |= {"radius_m": [0.02, 0.03], "clearance_m": 0.01}
    config = make_run_config(scene__random_field=[field])
    placed = place_obstacles(config)
    assert len(placed) == 18
    snake = make_start_capsules(config)
    rears_m = np.array([link.rear_m for link in snake])
    fronts_m = np.array([link.front_m for link in snake])
    links = ObstacleOutlines.from_segments(rears_m, fronts_m, snake[0].radius_m)
    for item in placed:
        assert (
            links.compute_distances_m(np.array(item.obstacle.position_w[:2])).min()
            - item.obstacle.radius_m
            >= 0.01 - 1e-9
        )
