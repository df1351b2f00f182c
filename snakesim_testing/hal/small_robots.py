"""Makes small robots, messages, configurations and files for tests."""

import copy
import tomllib
from pathlib import Path
from typing import Any

import msgspec

from snakesim_hal.model.robot_file.robot import RobotFile, describe_robot
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire.messages import (
    Clock,
    Contact,
    JointCommand,
    JointMode,
    JointState,
    Pose,
    Power,
    RobotDescription,
    RobotStatus,
)

PERIOD_NS = 10_000_000
LEASE_NS = 50_000_000

ROBOT_TOML = """\
name = "worm"
[chain]
modules = 3
axes = ["yaw"]
[module]
length_m = 0.1
radius_m = 0.03
mass_kg = 0.2
[limits]
angle_rad = 1.5
speed_rad_s = 5.0
acceleration_rad_s2 = 100.0
torque_nm = 4.0
torque_rate_nm_s = 80.0
[motor]
stiffness_nm_per_rad = 40.0
damping_nm_s_per_rad = 1.0
velocity_gain_nm_s_per_rad = 1.0
response_time_s = 0.01
armature_kg_m2 = 0.005
[sensors.pose]
rate_hz = 50.0
"""
ROBOT: dict[str, Any] = {
    **tomllib.loads(ROBOT_TOML),
    "safety": {"action": "damp", "max_step_rad": 0.3},
}
del ROBOT["sensors"]
SCENE: dict[str, Any] = {"name": "plain", "ground": {"friction": 0.1}}
RUN: dict[str, Any] = {
    "name": "crawl",
    "robot": ROBOT,
    "scene": SCENE,
    "backend": "lag",
    "controller": "hold",
    "clock_mode": "lockstep",
    "services": {"control": {}},
    "start": {"on_route": False},
}

SCENE_TOML = """\
name = "bend"
[ground]
friction = 0.1
[route]
kind = "sine"
amplitude_m = 0.05
wavelength_m = 0.8
length_m = 2.0
[[cylinder]]
position_m = [1.0, 1.0]
radius_m = 0.05
[[cylinder]]
position_m = [1.5, 1.0]
radius_m = 0.05
"""
SCENARIO_TOML = """\
title = "A test"
robot = "worm.toml"
scene = "bend.toml"
controller = "hold"
rate_hz = 100
[start]
tail_s_m = 0.1
[services.control]
[services.guidance]
decimation = 2
[controllers.hold]
"""


def with_changes(base: dict[str, Any], **dotted: Any) -> dict[str, Any]:
    """Return a deep copy of a table with other values. Two underscores in a name mean a dot: limits__torque_nm=0.1."""
    copied = copy.deepcopy(base)
    for name, value in dotted.items():
        *parents, last = name.split("__")
        place = copied
        for parent in parents:
            place = place.setdefault(parent, {})
        place[last] = value
    return copied


def make_robot_file(**dotted: Any) -> RobotFile:
    """Return the robot file of the test robot, with changes."""
    return msgspec.convert(with_changes(ROBOT, **dotted), RobotFile)


def make_run_config(**dotted: Any) -> RunConfig:
    """Return the configuration of the test run, with changes."""
    return msgspec.convert(with_changes(RUN, **dotted), RunConfig)


def make_description(*, simulated_time: bool = False, **dotted: Any) -> RobotDescription:
    """Return the description of the test robot, as a host publishes it, with changes."""
    reported = {
        "backend": "lag",
        "period_ns": PERIOD_NS,
        "lease_ns": LEASE_NS,
        "config_hash": "0" * 16,
    }
    return describe_robot(make_robot_file(**dotted), simulated_time=simulated_time, **reported)


def make_joint_state(
    robot: RobotDescription, angle: Any = 0.0, velocity: Any = 0.0, torque: Any = 0.0, **other: Any
) -> JointState:
    """Return a joint state of a robot. A single number is the value of every joint."""
    count = len(robot.joints)

    def column(value: Any) -> list[Any]:
        return list(value) if isinstance(value, list | tuple) else [value] * count

    values: dict[str, Any] = {
        "tick": 0,
        "timestamp_ns": 0,
        "valid": [True] * count,
        "age_ns": [0] * count,
        **other,
    }
    return JointState(
        angle_rad=column(angle), velocity_rad_s=column(velocity), torque_nm=column(torque), **values
    )


