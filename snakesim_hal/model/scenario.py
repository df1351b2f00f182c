"""The scenario file, and the effective configuration of a run that is made from it.

A scenario names a robot, a scene, a controller, a clock mode and the services. `load` reads all three files, applies
flags, and checks everything at once; every process of the run gets the result, and it is enough to repeat the run.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from snakesim_hal.base.atomic_write import write_atomically
from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_hal.model.fault_kinds import CONTROL
from snakesim_hal.model.files import FileStruct, Table, decode, find_file, leaves, read_part, read_table
from snakesim_hal.model.fitting import fit_scene
from snakesim_hal.model.joints import Joint
from snakesim_hal.model.kinematics import link_frames, quaternion_from_yaw, rotation_from_quaternion
from snakesim_hal.model.outlines import Capsule, Heading, Point, Size
from snakesim_hal.model.robot import RobotFile, describe_robot
from snakesim_hal.model.route import chain_angles, lay_chain, yaw_segments_m
from snakesim_hal.model.scene import Placed, SceneFile, check_clear, make_route, place_scene
from snakesim_hal.model.textfiles import parse_toml
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ClockMode, Description, Obstacle
from snakesim_hal.wire.quantities import above

# Second part of the seed of the survey errors, so that they differ from other random numbers of the run's seed.
SURVEY = 0x5EED

# Name of the service that publishes cameras, motion capture and other sensors which the backend does not have.
SENSOR = "sensor"

# Prefix of a controller name that is followed by the model of a policy.
POLICY = "policy:"
POLICY_CONTROLLER = POLICY[:-1]

# Prefixes of --set keys: `control.x` is a parameter of the chosen controller, `backend.x` one of the chosen backend.
CHOSEN = ("control.", "backend.")

NS_PER_S = 1e9
LEASE_PERIODS = 5  # a lease outlasts a few lost commands
MIN_LEASE_NS = 50_000_000
MAX_LEASE_NS = 100_000_000  # a robot whose controller is gone moves no longer than this


class Start(FileStruct, frozen=True, kw_only=True):
    """Start pose of the snake: along the scene's route, or straight at a pose."""

    on_route: bool = True
    """True: the snake lies along the scene's route; false: it lies straight at a pose."""

    tail_s_m: Annotated[float, Meta(ge=-100, le=1000, extra_json_schema={"unit": "m"})] = 0.0
    """Arc length of the tail end along the route; used if `on_route` is true."""

    position_m: Point = (0.0, 0.0)
    """Position of the tail end in the world frame, as [x, y]; used if `on_route` is false."""

    yaw_rad: Heading = 0.0
    """Direction from the tail to the head in the world frame; used if `on_route` is false."""


class HeadingGoal(FileStruct, frozen=True, kw_only=True, tag="heading", tag_field="kind"):
    """Advance the whole body in one direction."""

    heading_rad: Heading = 0.0
    """Direction of the advance in the world frame; 0: along x."""

    distance_m: Size = 3.0
    """Distance of the goal from the start pose."""


class WaypointGoal(FileStruct, frozen=True, kw_only=True, tag="waypoints", tag_field="kind"):
    """Take the head from point to point."""

    points_m: Annotated[list[Point], Meta(min_length=1, max_length=1000)]
    """Points that the head visits in order, in the world frame, as [x, y]."""

    within_m: Size = 0.2
    """Distance at which a point counts as reached."""


