"""The scenario file, and the effective configuration of a run that is made from it.

A scenario names a robot, a scene, a controller, a clock mode and the services. Import from this package:

`run_config`   the effective configuration, and its parts    `mission`      start pose and goal of the motion
`loading`      reads the three files, and applies flags      `start_pose`   robot and obstacles at tick 0
"""

from snakesim_hal.model.scenario.loading import CHOSEN, Loaded, Override, compose_table, load, parse_set
from snakesim_hal.model.scenario.mission import HeadingGoal, Mission, Start, WaypointGoal
from snakesim_hal.model.scenario.run_config import (
    POLICY,
    POLICY_CONTROLLER,
    SENSOR,
    MaxAge,
    RunConfig,
    ServiceSchedule,
    config_hash,
    describe_run_robot,
    encode_config,
    read_config,
    write_config,
)
from snakesim_hal.model.scenario.start_pose import (
    StartPose,
    capsules_at_start,
    check,
    find_start_pose,
    place_obstacles,
    survey_obstacles,
)

__all__ = [
    "CHOSEN",
    "POLICY",
    "POLICY_CONTROLLER",
    "SENSOR",
    "HeadingGoal",
    "Loaded",
    "MaxAge",
    "Mission",
    "Override",
    "RunConfig",
    "ServiceSchedule",
    "Start",
    "StartPose",
    "WaypointGoal",
    "capsules_at_start",
    "check",
    "compose_table",
    "config_hash",
    "describe_run_robot",
    "encode_config",
    "find_start_pose",
    "load",
    "parse_set",
    "place_obstacles",
    "read_config",
    "survey_obstacles",
    "write_config",
]