def make_joint_command(
    robot: RobotDescription, target: Any = 0.0, mode: Any = JointMode.POSITION, **other: Any
) -> JointCommand:
    """Return a joint command, valid unless changed. A single target or mode is that of every joint."""
    count = len(robot.joints)
    values: dict[str, Any] = {
        "tick": 0,
        "sequence": 1,
        "lease_epoch": 1,
        "layout": robot.layout,
        "valid_for_ns": LEASE_NS,
        "mode": mode if isinstance(mode, list) else [mode] * count,
        "target": list(target) if isinstance(target, list | tuple) else [target] * count,
        **other,
    }
    return JointCommand(**values)


def make_power(
    motor_c: Any = 20.0,
    voltage_v: Any = 24.0,
    leak: Any = False,
    valid: Any = True,
    *,
    joint_count: int = 3,
    **other: Any,
) -> Power:
    """Return a power sample with the health of joint modules. A single value is that of every joint."""

    def column(value: Any) -> list[Any]:
        return value if isinstance(value, list) else [value] * joint_count

    values: dict[str, Any] = {
        "motor_c": motor_c,
        "voltage_v": voltage_v,
        "leak": leak,
        "valid": valid,
        **other,
    }
    columns = {name: column(value) for name, value in values.items()}
    return Power(tick=0, timestamp_ns=0, current_a=column(0.0), board_c=column(20.0), **columns)


def make_pose(tick: int = 0, timestamp_ns: int = 0, **other: Any) -> Pose:
    """Return the pose of a body at rest at the origin, with changes."""
    still = (0.0, 0.0, 0.0)
    values = {"position_w": still, "orientation_wxyz": (1.0, 0.0, 0.0, 0.0)}
    values |= {"velocity_w": still, "angular_velocity_w": still, **other}
    return Pose(tick=tick, timestamp_ns=timestamp_ns, **values)


def make_link_contact(link_index: int = 0, **other: Any) -> Contact:
    """Return a contact on the left of a link without force, with changes."""
    still = (0.0, 0.0, 0.0)
    values = {
        "position_l": still,
        "normal_l": (0.0, -1.0, 0.0),
        "force_l": still,
        "torque_l": still,
    }
    values |= {"tangent_1_l": (1.0, 0.0, 0.0), "tangent_2_l": (0.0, 0.0, 1.0)}
    return Contact(link=link_index, **{"obstacle": None, **values, **other})


def make_clock(tick: int, *, arm_session: int = 0, **other: Any) -> Clock:
    """Return a clock message of 100 Hz in lockstep; the robot is armed if there is an arm session."""
    values = {
        "clock_mode": "lockstep",
        "lifecycle": "armed" if arm_session else "disarmed",
        "lease_epoch": 1,
        "newest": {},
    }
    return Clock(
        tick=tick,
        timestamp_ns=tick * PERIOD_NS,
        period_ns=PERIOD_NS,
        arm_session=arm_session,
        **{**values, **other},
    )


def write_scenario_files(
    folder: Path, *, robot: str = ROBOT_TOML, scene: str = SCENE_TOML, scenario: str = SCENARIO_TOML
) -> str:
    """Write a scenario with its robot and scene into a folder, and return the path of the scenario."""
    (folder / "worm.toml").write_text(robot)
    (folder / "bend.toml").write_text(scene)
    (folder / "crawl.toml").write_text(scenario)
    return str(folder / "crawl.toml")


def make_status(**reported: Any) -> RobotStatus:
    """Return a status as the host of the robot `worm` publishes it, armed and without faults.

    Args:
        **reported: Fields that differ from these defaults.
    """
    values: dict[str, Any] = {
        "tick": 0,
        "timestamp_ns": 0,
        "robot": "worm",
        "backend": "lag",
        "clock_mode": "realtime",
        "rate_hz": 100.0,
        "lifecycle": "armed",
        "reason": "armed",
        "lease_holder": None,
        "lease_epoch": 0,
        "overruns": 0,
        "commands_accepted": 0,
        "commands_standby": 0,
        "commands_rejected": {},
        "commands_limited": {},
        "faults": [],
        "alive": [],
        "waiting_for": [],
        "ready_to_arm": False,
    }
    return RobotStatus(**{**values, **reported})