class Mission(FileStruct, frozen=True, kw_only=True):
    """The goal of navigation: the end of the scene's route, or with `goal` a path that it plans itself."""

    speed_m_s: Annotated[float, Meta(ge=0, le=10, extra_json_schema={"unit": "m/s"})] = 0.2
    """Speed along the path that navigation asks for."""

    goal: HeadingGoal | WaypointGoal | None = None
    """Goal to which navigation plans a path, `kind` = "heading" or "waypoints"; none: the end of the scene's route."""

    until_goal: bool = False
    """True: the run ends when the goal is reached, even before `duration_s`."""

    map: Literal["known", "perceived"] = "known"
    """`known`: navigation has the obstacles of the scene, as from a survey; `perceived`: only what the sensors measure.
    """

    map_error_m: Annotated[float, Meta(ge=0, le=0.1, extra_json_schema={"unit": "m"})] = 0.0
    """Standard deviation of each obstacle's position in a known map; the errors follow from the run's seed."""

    assumed_obstacle_friction: Annotated[
        float, Meta(ge=0, le=2, extra_json_schema={"unit": "1 (Coulomb coefficient)"})
    ] = 0.0
    """Friction of obstacles that navigation assumes when it plans, and the controller when it pushes."""

    max_climb_m: Annotated[float, Meta(ge=0, le=1, extra_json_schema={"unit": "m"})] = 0.1
    """Height of the highest `step` of a known map that a robot with pitch joints climbs."""

    localization: Literal["pose_sensor", "dead_reckoning"] = "pose_sensor"
    """`pose_sensor`: the pose comes from the pose sensor if there is one; `dead_reckoning`: from joints, IMU, contacts
    and the map alone.
    """

    def __post_init__(self) -> None:
        """Check that survey errors come with a known map, and `until_goal` with a goal. Raises ValueError."""
        if self.map_error_m > 0 and self.map == "perceived":
            raise ValueError('`map_error_m` is of a survey; with map = "perceived" there is none')
        if self.until_goal and self.goal is None:
            raise ValueError("`until_goal`: this mission has no goal to reach; give it one in [mission.goal]")


class ServiceSchedule(FileStruct, frozen=True, kw_only=True):
    """A process of the run that acts every `decimation` ticks.

    In lockstep, the output that a service computes for tick t is used from tick t + latency_ticks on, no matter when
    it arrived. So a slow service does not break determinism, and it runs in parallel to the simulator. For control, a
    latency of 1 means that a command acts in the period after the state that it answers. A latency of 2 adds a period,
    in which control and physics overlap.
    """

    decimation: Annotated[int, Meta(ge=1, le=1000)] = 1
    """The service acts in every n-th control cycle."""

    latency_ticks: Annotated[int, Meta(ge=1, le=1000)] = 1
    """Control cycles from the input of the service to the cycle in which its output is used, in lockstep."""

    restart: bool = True
    """With `snakesim run --stay`, true: the run starts the process again when it ends; false: the run ends with it."""

    external: bool = False
    """True: the run waits for the process of the service, but does not start it."""

    process: Literal["own", "host"] = "own"
    """`own`: the service has a process of its own; `host`: it is a thread in the process of the HAL host."""

    plugin: str = ""
    """Name of an installed service, or ./file.py:Class; empty: the installed service of the section's name."""

    def used_output_tick(self, tick: int) -> int:
        """Return the newest tick whose output is used at `tick`; at the start, the output of tick 0 is used early."""
        due_tick = max(tick - self.latency_ticks, 0)
        return due_tick - due_tick % self.decimation


Seconds = Annotated[float, above(60, "s")]


class MaxAge(FileStruct, frozen=True, kw_only=True):
    """Maximum age of the inputs of control, in robot time; the defaults follow from rates, delays and schedules.

    If the joint states are older, control sends no command, so the lease ends and the robot stops. If a pose, contacts,
    an image, a world or a trajectory is older, the controller holds, and resumes when the stream is back.
    """

    joints_s: Seconds | None = None
    """Maximum age of the joint states; none: it follows from rates, delays and schedules."""

    pose_s: Seconds | None = None
    """Maximum age of the pose; none: it follows from rates, delays and schedules."""

    contacts_s: Seconds | None = None
    """Maximum age of the contacts; none: it follows from rates, delays and schedules."""

    depth_s: Seconds | None = None
    """Maximum age of the newest image or ranges in a perceived map; none: it follows from rates, delays and schedules.
    """

    world_s: Seconds | None = None
    """Maximum age of the world that guidance publishes; none: it follows from rates, delays and schedules."""

    trajectory_s: Seconds | None = None
    """Maximum age of the trajectory that navigation publishes; none: it follows from rates, delays and schedules."""


