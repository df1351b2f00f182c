"""The effective configuration of a run: what runs, in which time, and what the parts of the run do."""

import hashlib
import json
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from snakesim_hal.base.atomic_write import write_atomically
from snakesim_hal.model.fault_kinds import CONTROL
from snakesim_hal.model.files import FileStruct, decode_table, read_table
from snakesim_hal.model.robot_file.robot import RobotFile, describe_robot
from snakesim_hal.model.scenario.mission import Mission, StartPlacement
from snakesim_hal.model.scene_file.scene import SceneFile
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ClockMode, RobotDescription
from snakesim_hal.wire.quantities import above

# Name of the service that publishes cameras, motion capture and other sensors which the backend does not have.
SENSOR = "sensor"
# Prefix of a controller name that is followed by the model of a policy.
POLICY = "policy:"
POLICY_CONTROLLER = POLICY[:-1]
NS_PER_S = 1e9
LEASE_PERIODS = 5  # a lease outlasts a few lost commands
MIN_LEASE_NS = 50_000_000
MAX_LEASE_NS = 100_000_000  # a robot whose controller is gone moves no longer than this
Seconds = Annotated[float, above(60, "s")]


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
    """With `snakesim run --stay`, true: the run starts the process again when it ends. False: the run ends with it."""

    external: bool = False
    """True: the run waits for the process of the service, but does not start it."""

    process: Literal["own", "host"] = "own"
    """`own`: the service has a process of its own. `host`: it is a thread in the process of the HAL host."""

    plugin: str = ""
    """Name of an installed service, or ./file.py:Class. Empty: the installed service of the section's name."""

    def used_output_tick(self, tick: int) -> int:
        """Return the newest tick whose output is used at `tick`; at the start, the output of tick 0 is used early."""
        due_tick = max(tick - self.latency_ticks, 0)
        return due_tick - due_tick % self.decimation


class MaxAge(FileStruct, frozen=True, kw_only=True):
    """Maximum age of the inputs of control, in robot time. The defaults follow from rates, delays and schedules.

    If the joint states are older, control sends no command, so the lease ends and the robot stops. If a pose, contacts,
    an image, a world or a trajectory is older, the controller holds, and resumes when the stream is back.
    """

    joints_s: Seconds | None = None
    """Maximum age of the joint states. None: it follows from rates, delays and schedules."""

    pose_s: Seconds | None = None
    """Maximum age of the pose. None: it follows from rates, delays and schedules."""

    contacts_s: Seconds | None = None
    """Maximum age of the contacts. None: it follows from rates, delays and schedules."""

    depth_s: Seconds | None = None
    """Maximum age of the newest image or ranges in a perceived map. None: it follows from rates, delays and schedules.
    """

    world_s: Seconds | None = None
    """Maximum age of the world that guidance publishes. None: it follows from rates, delays and schedules."""

    trajectory_s: Seconds | None = None
    """Maximum age of the trajectory that navigation publishes. None: it follows from rates, delays and schedules."""


