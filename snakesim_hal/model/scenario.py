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

from snakesim_hal.base.atomic_write import write_whole
from snakesim_hal.base.errors import ConfigError, short
from snakesim_hal.model.fault_kinds import CONTROL
from snakesim_hal.model.files import FileStruct, Table, decode, find, leaves, read_part, read_table
from snakesim_hal.model.fitting import fitted
from snakesim_hal.model.kinematics import link_frames, quaternion_from_yaw, rotation_from_quaternion
from snakesim_hal.model.outlines import Capsule, Heading, Point, Size
from snakesim_hal.model.robot import RobotFile, describe
from snakesim_hal.model.route import chain_angles, lay_chain, yaw_segments_m
from snakesim_hal.model.scene import Placed, SceneFile, check_clear, place, route_of
from snakesim_hal.model.textfiles import parse_toml
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ClockMode, Description, Obstacle
from snakesim_hal.wire.quantities import above

SURVEY = 0x5EED  # tells the survey's random numbers from others of the same seed
SENSOR = "sensor"  # the service of cameras, motion capture and other sensors that the backend does not have
POLICY = "policy:"  # a controller that begins so names its model behind it
CHOSEN = ("control.", "backend.")  # --set control.x=1 changes the chosen controller, --set backend.x=1 the backend


class Start(FileStruct, frozen=True, kw_only=True):
    """Start pose of the snake: along the scene's route, or straight at a pose."""

    on_route: bool = True
    tail_s_m: Annotated[float, Meta(ge=-100, le=1000, extra_json_schema={"unit": "m"})] = 0.0
    position_m: Point = (0.0, 0.0)  # of the tail end, when not on the route
    yaw_rad: Heading = 0.0


class HeadingGoal(FileStruct, frozen=True, kw_only=True, tag="heading", tag_field="kind"):
    """Advance the whole body in one direction."""

    heading_rad: Heading = 0.0
    distance_m: Size = 3.0  # from where it starts


class WaypointGoal(FileStruct, frozen=True, kw_only=True, tag="waypoints", tag_field="kind"):
    """Take the head from point to point."""

    points_m: Annotated[list[Point], Meta(min_length=1, max_length=1000)]
    within_m: Size = 0.2  # a point this near counts as reached


class Mission(FileStruct, frozen=True, kw_only=True):
    """The goal of navigation: the end of the scene's route, or with `goal` a path that it plans itself."""

    speed_m_s: Annotated[float, Meta(ge=0, le=10, extra_json_schema={"unit": "m/s"})] = 0.2
    goal: HeadingGoal | WaypointGoal | None = None
    until_goal: bool = False  # the run ends when the goal is reached, rather than with its time
    map: Literal["known", "perceived"] = "known"  # the scene's obstacles as from a survey, or only what sensors measure
    # Of a known map: standard deviation of each obstacle's place, drawn from the run's seed, once for all services.
    map_error_m: Annotated[float, Meta(ge=0, le=0.1, extra_json_schema={"unit": "m"})] = 0.0
    # Of obstacles, as navigation reckons with it where it plans, and the controller where it pushes.
    peg_friction: Annotated[float, Meta(ge=0, le=2, extra_json_schema={"unit": "1 (Coulomb coefficient)"})] = 0.0
    # Of a known map: a robot whose joints turn up and down, too, climbs a `step` of the scene up to this height.
    max_climb_m: Annotated[float, Meta(ge=0, le=1, extra_json_schema={"unit": "m"})] = 0.1
    # By the pose sensor where there is one; or by joints, IMU, contacts and the map alone.
    localization: Literal["pose_sensor", "dead_reckoning"] = "pose_sensor"

    def __post_init__(self) -> None:
        """Only a map that is known has errors of a survey; only a goal can be reached."""
        if self.map_error_m > 0 and self.map == "perceived":
            raise ValueError('`map_error_m` is of a survey; with map = "perceived" there is none')
        if self.until_goal and self.goal is None:
            raise ValueError("`until_goal`: this mission has no goal to reach; give it one in [mission.goal]")