class RunConfig(FileStruct, frozen=True, kw_only=True):
    """The whole configuration of a run."""

    name: Annotated[str, Meta(min_length=1, max_length=60)]
    """Name of the scenario; a file may leave it out, and has its file name then."""

    title: str = ""
    """Description in one line, which lists of scenarios show."""

    # What runs.
    robot: RobotFile
    """The robot: in a file the name of a shipped robot or the path of a robot file, or a whole section."""

    scene: SceneFile
    """The scene: in a file the name of a shipped scene or the path of a scene file, or a whole section."""

    backend: str = "sim"
    """Backend that drives the robot: the name of an installed backend, or ./file.py:Class."""

    controller: str
    """Controller: the name of an installed controller, `policy:MODEL`, or ./file.py:Class."""

    # Time.
    clock_mode: ClockMode = "lockstep"
    """How robot time passes. `realtime`: by the wall clock; `lockstep`: the host waits for the services in every cycle;
    `free`: as fast as possible.
    """

    rate_hz: Annotated[float, Meta(ge=20, le=5000, extra_json_schema={"unit": "Hz"})] = 100.0
    """Rate of the control cycle."""

    duration_s: Annotated[float, Meta(gt=0, le=86400, extra_json_schema={"unit": "s"})] = 10.0
    """Duration of the run in robot time."""

    seed: Annotated[int, Meta(ge=0, le=2**31)] = 1
    """Seed of all random numbers of the run."""

    faults: list[str] = []
    """Faults to inject, at times since the first arming, such as "kill:control@2"; see docs/how-to/inject-faults.md."""

    allow_fault_injection: bool = False
    """True: faults may be injected also on a robot whose motors really move."""

    stall_limit_s: Annotated[float, Meta(gt=0, le=600, extra_json_schema={"unit": "s"})] = 10.0
    """Wall time for which the host waits in lockstep for the output of a service, before it continues without it."""

    start_limit_s: Annotated[float, Meta(gt=0, le=3600, extra_json_schema={"unit": "s"})] = 60.0
    """Wall time within which all services must be ready to arm."""

    # What the parts of the run do.
    start: Start = Start()
    """Start pose of the snake."""

    mission: Mission = Mission()
    """Speed and goal of the motion, and what navigation knows."""

    services: dict[str, ServiceSchedule]
    """Processes of the run by name, as sections such as `[services.control]`."""

    max_age: MaxAge = MaxAge()
    """Maximum ages of the inputs of control."""

    controllers: dict[str, dict[str, Any]] = {}
    """Parameters of each controller by its name, as sections such as `[controllers.obstacle_aided]`."""

    backends: dict[str, dict[str, Any]] = {}
    """Settings of each backend by its name, as sections such as `[backends.sim]`."""

    @property
    def control_section(self) -> str:
        """Return the section with the parameters of the chosen controller: `controllers.Wave` for `./file.py:Wave`."""
        return f"controllers.{_section_name(self.controller)}"

    @property
    def controller_parameters(self) -> dict[str, Any]:
        """Return the parameters of the chosen controller."""
        return self.controllers.get(_section_name(self.controller), {})

    @property
    def backend_section(self) -> str:
        """Return the section with the settings of the chosen backend: `backends.Bench` for `./file.py:Bench`."""
        return f"backends.{_section_name(self.backend)}"

    @property
    def backend_settings(self) -> dict[str, Any]:
        """Return the settings of the chosen backend."""
        return self.backends.get(_section_name(self.backend), {})

    @property
    def own_services(self) -> dict[str, ServiceSchedule]:
        """Return the services that the run starts itself."""
        return {name: service for name, service in self.services.items() if not service.external}

    @property
    def beside(self) -> list[str]:
        """Return the names of the services that run in the process of the HAL host."""
        return [name for name, service in self.own_services.items() if service.process == "host"]

    @property
    def has_own_control(self) -> bool:
        """Return whether the run starts a controller; otherwise an external controller also arms the robot."""
        return CONTROL in self.own_services

    @property
    def commander(self) -> str:
        """Return the name of the controller, with the model of a policy; `external` if the run starts no controller."""
        if not self.has_own_control:
            return "external"
        if self.controller == POLICY_CONTROLLER:
            model = self.controller_parameters.get("model")
            if model:
                return f"{POLICY}{model}"
        return self.controller

    def dead_reckons(self, robot: Description) -> bool:
        """Return whether guidance estimates the pose by dead reckoning.

        It does if the mission demands it, and also if neither the robot nor a service measures the pose.
        """
        if self.mission.localization == "dead_reckoning":
            return True
        robot_publishes_pose = any(sensor.key == keys.POSE for sensor in robot.sensors)
        has_pose_sensor = robot_publishes_pose or self.robot.sensors.pose is not None or SENSOR in self.services
        return not has_pose_sensor

    @property
    def period_ns(self) -> int:
        """Return the duration of one control period."""
        return round(NS_PER_S / self.rate_hz)

    @property
    def lease_ns(self) -> int:
        """Return the term of a lease: five periods or 50 ms, whichever is longer, but at most 100 ms."""
        term_ns = max(LEASE_PERIODS * self.period_ns, MIN_LEASE_NS)
        return min(term_ns, MAX_LEASE_NS)


