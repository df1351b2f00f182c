"""What the scenario may say about any driver type of drives, and checks of it."""

from collections.abc import Collection, Mapping, Sequence
from typing import Annotated, Any

from msgspec import Meta

from snakesim_drivers.emulation.emulated_body import FAULTS, EmulatedBody, SharedPhysics, make_physics_model
from snakesim_drivers.emulation.mounted import Mounted, check_mounted
from snakesim_drivers.motion_capture.emulated_mocap import PoseSender
from snakesim_drivers.motion_capture.mocap import check_pose
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fault_plan import check_backend_can
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.joints import Joint
from snakesim_hal.model.scenario import RunConfig

ANSWERS_WITHIN = 0.5  # of a period: the rest is for the controller
LOCKSTEP_ANSWER_S = 2.0
MIN_PERIODS = 2.2  # in a watchdog's time
MIN_ROUNDS = 1.5  # of a bus in a lease: its joint states have to be younger


class BodySettings(FileStruct, frozen=True, kw_only=True):
    """Fields that concern a robot as a whole, whatever its drives."""

    pose_listen: Annotated[str, Meta(pattern="^[^:]*:[0-9]{1,5}$")] | None = None  # of motion capture: HOST:PORT
    physics_model: str = "mujoco"  # body of emulated drives: an entry point in the group `snakesim.physics_models`
    physics_model_settings: dict[str, Any] = {}
    mounted: Mapping[str, Mounted] = {}  # of emulated drives: joint -> how it is mounted in truth


class DriveSettings(BodySettings, frozen=True, kw_only=True):
    """Fields that the settings of every driver type have; a driver type adds its ports."""

    watchdog_s: Annotated[float, Meta(ge=0.02, le=1, extra_json_schema={"unit": "s"})] = 0.1  # of the drives
    bring_up_limit_s: Annotated[float, Meta(gt=0, le=600, extra_json_schema={"unit": "s"})] = 10.0
    decimation: Annotated[int, Meta(ge=1, le=100)] = 1  # of the run: how often its buses ask and tell


def make_body(config: RunConfig, settings: BodySettings, backend: str, pose: str | None) -> EmulatedBody:
    """What emulated drives move. pose: where its motion capture sends, HOST:PORT. Raises ConfigError."""
    physics_model = make_physics_model(config, settings, backend)
    motion = SharedPhysics(config, physics_model, settings.mounted, PoseSender(pose) if pose else None)
    return EmulatedBody(motion, range(config.robot.chain.modules))


def check_body(
    config: RunConfig, settings: BodySettings, *, emulators: bool, buses: int, bus_faults: Collection[str] = ()
) -> None:
    """Raise ConfigError for what no robot of drives could do.

    emulators: emulated drives are in this process; bus_faults: injected kinds.
    """
    check_pose(config, settings.pose_listen)
    check_mounted(config.robot, config.backend_section, settings.mounted, emulators=emulators)
    does = {*bus_faults, *(FAULTS if emulators else ())}
    because = (
        f"its emulated drives know {', '.join(FAULTS)}" if emulators else "its drives are not emulated in its process"
    )
    if config.clock_mode == "lockstep" and emulators:
        because += "; and in lockstep no bus is slow"
    else:
        does.add("slow")
    check_backend_can(config, does=does, buses=max(buses, 1), because=because)


def check_buses(
    config: RunConfig, settings: DriveSettings, section: str, joints: Sequence[Joint], ports: Collection[str]
) -> None:
    """Raise ConfigError for ports that are not there, and for times that do not suit each other.

    section: of the settings; ports: names that a joint's `port` may be.
    """
    for joint in joints:
        if joint.drive.port and joint.drive.port not in ports:
            raise ConfigError(
                f"{joint_label(config, joint)}: `port` = {joint.drive.port!r} is not among those of "
                f"`{section}`: {', '.join(ports) or 'none'}"
            )
    every, min_s = settings.decimation, MIN_PERIODS * settings.decimation / config.rate_hz
    if settings.watchdog_s < min_s:
        often = f" and `decimation` = {every}" if every > 1 else ""
        raise ConfigError(
            f"`{section}.watchdog_s` = {settings.watchdog_s:g} s at `rate_hz` = {config.rate_hz:g}{often}: "
            f"one lost setpoint would stop the drives; give them {min_s:.3g} s or more"
        )
    most = int(config.lease_ns / (MIN_ROUNDS * config.period_ns))
    if every > most:
        raise ConfigError(
            f"`{section}.decimation` = {every} at `rate_hz` = {config.rate_hz:g}: its joint states would be "
            f"{1000 * every / config.rate_hz:.0f} ms old, and a lease is {config.lease_ns * 1e-6:.0f} ms; "
            f"at most {most}"
        )


def answer_limit_s(config: RunConfig, decimation: int = 1) -> float:
    """How long a tick, or a bus, may wait for answers; in lockstep a busy computer changes nothing."""
    if config.clock_mode == "lockstep":
        return LOCKSTEP_ANSWER_S
    return ANSWERS_WITHIN * decimation * config.period_ns * 1e-9


def assign_ports(joints: Sequence[Joint], ports: Collection[str]) -> list[int]:
    """Number of every joint's bus: its `port`, or an even share of these joints from the tail; 0 without ports."""
    numbers = {port: i for i, port in enumerate(ports)}
    each = -(-len(joints) // max(len(ports), 1))
    return [numbers.get(joint.drive.port, i // each) for i, joint in enumerate(joints)]


def joint_label(config: RunConfig, joint: Joint) -> str:
    """A joint, as messages name it."""
    return f"robot {config.robot.name!r}, {joint.name}"