class RunConfig(FileStruct, frozen=True, kw_only=True):
    """The whole configuration of a run."""

    name: Annotated[str, Meta(min_length=1, max_length=60)]
    """Name of the scenario. A file may leave it out, and has its file name then."""

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
    """How robot time passes. `realtime`: by the wall clock. `lockstep`: the host waits for the services in every cycle.
    `free`: as fast as possible.
    """

    rate_hz: Annotated[float, Meta(ge=20, le=5000, extra_json_schema={"unit": "Hz"})] = 100.0
    """Rate of the control cycle."""

    duration_s: Annotated[float, Meta(gt=0, le=86400, extra_json_schema={"unit": "s"})] = 10.0
    """Duration of the run in robot time."""

    seed: Annotated[int, Meta(ge=0, le=2**31)] = 1
    """Seed of all random numbers of the run."""

    faults: list[str] = []
    """Faults to inject, at times since the first arming, such as "kill:control@2". See docs/how-to/inject-faults.md."""

    allow_fault_injection: bool = False
    """True: faults may be injected also on a robot whose motors really move."""

    stall_limit_s: Annotated[float, Meta(gt=0, le=600, extra_json_schema={"unit": "s"})] = 10.0
    """Wall time for which the host waits in lockstep for the output of a service, before it continues without it."""

    start_limit_s: Annotated[float, Meta(gt=0, le=3600, extra_json_schema={"unit": "s"})] = 60.0
    """Wall time within which all services must be ready to arm."""

    # What the parts of the run do.
    start: StartPlacement = StartPlacement()
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
        return f"controllers.{get_section_name(self.controller)}"

    @property
    def controller_parameters(self) -> dict[str, Any]:
        """Return the parameters of the chosen controller."""
        return self.controllers.get(get_section_name(self.controller), {})

    @property
    def backend_section(self) -> str:
        """Return the section with the settings of the chosen backend: `backends.Bench` for `./file.py:Bench`."""
        return f"backends.{get_section_name(self.backend)}"

    @property
    def backend_settings(self) -> dict[str, Any]:
        """Return the settings of the chosen backend."""
        return self.backends.get(get_section_name(self.backend), {})

    @property
    def internal_services(self) -> dict[str, ServiceSchedule]:
        """Return the services that the run starts itself."""
        return {name: service for name, service in self.services.items() if not service.external}

    @property
    def in_host_services(self) -> list[str]:
        """Return the names of the services that run in the process of the HAL host."""
        return [
            name for name, service in self.internal_services.items() if service.process == "host"
        ]

    @property
    def has_internal_control(self) -> bool:
        """Return whether the run starts a controller; otherwise an external controller also arms the robot."""
        return CONTROL in self.internal_services

    @property
    def commander_name(self) -> str:
        """Return the name of the controller, with the model of a policy; `external` if the run starts no controller."""
        if not self.has_internal_control:
            return "external"
        if self.controller == POLICY_CONTROLLER:
            model = self.controller_parameters.get("model")
            if model:
                return f"{POLICY}{model}"
        return self.controller

    def uses_dead_reckoning(self, robot: RobotDescription) -> bool:
        """Return whether guidance estimates the pose by dead reckoning.

        It does if the mission demands it, and also if neither the robot nor a service measures the pose.
        """
        if self.mission.localization == "dead_reckoning":
            return True
        robot_publishes_pose = any(sensor.key == keys.POSE for sensor in robot.sensors)
        has_pose_sensor = (
            robot_publishes_pose or self.robot.sensors.pose is not None or SENSOR in self.services
        )
        return not has_pose_sensor

    @property
    def period_ns(self) -> int:
        """Return the duration of one control period."""
        return round(NS_PER_S / self.rate_hz)

    @property
    def lease_ns(self) -> int:
        """Return the duration of a lease: five periods or 50 ms, whichever is longer, but at most 100 ms."""
        duration_ns = max(LEASE_PERIODS * self.period_ns, MIN_LEASE_NS)
        return min(duration_ns, MAX_LEASE_NS)


def get_section_name(plugin_name: str) -> str:
    """Return the name of a plugin's section: the class, for a plugin in a file such as `./file.py:Wave`."""
    return plugin_name.rpartition(":")[2]


def compute_config_hash(config: RunConfig) -> str:
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
    """Read a configuration file that `write_config` has written, whatever its name."""
    return decode_table(read_table(path), RunConfig)


def describe_run_robot(
    config: RunConfig, backend: str = "", *, emulated: bool = False
) -> RobotDescription:
    """Return the description that the HAL publishes of the configured robot.

    Args:
        config: Configuration of the run.
        backend: Name that the backend gives itself. Empty for the name in the scenario.
        emulated: Whether no real motor moves.
    """
    return describe_robot(
        config.robot,
        backend=backend or config.backend,
        period_ns=config.period_ns,
        lease_ns=config.lease_ns,
        config_hash=compute_config_hash(config),
        emulated=emulated,
    )