def _section_name(plugin_name: str) -> str:
    """Return the name of a plugin's section: the class, for a plugin in a file such as `./file.py:Wave`."""
    return plugin_name.rpartition(":")[2]


@dataclass(frozen=True)
class Loaded:
    """A checked configuration, with the origin of each value."""

    config: RunConfig
    table: Table

    def explain(self) -> list[tuple[str, Any, str]]:
        """Return every effective value as (dotted key, value, file or flag or `default`)."""
        effective = msgspec.to_builtins(self.config)
        return [(key, value, self.table.origin_of(key)) for key, value in leaves(effective)]


@dataclass(frozen=True)
class Override:
    """A value that the command line gives for one key."""

    key: str  # dotted
    value: Any
    flag: str  # as written on the command line, for error messages


def parse_set(text: str) -> Override:
    """Parse the `section.key=value` of a --set option.

    The value is read as TOML. If it is not valid TOML, it is taken as plain text.

    Raises:
        ConfigError: The key or the equals sign is missing.
    """
    key, equals, value = text.partition("=")
    key = key.strip()
    if not equals or not key:
        raise ConfigError(
            f"--set {shorten(text)}: give section.key=value, such as --set control.propulsion_n=35",
            code="command/invalid-option",
        )
    try:
        parsed = parse_toml(f"value = {value}", "--set")["value"]
    except ConfigError:
        parsed = value.strip()
    return Override(key, parsed, f"--set {shorten(text)}")


def load(scenario: str, overrides: Sequence[Override] = ()) -> Loaded:
    """Read a scenario with its robot and scene, apply the flags, and check the result.

    Args:
        scenario: the name of a shipped scenario, or the path of a file.
        overrides: values from the command line.

    Raises:
        ConfigError: A file cannot be read, or a value is not allowed.
    """
    table = compose_table(scenario, overrides)
    config = decode(table, RunConfig)
    check(config)
    return Loaded(config, table)


def compose_table(scenario: str, overrides: Sequence[Override] = ()) -> Table:
    """Return all values of a scenario, its robot and its scene, with the flags applied, but not checked yet.

    Raises:
        ConfigError: A file cannot be read.
    """
    path = find_file(scenario, "scenarios")
    table = read_table(path)
    table.values.setdefault("name", path.stem)
    _split_policy(table, table.values.get("controller"), table.source)

    # Another robot or scene is chosen before its single values are changed.
    file_choices = [override for override in overrides if override.key in ("robot", "scene")]
    for choice in file_choices:
        table.put(choice.key, choice.value, choice.flag)
    chosen_by_flag = {choice.key for choice in file_choices}
    for part, kind in (("robot", "robots"), ("scene", "scenes")):
        relative_to = None if part in chosen_by_flag else path.parent
        _include_file(table, part, kind, relative_to)

    # A controller or backend is chosen before the keys that refer to the chosen one.
    value_overrides = [override for override in overrides if override not in file_choices]
    for override in sorted(value_overrides, key=lambda override: override.key.startswith(CHOSEN)):
        _apply_override(table, override)

    scene = table.values.get("scene")
    if isinstance(scene, dict) and "reference_robot" in scene:
        _fit_scene(table, flags={override.flag for override in value_overrides})
    return table


