"""What the scenario may say about any family of drives, and checks of it."""

from collections.abc import Collection
from typing import Annotated, Any

from msgspec import Meta

from snakesim_hal.drivers.mocap import check_pose
from snakesim_hal.drivers.mocap_twin import PoseSender
from snakesim_hal.drivers.mounted import Mounted, as_built, check_mounted
from snakesim_hal.drivers.twin_body import FAULTS, TwinBody, make_plant
from snakesim_hal.errors import ConfigError
from snakesim_hal.fault_plan import check_backend_can
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.joints import Joint
from snakesim_hal.model.scenario import RunConfig

ANSWERS_WITHIN = 0.5  # of a period: the rest is for the controller
LOCKSTEP_ANSWER_S = 2.0
MIN_PERIODS = 2.2  # in a watchdog's time


class DriveSettings(FileStruct, frozen=True, kw_only=True):
    """Fields that the settings of every family have; a family adds its ports."""

    watchdog_s: Annotated[float, Meta(ge=0.02, le=1, extra_json_schema={"unit": "s"})] = 0.1  # of the drives
    bring_up_limit_s: Annotated[float, Meta(gt=0, le=600, extra_json_schema={"unit": "s"})] = 10.0
    pose_listen: Annotated[str, Meta(pattern="^[^:]*:[0-9]{1,5}$")] | None = None  # of motion capture: HOST:PORT
    plant: str = "mujoco"  # body of emulated drives: an entry point in the group `snakesim.plants`
    plant_settings: dict[str, Any] = {}
    mounted: dict[str, Mounted] = {}  # of emulated drives: joint -> how it is mounted in truth


def body_of(config: RunConfig, settings: DriveSettings, backend: str, pose: str | None) -> TwinBody:
    """What emulated drives move. pose: where its motion capture sends, HOST:PORT. Raises ConfigError."""
    plant = make_plant(as_built(config, settings.mounted), backend, settings.plant, settings.plant_settings)
    return TwinBody(config, plant, settings.mounted, PoseSender(pose) if pose else None)


def check_settings(
    config: RunConfig, settings: DriveSettings, ports: Collection[str], *, twins: bool, bus_faults: Collection[str] = ()
) -> None:
    """Raise ConfigError for what no family could do.

    ports: names that a joint's `port` may be; twins: emulated drives are in this process; bus_faults: injected kinds.
    """
    check_pose(config, settings.pose_listen)
    check_mounted(config.robot, config.backend_section, settings.mounted, twins=twins)
    does = {*bus_faults, *(FAULTS if twins else ())}
    because = f"its emulated drives know {', '.join(FAULTS)}" if twins else "its drives are not emulated in its process"
    check_backend_can(config, does=does, buses=max(len(ports), 1), because=because)
    for joint in config.robot.joint_table:
        if joint.drive.port and joint.drive.port not in ports:
            raise ConfigError(
                f"{who(config, joint)}: `port` = {joint.drive.port!r} is not among those of "
                f"`{config.backend_section}`: {', '.join(ports) or 'none'}"
            )
    least_s = MIN_PERIODS / config.rate_hz
    if settings.watchdog_s < least_s:
        raise ConfigError(
            f"`{config.backend_section}.watchdog_s` = {settings.watchdog_s:g} s at `rate_hz` = {config.rate_hz:g}: "
            f"one lost set-point would stop the drives; give them {least_s:.3g} s or more"
        )


def answer_limit_s(config: RunConfig) -> float:
    """How long a tick may wait for answers; in lockstep a busy computer changes nothing."""
    return LOCKSTEP_ANSWER_S if config.pace == "lockstep" else ANSWERS_WITHIN * config.period_ns * 1e-9


def port_of(config: RunConfig, ports: Collection[str]) -> list[int]:
    """Number of every joint's bus: its `port`, or an even share of the robot from the tail; 0 without ports."""
    joints, numbers = config.robot.joint_table, {port: i for i, port in enumerate(ports)}
    each = -(-len(joints) // max(len(ports), 1))
    return [numbers.get(joint.drive.port, i // each) for i, joint in enumerate(joints)]


def who(config: RunConfig, joint: Joint) -> str:
    """A joint, as messages name it."""
    return f"robot {config.robot.name!r}, {joint.name}"