class Service(FileStruct, frozen=True, kw_only=True):
    """A process of the run that acts every `decimation`.

    In lockstep its output for tick t is used from tick t + latency_ticks on, whenever it really arrived, so that a slow
    service does not break determinism, and runs in parallel to the simulator. For control, a lag of 1 is a
    command that acts in the period after its state; 2 adds a period of latency, in which control and physics overlap.
    """

    decimation: Annotated[int, Meta(ge=1, le=1000)] = 1
    latency_ticks: Annotated[int, Meta(ge=1, le=1000)] = 1
    restart: bool = True  # with `snakesim run --stay`, when its process ends; false: the run ends with it
    external: bool = False  # a process that the run waits for, but does not start
    place: Literal["process", "host"] = "process"  # `host`: beside the driver, in a thread of the host's process
    code: str = ""  # an installed service, or ./file.py:Class; empty: the installed service of the section's name

    def used_output_tick(self, tick: int) -> int:
        """The newest tick whose output is used at `tick`. That of tick 0 is used from the start."""
        due = max(tick - self.latency_ticks, 0)
        return due - due % self.decimation


Seconds = Annotated[float, above(60, "s")]


class MaxAge(FileStruct, frozen=True, kw_only=True):
    """Maximum age of control's inputs, in robot time; the defaults follow from rates, delays and schedules.

    With older joint states control sends no command, so that the lease ends and the robot stops. With an older pose,
    contacts, image, world or trajectory the controller holds, and resumes when the stream is back.
    """

    joints_s: Seconds | None = None
    pose_s: Seconds | None = None
    contacts_s: Seconds | None = None
    depth_s: Seconds | None = None  # of the newest image or ranges in a perceived map
    world_s: Seconds | None = None
    trajectory_s: Seconds | None = None


class RunConfig(FileStruct, frozen=True, kw_only=True):
    """The whole configuration of a run."""

    name: Annotated[str, Meta(min_length=1, max_length=60)]
    title: str = ""
    robot: RobotFile
    scene: SceneFile
    backend: str = "sim"
    controller: str
    clock_mode: ClockMode = "lockstep"
    rate_hz: Annotated[float, Meta(ge=20, le=5000, extra_json_schema={"unit": "Hz"})] = 100.0
    duration_s: Annotated[float, Meta(gt=0, le=86400, extra_json_schema={"unit": "s"})] = 10.0
    seed: Annotated[int, Meta(ge=0, le=2**31)] = 1
    faults: list[str] = []  # injected faults, at times since the first arming: see snakesim_hal.model.fault_kinds
    allow_fault_injection: bool = False  # also where something real moves
    stall_limit_s: Annotated[float, Meta(gt=0, le=600, extra_json_schema={"unit": "s"})] = 10.0
    start_limit_s: Annotated[float, Meta(gt=0, le=3600, extra_json_schema={"unit": "s"})] = 60.0
    start: Start = Start()
    mission: Mission = Mission()
    services: dict[str, Service]
    max_age: MaxAge = MaxAge()
    controllers: dict[str, dict[str, Any]] = {}  # settings of each controller, checked by the controller
    backends: dict[str, dict[str, Any]] = {}  # settings of each backend, checked by the backend

    @property
    def control_section(self) -> str:
        """Section with the settings of the chosen controller; for `./file.py:Wave` that is `controllers.Wave`."""
        return f"controllers.{self.controller.rpartition(':')[2]}"

    @property
    def control_settings(self) -> dict[str, Any]:
        """The settings of the chosen controller."""
        return self.controllers.get(self.controller.rpartition(":")[2], {})

    @property
    def backend_section(self) -> str:
        """Section with the settings of the chosen backend; for `./file.py:Bench` that is `backends.Bench`."""
        return f"backends.{self.backend.rpartition(':')[2]}"

    @property
    def backend_settings(self) -> dict[str, Any]:
        """The settings of the chosen backend."""
        return self.backends.get(self.backend.rpartition(":")[2], {})

    @property
    def own_services(self) -> dict[str, Service]:
        """The services that the run starts itself."""
        return {name: service for name, service in self.services.items() if not service.external}

    @property
    def beside(self) -> list[str]:
        """Those of them that run in the host's process."""
        return [name for name, service in self.own_services.items() if service.place == "host"]

    @property
    def has_own_control(self) -> bool:
        """Whether the run has its own controller; otherwise the external one also arms the robot."""
        return CONTROL in self.own_services

    @property
    def commander(self) -> str:
        """The controller, with its model if it is a policy, or `external` when the run starts none."""
        if not self.has_own_control:
            return "external"
        model = self.control_settings.get("model") if self.controller == POLICY[:-1] else None
        return f"{POLICY}{model}" if model else self.controller

    def dead_reckons(self, robot: Description) -> bool:
        """Whether guidance reckons the pose: it was told to, or neither the robot nor a service tells it."""
        described = any(sensor.key == keys.POSE for sensor in robot.sensors)
        told = described or self.robot.sensors.pose is not None or SENSOR in self.services
        return self.mission.localization == "dead_reckoning" or not told

    @property
    def period_ns(self) -> int:
        """One control period."""
        return round(1e9 / self.rate_hz)

    @property
    def lease_ns(self) -> int:
        """Term of a lease: five periods or 50 ms, whichever is longer, at most 100 ms."""
        return min(max(5 * self.period_ns, 50_000_000), 100_000_000)


