"""Tests the age limits of the inputs of control: their defaults, those of a scenario, and the texts of refusals."""

from typing import Any

import msgspec
import pytest

from snakesim_gnc.control.service.freshness import AgeLimits
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire.messages import RobotDescription, SensorDescription, Trajectory, WorldModel
from snakesim_testing.gnc.stage import make_world
from snakesim_testing.hal.small_robots import make_description, make_joint_state, make_run_config

SCHEDULE = {
    "control": {"latency_ticks": 2},
    "guidance": {"decimation": 2, "latency_ticks": 2},
    "navigation": {"decimation": 20, "latency_ticks": 20},
}
SECOND_NS = 10**9
NOW_NS = 100 * SECOND_NS


def make_robot_with_sensors(**rates_hz: float) -> RobotDescription:
    """Return a robot with sensors of these names and rates, each with a delay of 0.05 s."""
    sensors = [
        SensorDescription(key=f"sensor/{name}", rate_hz=rate_hz, delay_s=0.05)
        for name, rate_hz in rates_hz.items()
    ]
    return msgspec.structs.replace(make_description(), sensors=sensors)


def make_limits(config: RunConfig | None = None, **rates_hz: float) -> AgeLimits:
    """Return the age limits of a run, by default with SCHEDULE, of a robot with sensors of these rates."""
    return AgeLimits.from_config(
        config or make_run_config(services=SCHEDULE), make_robot_with_sensors(**rates_hz)
    )


def make_fresh_world(**changes: Any) -> WorldModel:
    """Return a world model that is made now from inputs that are measured now, with changes."""
    fresh = {
        "tick": 9_990,
        "timestamp_ns": NOW_NS,
        "pose_timestamp_ns": NOW_NS,
        "contacts_timestamp_ns": NOW_NS,
    }
    return make_world(**(fresh | changes))


def make_trajectory(timestamp_ns: int | None) -> Trajectory:
    return Trajectory(
        tick=0,
        timestamp_ns=timestamp_ns,
        path_id=0,
        path_w=[(0.0, 0.0), (1.0, 0.0)],
        speed_m_s=0.1,
        push_points=[],
        finished=False,
    )


def test_age_limits_follow_from_rates_delays_and_schedules() -> None:
    limits = make_limits(joints=100.0, pose=100.0, contacts=10.0)
    # 30 ms and the delay of 50 ms, but no more than a lease.
    assert limits.joints_s == pytest.approx(0.05)
    assert limits.world_s == pytest.approx(0.02 + 0.2)
    assert limits.sensors_s == pytest.approx(
        {"sensor/pose": 0.05 + 0.04 + 0.2, "sensor/contacts": 0.05 + 0.04 + 0.3}
    )
    assert limits.trajectory_s == pytest.approx(0.04 + 0.2 + 3 * 0.2)
    assert make_limits().joints_s == pytest.approx(0.03)
    assert make_limits().sensors_s == {}
    # A sensor service has the schedule of the scenario.
    config = make_run_config(
        services={**SCHEDULE, "sensor": {"decimation": 10, "latency_ticks": 3}}
    )
    assert make_limits(config).sensors_s == pytest.approx({"sensor/pose": 0.04 + 0.03 + 0.3})


def test_age_limits_without_guidance_or_navigation_follow_from_the_period() -> None:
    limits = make_limits(make_run_config())
    assert limits.world_s == pytest.approx(0.01 + 0.2)
    assert limits.trajectory_s == pytest.approx(0.03 + 0.2)


def test_freshness_limits_may_be_set_by_scenario() -> None:
    max_age = {
        "joints_s": 0.04,
        "pose_s": 0.5,
        "contacts_s": 5.0,
        "world_s": 0.1,
        "trajectory_s": 2.0,
    }
    config = make_run_config(services=SCHEDULE, max_age=max_age)
    limits = make_limits(config, pose=100.0, contacts=10.0)
    assert limits.joints_s == 0.04
    assert limits.world_s == 0.1
    assert limits.trajectory_s == 2.0
    assert limits.sensors_s == {"sensor/pose": 0.5, "sensor/contacts": 5.0}


@pytest.mark.parametrize(
    "max_age",
    [{"pose_s": 0.0}, {"pose_s": -1.0}, {"world_s": 61.0}, {"depth_s": 0.0}, {"imu_s": 1.0}],
)
def test_freshness_invalid_scenario_limits_are_refused(max_age: dict[str, float]) -> None:
    with pytest.raises(msgspec.ValidationError):
        make_run_config(max_age=max_age)


