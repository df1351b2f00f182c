"""How old what control acts on may be: the defaults, what a scenario says, and what is refused with which words."""

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
SECOND = 10**9
NOW = 100 * SECOND


def robot(**rates: float) -> RobotDescription:
    """With sensors of these rates in Hz, each with a delay of 0.05 s."""
    sensors = [
        SensorDescription(key=f"sensor/{name}", rate_hz=rate, delay_s=0.05)
        for name, rate in rates.items()
    ]
    return msgspec.structs.replace(make_description(), sensors=sensors)


def limits(config: RunConfig | None = None, **rates: float) -> AgeLimits:
    return AgeLimits.from_config(config or make_run_config(services=SCHEDULE), robot(**rates))


def world(**changes: Any) -> WorldModel:
    return make_world(
        **(
            {
                "tick": 9_990,
                "timestamp_ns": NOW,
                "pose_timestamp_ns": NOW,
                "contacts_timestamp_ns": NOW,
            }
            | changes
        )
    )


def trajectory(timestamp_ns: int | None) -> Trajectory:
    path = [(0.0, 0.0), (1.0, 0.0)]
    return Trajectory(
        tick=0,
        timestamp_ns=timestamp_ns,
        path_id=0,
        path_w=path,
        speed_m_s=0.1,
        push_points=[],
        finished=False,
    )


def test_the_limits_follow_from_rates_delays_and_schedules() -> None:
    found = limits(joints=100.0, pose=100.0, contacts=10.0)
    # 30 ms and the delay of 50 ms, but no more than a lease.
    assert found.joints_s == pytest.approx(0.05)
    assert found.world_s == pytest.approx(0.02 + 0.2)
    assert found.sensors_s == pytest.approx(
        {"sensor/pose": 0.05 + 0.04 + 0.2, "sensor/contacts": 0.05 + 0.04 + 0.3}
    )
    assert found.trajectory_s == pytest.approx(0.04 + 0.2 + 3 * 0.2)
    assert limits().joints_s == pytest.approx(0.03)
    assert limits().sensors_s == {}
    tracked = make_run_config(
        services={**SCHEDULE, "sensor": {"decimation": 10, "latency_ticks": 3}}
    )
    # By a service's schedule.
    assert limits(tracked).sensors_s == pytest.approx({"sensor/pose": 0.04 + 0.03 + 0.3})


def test_a_run_without_guidance_or_navigation_has_limits_too() -> None:
    found = limits(make_run_config())
    assert found.world_s == pytest.approx(0.01 + 0.2)
    assert found.trajectory_s == pytest.approx(0.03 + 0.2)


def test_freshness_limits_may_be_set_by_scenario() -> None:
    said = {"joints_s": 0.04, "pose_s": 0.5, "contacts_s": 5.0, "world_s": 0.1, "trajectory_s": 2.0}
    found = limits(make_run_config(services=SCHEDULE, max_age=said), pose=100.0, contacts=10.0)
    assert found.joints_s == 0.04
    assert found.world_s == 0.1
    assert found.trajectory_s == 2.0
    assert found.sensors_s == {"sensor/pose": 0.5, "sensor/contacts": 5.0}


@pytest.mark.parametrize(
    "wrong",
    [{"pose_s": 0.0}, {"pose_s": -1.0}, {"world_s": 61.0}, {"depth_s": 0.0}, {"imu_s": 1.0}],
)
def test_freshness_invalid_scenario_limits_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(msgspec.ValidationError):
        make_run_config(max_age=wrong)


@pytest.mark.parametrize(
    ("made", "words"),
    [
        ({}, ""),
        ({"pose_timestamp_ns": NOW - 310_000_000}, "sensor/pose is 0.31 s old, at most 0.29 s"),
        ({"pose_timestamp_ns": NOW - 290_000_000}, ""),
        ({"contacts_timestamp_ns": NOW - SECOND}, "sensor/contacts is 1 s old, at most 0.29 s"),
        (
            {"pose_timestamp_ns": 0, "contacts_timestamp_ns": NOW - SECOND},
            "sensor/pose is 100 s old, at most 0.29 s; sensor/contacts is 1 s old, at most 0.29 s",
        ),
        ({"contacts_timestamp_ns": None}, "guidance/world was made without sensor/contacts"),
        (
            {"timestamp_ns": NOW - SECOND, "pose_timestamp_ns": NOW - SECOND},
            "guidance/world is 1 s old, at most 0.22 s",
        ),
        (
            {"timestamp_ns": NOW + SECOND},
            "guidance/world is stamped 1 s ahead of the robot's clock",
        ),
        (
            {"pose_timestamp_ns": 2**62},
            "sensor/pose is stamped 4.61e+09 s ahead of the robot's clock",
        ),
    ],
)
def test_freshness_of_world_model_is_that_of_its_inputs(made: dict[str, Any], words: str) -> None:
    assert limits(pose=100.0, contacts=100.0).check_world(world(**made), NOW) == words


def test_a_perceived_map_is_as_old_as_its_newest_image() -> None:
    config = make_run_config(services=SCHEDULE, mission={"map": "perceived"})
    sensors = [
        SensorDescription(key=f"sensor/{name}", rate_hz=20.0, delay_s=0.03)
        for name in ("depth/a", "range/b")
    ]
    seeing = msgspec.structs.replace(make_description(), sensors=sensors)
    found, known = (
        AgeLimits.from_config(config, seeing),
        AgeLimits.from_config(make_run_config(services=SCHEDULE), seeing),
    )
    assert found.check_world(world(depth_timestamp_ns=NOW - 270_000_000), NOW) == ""
    old = found.check_world(world(depth_timestamp_ns=NOW - 400_000_000), NOW)
    assert old == "sensor/depth or sensor/range is 0.4 s old, at most 0.27 s"
    assert "was made without sensor/depth" in found.check_world(world(), NOW)
    assert known.check_world(world(), NOW) == ""  # of the scene's file, which does not age


def test_a_sensor_that_the_robot_lacks_cannot_be_stale() -> None:
    bare = world(pose_timestamp_ns=None, contacts_timestamp_ns=None)
    assert limits().check_world(bare, NOW) == ""


def test_joints_and_trajectory_have_their_own_limits() -> None:
    found, joints = limits(), make_joint_state(robot(), timestamp_ns=NOW)
    assert found.check_joints(joints, NOW + 30_000_000) == ""
    assert (
        found.check_joints(joints, NOW + 31_000_000)
        == "sensor/joints is 0.031 s old, at most 0.03 s"
    )
    assert found.check_joints(joints, NOW - 10_000_000) == ""  # it came before its tick's clock
    assert found.check_trajectory(trajectory(NOW - 800_000_000), NOW) == ""
    assert "navigation/trajectory is 0.9 s old" in found.check_trajectory(
        trajectory(NOW - 900_000_000), NOW
    )
    assert (
        found.check_trajectory(trajectory(None), NOW)
        == "navigation/trajectory was planned without a world model"
    )