def _include_file(table: Table, part: str, kind: str, relative_to: Path | None) -> None:
    """Replace the name of a robot or scene by the contents of its file; do nothing if the contents are there."""
    name = table.values.get(part)
    if not isinstance(name, str):
        return
    included = read_part(name, kind, relative_to)
    table.put(part, included.values, included.source)
    # With `extends`, the values of one part come from two files.
    table.origin |= {f"{part}.{key}": origin for key, origin in included.origin.items()}


def _apply_override(table: Table, override: Override) -> None:
    """Put a value from the command line into the table."""
    key = _expand_chosen(table, override.key)
    table.put(key, override.value, override.flag)
    if key == "controller":
        _split_policy(table, override.value, override.flag)


def _expand_chosen(table: Table, key: str) -> str:
    """Return the key in the section of the chosen controller or backend, for `control.KEY` or `backend.KEY`."""
    control_prefix, backend_prefix = CHOSEN
    if key.startswith(control_prefix):
        prefix = control_prefix
        chosen = table.values.get("controller", "sim")
        section = "controllers"
    elif key.startswith(backend_prefix):
        prefix = backend_prefix
        chosen = table.values.get("backend", "sim")
        section = "backends"
    else:
        return key
    return f"{section}.{_section_name(str(chosen))}.{key.removeprefix(prefix)}"


def _fit_scene(table: Table, flags: set[str]) -> None:
    """Change a scene that was laid out for another robot, except for the values that a flag gives; see fitting.py."""
    config = decode(table, RunConfig)

    def is_given_by_flag(key: str) -> bool:
        return table.origin_of(f"scene.{key}") in flags

    changed = fit_scene(config.scene, config.robot, is_given_by_flag)
    for key, value in changed.items():
        table.put(f"scene.{key}", value, f"fitted to robot {config.robot.name!r}")


def _split_policy(table: Table, controller: Any, origin: str) -> None:
    """Replace the controller `policy:MODEL` by the controller `policy` and its parameter `model`."""
    if isinstance(controller, str) and controller.startswith(POLICY):
        table.put("controller", POLICY_CONTROLLER, origin)
        table.put(f"controllers.{POLICY_CONTROLLER}.model", controller.removeprefix(POLICY), origin)


def check(config: RunConfig) -> None:
    """Check what more than one field decides: the start pose, and that no obstacle overlaps it.

    Raises:
        ConfigError: The robot cannot lie at the start pose, or an obstacle is in its place.
    """
    if config.start.on_route and config.scene.route is None:
        raise ConfigError(
            f"scenario {config.name!r}: `start.on_route` is true but scene {config.scene.name!r} has no route; "
            f"set start.on_route = false with position_m and yaw_rad, or add a [route] to the scene",
            code="scene/no-route",
        )
    angles_rad = find_start_pose(config).angles_rad.tolist()
    for joint, angle_rad in zip(config.robot.joint_table, angles_rad, strict=True):
        if not joint.limits.lower_rad <= angle_rad <= joint.limits.upper_rad:
            raise _start_angle_error(config, joint, angle_rad)
    place_obstacles(config)


def _start_angle_error(config: RunConfig, joint: Joint, angle_rad: float) -> ConfigError:
    """Return the error for a start angle outside of a joint's limits."""
    limits = joint.limits
    if not config.start.on_route:
        return ConfigError(
            f"robot {config.robot.name!r}: {joint.name} may turn from {limits.lower_rad:g} to "
            f"{limits.upper_rad:g} rad, and the robot starts straight, at 0; let its limits include that, or "
            f"start it on a route that suits them",
            code="config/out-of-range",
        )
    return ConfigError(
        f"scenario {config.name!r}: lying on the route, {joint.name} would start at {angle_rad:.2f} rad; robot "
        f"{config.robot.name!r} allows {limits.lower_rad:g} to {limits.upper_rad:g} rad. Choose a "
        f"smoother route",
        code="config/out-of-range",
    )


@dataclass(frozen=True)
class StartPose:
    """Pose of the snake at tick 0."""

    position_w: tuple[float, float]  # of the tail end, on the ground
    yaw_rad: float
    angles_rad: NDArray[np.float64]  # (n_joints,), tail to head