@pytest.mark.parametrize(
    ("timestamps", "expected_reason"),
    [
        ({}, ""),
        ({"pose_timestamp_ns": NOW_NS - 310_000_000}, "sensor/pose is 0.31 s old, at most 0.29 s"),
        ({"pose_timestamp_ns": NOW_NS - 290_000_000}, ""),
        (
            {"contacts_timestamp_ns": NOW_NS - SECOND_NS},
            "sensor/contacts is 1 s old, at most 0.29 s",
        ),
        (
            {"pose_timestamp_ns": 0, "contacts_timestamp_ns": NOW_NS - SECOND_NS},
            "sensor/pose is 100 s old, at most 0.29 s; sensor/contacts is 1 s old, at most 0.29 s",
        ),
        ({"contacts_timestamp_ns": None}, "guidance/world was made without sensor/contacts"),
        (
            {"timestamp_ns": NOW_NS - SECOND_NS, "pose_timestamp_ns": NOW_NS - SECOND_NS},
            "guidance/world is 1 s old, at most 0.22 s",
        ),
        (
            {"timestamp_ns": NOW_NS + SECOND_NS},
            "guidance/world is stamped 1 s ahead of the robot's clock",
        ),
        (
            {"pose_timestamp_ns": 2**62},
            "sensor/pose is stamped 4.61e+09 s ahead of the robot's clock",
        ),
    ],
)
def test_freshness_of_world_model_is_that_of_its_inputs(
    timestamps: dict[str, Any], expected_reason: str
) -> None:
    limits = make_limits(pose=100.0, contacts=100.0)
    assert limits.check_world(make_fresh_world(**timestamps), NOW_NS) == expected_reason


def test_freshness_of_perceived_map_is_that_of_its_image() -> None:
    config = make_run_config(services=SCHEDULE, mission={"map": "perceived"})
    sensors = [
        SensorDescription(key=f"sensor/{name}", rate_hz=20.0, delay_s=0.03)
        for name in ("depth/a", "range/b")
    ]
    robot = msgspec.structs.replace(make_description(), sensors=sensors)
    perceived = AgeLimits.from_config(config, robot)
    fresh_world = make_fresh_world(depth_timestamp_ns=NOW_NS - 270_000_000)
    assert perceived.check_world(fresh_world, NOW_NS) == ""
    old_world = make_fresh_world(depth_timestamp_ns=NOW_NS - 400_000_000)
    assert (
        perceived.check_world(old_world, NOW_NS)
        == "sensor/depth or sensor/range is 0.4 s old, at most 0.27 s"
    )
    assert "was made without sensor/depth" in perceived.check_world(make_fresh_world(), NOW_NS)
    # A surveyed map comes from the scene file, and does not age.
    surveyed = AgeLimits.from_config(make_run_config(services=SCHEDULE), robot)
    assert surveyed.check_world(make_fresh_world(), NOW_NS) == ""


def test_freshness_of_a_missing_sensor_is_not_checked() -> None:
    world = make_fresh_world(pose_timestamp_ns=None, contacts_timestamp_ns=None)
    assert make_limits().check_world(world, NOW_NS) == ""


def test_freshness_of_joints_and_trajectory_has_its_own_limits() -> None:
    limits = make_limits()
    joints = make_joint_state(make_robot_with_sensors(), timestamp_ns=NOW_NS)
    assert limits.check_joints(joints, NOW_NS + 30_000_000) == ""
    assert (
        limits.check_joints(joints, NOW_NS + 31_000_000)
        == "sensor/joints is 0.031 s old, at most 0.03 s"
    )
    # A joint state may arrive before the clock of its tick.
    assert limits.check_joints(joints, NOW_NS - 10_000_000) == ""
    assert limits.check_trajectory(make_trajectory(NOW_NS - 800_000_000), NOW_NS) == ""
    assert "navigation/trajectory is 0.9 s old" in limits.check_trajectory(
        make_trajectory(NOW_NS - 900_000_000), NOW_NS
    )
    assert (
        limits.check_trajectory(make_trajectory(None), NOW_NS)
        == "navigation/trajectory was planned without a world model"
    )