@dataclass(frozen=True)
class Loaded:
    """A checked configuration, with the origin of each value."""

    config: RunConfig
    table: Table

    def explain(self) -> list[tuple[str, Any, str]]:
        """Every effective value as (dotted key, value, file or flag or `default`)."""
        effective = msgspec.to_builtins(self.config)
        return [(key, value, self.table.origin_of(key)) for key, value in leaves(effective)]


@dataclass(frozen=True)
class Override:
    """A value given on the command line."""

    key: str
    value: Any
    flag: str


def parse_set(text: str) -> Override:
    """`section.key=value` of --set; the value is parsed as TOML, else taken as plain text."""
    key, equals, value = text.partition("=")
    key = key.strip()
    if not equals or not key:
        raise ConfigError(f"--set {short(text)}: give section.key=value, such as --set control.propulsion_n=35")
    try:
        parsed = parse_toml(f"value = {value}", "--set")["value"]
    except ConfigError:
        parsed = value.strip()
    return Override(key, parsed, f"--set {short(text)}")


def load(scenario: str, overrides: Sequence[Override] = ()) -> Loaded:
    """Read a scenario (shipped name or path), its robot and scene, and the flags. Raises ConfigError."""
    table = compose(scenario, overrides)
    config = decode(table, RunConfig)
    check(config)
    return Loaded(config, table)


def compose(scenario: str, overrides: Sequence[Override] = ()) -> Table:
    """All values of a scenario, not checked yet. Raises ConfigError for files that cannot be read."""
    path = find(scenario, "scenarios")
    table = read_table(path)
    table.values.setdefault("name", path.stem)
    _split_policy(table, table.values.get("controller"), table.source)
    picks = [o for o in overrides if o.key in ("robot", "scene")]
    for pick in picks:
        table.put(pick.key, pick.value, pick.flag)
    for part, kind in (("robot", "robots"), ("scene", "scenes")):
        named = table.values.get(part)
        if isinstance(named, str):
            from_flag = any(o.key == part for o in picks)
            inner = read_part(named, kind, None if from_flag else path.parent)
            table.put(part, inner.values, inner.source)
            table.origin |= {f"{part}.{key}": origin for key, origin in inner.origin.items()}  # with `extends`, of two
    for override in sorted(overrides, key=lambda o: o.key.startswith(CHOSEN)):
        if override in picks:
            continue
        key = override.key
        for alias, choice, section in (
            (CHOSEN[0], "controller", "controllers"),
            (CHOSEN[1], "backend", "backends"),
        ):
            if key.startswith(alias):
                chosen = str(table.values.get(choice, "sim")).rpartition(":")[2]
                key = f"{section}.{chosen}.{key.removeprefix(alias)}"
        table.put(key, override.value, override.flag)
        if key == "controller":
            _split_policy(table, override.value, override.flag)
    scene = table.values.get("scene")
    if isinstance(scene, dict) and "reference_robot" in scene:
        _fit(table, {override.flag for override in overrides if override not in picks})
    return table


def _fit(table: Table, flags: set[str]) -> None:
    """Change a scene that was made for another robot; see fitting.py."""
    config = decode(table, RunConfig)
    changed = fitted(config.scene, config.robot, lambda key: table.origin_of(f"scene.{key}") in flags)
    for key, value in changed.items():
        table.put(f"scene.{key}", value, f"fitted to robot {config.robot.name!r}")


def _split_policy(table: Table, controller: Any, origin: str) -> None:
    """Of `policy:MODEL` the controller `policy`, and the setting that has its model."""
    if isinstance(controller, str) and controller.startswith(POLICY):
        table.put("controller", POLICY[:-1], origin)
        table.put(f"controllers.{POLICY[:-1]}.model", controller.removeprefix(POLICY), origin)


