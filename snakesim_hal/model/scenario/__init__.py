"""The scenario file, and the effective configuration of a run that is made from it.

A scenario names a robot, a scene, a controller, a clock mode and the services. Import from this package:

`run_config`   the effective configuration, and its parts    `mission`      start pose and goal of the motion
`loading`      reads the three files, and applies flags      `start_pose`   robot and obstacles at tick 0
"""

from snakesim_hal.model.scenario.loading import (
    CHOSEN_PREFIXES,
    KeyOverride,
    LoadedScenario,
    compose_config_table,
    load_scenario,
    parse_set_option,
)
from snakesim_hal.model.scenario.mission import HeadingGoal, Mission, StartPlacement, WaypointGoal
from snakesim_hal.model.scenario.run_config import (
    POLICY,
    POLICY_CONTROLLER,
    SENSOR,
    MaxAge,
    RunConfig,
    ServiceSchedule,
    compute_config_hash,
    describe_run_robot,
    encode_config,
    read_config,
    write_config,
)
from snakesim_hal.model.scenario.start_pose import (
    StartPose,
    compute_start_pose,
    get_noisy_obstacle_map,
    make_start_capsules,
    place_obstacles,
    validate_start_pose,
)

__all__ = [
    "CHOSEN_PREFIXES",
    "POLICY",
    "POLICY_CONTROLLER",
    "SENSOR",
    "HeadingGoal",
    "KeyOverride",
    "LoadedScenario",
    "MaxAge",
    "Mission",
    "RunConfig",
    "ServiceSchedule",
    "StartPlacement",
    "StartPose",
    "WaypointGoal",
    "compose_config_table",
    "compute_config_hash",
    "compute_start_pose",
    "describe_run_robot",
    "encode_config",
    "get_noisy_obstacle_map",
    "load_scenario",
    "make_start_capsules",
    "parse_set_option",
    "place_obstacles",
    "read_config",
    "validate_start_pose",
    "write_config",
]