def find_start_pose(config: RunConfig) -> StartPose:
    """Return the pose of the snake at tick 0: on the scene's route, or straight."""
    robot = config.robot
    start = config.start
    route = make_route(config.scene)
    if not start.on_route or route is None:
        straight_rad = np.zeros(robot.chain.modules)
        return StartPose(start.position_m, start.yaw_rad, straight_rad)
    segments_m = yaw_segments_m(robot.axes, robot.link_lengths_m)
    chain = lay_chain(route, start.tail_s_m, segments_m)
    return StartPose(chain.tail_w, chain.heading_rad, chain_angles(robot.axes, chain.angles_rad))


def describe_run_robot(config: RunConfig, backend: str = "", *, emulated: bool = False) -> Description:
    """Return the description that the HAL publishes of the configured robot.

    Args:
        config: of the run.
        backend: the name that the backend has for itself; empty: the name in the scenario.
        emulated: whether no real motor moves.
    """
    return describe_robot(
        config.robot,
        backend=backend or config.backend,
        period_ns=config.period_ns,
        lease_ns=config.lease_ns,
        config_hash=config_hash(config),
        emulated=emulated,
    )


def capsules_at_start(config: RunConfig) -> list[Capsule]:
    """Return the outlines of the links at tick 0 as seen from above, tail to head."""
    robot = config.robot
    pose = find_start_pose(config)
    radius_m = robot.module.radius_m
    base_w = (*pose.position_w, radius_m)
    base_rotation = rotation_from_quaternion(quaternion_from_yaw(pose.yaw_rad))
    origins, rotations = link_frames(base_w, base_rotation, pose.angles_rad, robot.axes, robot.link_lengths_m)
    capsules: list[Capsule] = []
    for i, length_m in enumerate(robot.link_lengths_m):
        front_w = origins[i] + length_m * rotations[i][:, 0]
        rear_x, rear_y, _ = origins[i].tolist()
        front_x, front_y, _ = front_w.tolist()
        capsules.append(
            Capsule(name=f"link_{i}", rear_m=(rear_x, rear_y), front_m=(front_x, front_y), radius_m=radius_m)
        )
    return capsules


def place_obstacles(config: RunConfig) -> list[Placed]:
    """Return all obstacles of the scene, placed.

    Raises:
        ConfigError: An obstacle cannot be placed, or overlaps the snake's start pose.
    """
    snake = capsules_at_start(config)
    placed = place_scene(config.scene, snake)
    check_clear(config.scene, placed, snake)
    return placed


def survey_obstacles(config: RunConfig, *, walkable: bool = False) -> list[Obstacle]:
    """Return the obstacles at the positions that the survey gives, which differ from the true ones by its error.

    Args:
        config: of the run; its seed decides the errors.
        walkable: true: the platforms that the snake may lie on; false: the obstacles that it pushes against.
    """
    obstacles = [placed.obstacle for placed in place_obstacles(config) if placed.walkable == walkable]
    error_m = config.mission.map_error_m
    if error_m == 0.0:
        return obstacles
    random = np.random.default_rng((config.seed, SURVEY + walkable))
    errors_m = random.normal(0.0, error_m, (len(obstacles), 2))
    displaced: list[Obstacle] = []
    for obstacle, (error_x, error_y) in zip(obstacles, errors_m.tolist(), strict=True):
        x, y, z = obstacle.position_w
        position_w = (x + error_x, y + error_y, z)
        displaced.append(msgspec.structs.replace(obstacle, position_w=position_w))
    return displaced


def config_hash(config: RunConfig) -> str:
    """Return a hash of everything that the outcome of a run depends on."""
    plain = json.dumps(msgspec.to_builtins(config), sort_keys=True)
    return hashlib.sha256(plain.encode()).hexdigest()[:16]


def encode_config(config: RunConfig) -> bytes:
    """Return the effective configuration as JSON; `snakesim run` accepts it like a scenario file."""
    return msgspec.json.format(msgspec.json.encode(config), indent=2)


def write_config(config: RunConfig, path: Path) -> None:
    """Save the effective configuration as JSON."""
    write_atomically(path, encode_config(config))


def read_config(path: Path) -> RunConfig:
    """Read a file that `write` saved, whatever its name."""
    return decode(read_table(path), RunConfig)