def check(config: RunConfig) -> None:
    """Checks that need more than one field. Raises ConfigError."""
    start = config.start
    if start.on_route and config.scene.route is None:
        raise ConfigError(
            f"scenario {config.name!r}: `start.on_route` is true but scene {config.scene.name!r} has no route; "
            f"set start.on_route = false with position_m and yaw_rad, or add a [route] to the scene"
        )
    angles = start_of(config).angles_rad
    for joint, angle_rad in zip(config.robot.joint_table, angles.tolist(), strict=True):
        if joint.limits.lower_rad <= angle_rad <= joint.limits.upper_rad:
            continue
        if not start.on_route:
            raise ConfigError(
                f"robot {config.robot.name!r}: {joint.name} may turn from {joint.limits.lower_rad:g} to "
                f"{joint.limits.upper_rad:g} rad, and the robot starts straight, at 0; let its limits include that, or "
                f"start it on a route that suits them"
            )
        raise ConfigError(
            f"scenario {config.name!r}: lying on the route, {joint.name} would start at {angle_rad:.2f} rad; robot "
            f"{config.robot.name!r} allows {joint.limits.lower_rad:g} to {joint.limits.upper_rad:g} rad. Choose a "
            f"smoother route"
        )
    place_all(config)


@dataclass(frozen=True)
class StartPose:
    """Pose of the snake at tick 0."""

    position_w: tuple[float, float]  # of the tail end, on the ground
    yaw_rad: float
    angles_rad: NDArray[np.float64]  # (n_joints,), tail to head


def start_of(config: RunConfig) -> StartPose:
    """Start pose of the snake."""
    robot, start = config.robot, config.start
    route = route_of(config.scene)
    if not start.on_route or route is None:
        return StartPose(start.position_m, start.yaw_rad, np.zeros(robot.chain.modules))
    lay = lay_chain(route, start.tail_s_m, yaw_segments_m(robot.axes, robot.link_lengths_m))
    return StartPose(lay.tail_w, lay.heading_rad, chain_angles(robot.axes, lay.angles_rad))


def description_of(config: RunConfig, backend: str = "", *, emulated: bool = False) -> Description:
    """The robot in it. backend: its name for itself, where that may be another than the scenario's for it."""
    return describe(
        config.robot,
        backend=backend or config.backend,
        period_ns=config.period_ns,
        lease_ns=config.lease_ns,
        config_hash=config_hash(config),
        emulated=emulated,
    )


def capsules_at_start(config: RunConfig) -> list[Capsule]:
    """Outlines of the links at tick 0, from above."""
    robot, pose = config.robot, start_of(config)
    rotation = rotation_from_quaternion(quaternion_from_yaw(pose.yaw_rad))
    origins, rotations = link_frames(
        (*pose.position_w, robot.module.radius_m), rotation, pose.angles_rad, robot.axes, robot.link_lengths_m
    )
    capsules: list[Capsule] = []
    for i, length in enumerate(robot.link_lengths_m):
        front = origins[i] + length * rotations[i][:, 0]
        rear_m = (float(origins[i][0]), float(origins[i][1]))
        front_m = (float(front[0]), float(front[1]))
        capsules.append(Capsule(name=f"link_{i}", rear_m=rear_m, front_m=front_m, radius_m=robot.module.radius_m))
    return capsules


def place_all(config: RunConfig) -> list[Placed]:
    """The scene's obstacles, expanded, and checked against the snake's start pose."""
    snake = capsules_at_start(config)
    placed = place(config.scene, snake)
    check_clear(config.scene, placed, snake)
    return placed


def surveyed(config: RunConfig, *, walkable: bool = False) -> list[Obstacle]:
    """The obstacles that stand in the way, or what a snake may lie on, where the survey has it: off by its error."""
    known = [placed.obstacle for placed in place_all(config) if placed.walkable == walkable]
    error_m = config.mission.map_error_m
    if error_m == 0.0:
        return known
    found: list[Obstacle] = []
    errors = np.random.default_rng((config.seed, SURVEY + walkable)).normal(0.0, error_m, (len(known), 2))
    for obstacle, (off_x, off_y) in zip(known, errors.tolist(), strict=True):
        x, y, z = obstacle.position_w
        found.append(msgspec.structs.replace(obstacle, position_w=(x + off_x, y + off_y, z)))
    return found


def config_hash(config: RunConfig) -> str:
    """Hash of everything that the run's outcome depends on."""
    plain = json.dumps(msgspec.to_builtins(config), sort_keys=True)
    return hashlib.sha256(plain.encode()).hexdigest()[:16]


def written(config: RunConfig) -> bytes:
    """The effective configuration as JSON; `snakesim run` accepts it like a scenario file."""
    return msgspec.json.format(msgspec.json.encode(config), indent=2)


def write(config: RunConfig, path: Path) -> None:
    """Save the effective configuration."""
    write_whole(path, written(config))


def read(path: Path) -> RunConfig:
    """Read back a file saved by `write`, whatever its name."""
    return decode(read_table(path), RunConfig)
