"""Settings that every driver type has in the scenario, and checks of them before a start."""

from collections.abc import Collection, Mapping, Sequence
from typing import Annotated, Any

from msgspec import Meta

from snakesim_drivers.emulation.emulated_body import FAULTS, EmulatedBody
from snakesim_drivers.emulation.mounted import Mounted, check_mounted
from snakesim_drivers.emulation.shared_physics import SharedPhysics, make_physics_model
from snakesim_drivers.motion_capture.emulated_mocap import PoseSender
from snakesim_drivers.motion_capture.mocap import check_pose
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fault_plan import check_backend_can
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.joints import Joint
from snakesim_hal.model.scenario import RunConfig

ANSWER_PERIODS = 0.5  # control cycles that drives have for an answer: the rest is for the controller
LOCKSTEP_ANSWER_S = 2.0  # robot time does not pass while the driver waits, so a busy computer changes nothing
MIN_WATCHDOG_PERIODS = 2.2  # setpoint periods in a watchdog's time: one lost setpoint must not stop a drive
MIN_LEASE_ROUNDS = 1.5  # readings of a bus in a lease: its joint states have to be younger than a lease


class BodySettings(FileStruct, frozen=True, kw_only=True):
    """Settings that concern a robot as a whole, whatever its drives."""

    pose_listen: Annotated[str, Meta(pattern="^[^:]*:[0-9]{1,5}$")] | None = None
    """UDP address HOST:PORT at which the pose from motion capture arrives; none: there is no motion capture."""

    physics_model: str = "mujoco"
    """Body that emulated drives move: `mujoco`, `inertia`, or another installed physics model."""

    physics_model_settings: dict[str, Any] = {}
    """Settings of the physics model, which checks them."""

    mounted: Mapping[str, Mounted] = {}
    """For joints of emulated drives, how each is really mounted, to see what a wrong robot file does."""


class DriveSettings(BodySettings, frozen=True, kw_only=True):
    """Settings that every driver type has; a driver type adds its ports."""

    watchdog_s: Annotated[float, Meta(ge=0.02, le=1, extra_json_schema={"unit": "s"})] = 0.1
    """Time without a setpoint after which a drive stops by itself."""

    bring_up_limit_s: Annotated[float, Meta(gt=0, le=600, extra_json_schema={"unit": "s"})] = 10.0
    """Time limit for finding and configuring all drives at the start."""

    decimation: Annotated[int, Meta(ge=1, le=100)] = 1
    """Control cycles from one reading of a bus to the next."""


def make_body(config: RunConfig, settings: BodySettings, backend: str, pose_address: str | None) -> EmulatedBody:
    """Create the body that the emulated drives of a whole robot move.

    Args:
        config: Configuration of the run, with the robot and the settings of its backend.
        settings: The settings of the backend.
        backend: The backend's name.
        pose_address: HOST:PORT to which its emulated motion capture sends; None: it does not send.

    Raises:
        ConfigError: the physics model is unknown, or the address is malformed.
    """
    physics_model = make_physics_model(config, settings, backend)
    send_pose = PoseSender(pose_address) if pose_address else None
    physics = SharedPhysics(config, physics_model, settings.mounted, send_pose)
    return EmulatedBody(physics, range(config.robot.chain.modules))


def check_body(
    config: RunConfig, settings: BodySettings, *, emulators: bool, buses: int, bus_faults: Collection[str] = ()
) -> None:
    """Check the settings that all drive types share: motion capture, mounting and injected faults.

    Args:
        config: Configuration of the run, with the robot and the settings of its backend.
        settings: The settings of the backend.
        emulators: Whether this process emulates the drives.
        buses: Number of buses that the settings name.
        bus_faults: Kinds of faults that can be injected into these buses.

    Raises:
        ConfigError: a setting or a fault does not suit the robot.
    """
    check_pose(config, settings.pose_listen)
    check_mounted(config.robot, config.backend_section, settings.mounted, emulators=emulators)
    possible_faults = {*bus_faults}
    if emulators:
        possible_faults |= {*FAULTS}
        because = f"its emulated drives know {', '.join(FAULTS)}"
    else:
        because = "its drives are not emulated in its process"
    if config.clock_mode == "lockstep" and emulators:
        because += "; and in lockstep no bus is slow"
    else:
        possible_faults.add("slow")
    check_backend_can(config, does=possible_faults, buses=max(buses, 1), because=because)


def check_buses(
    config: RunConfig, settings: DriveSettings, section: str, joints: Sequence[Joint], ports: Collection[str]
) -> None:
    """Check the ports of joints, the watchdog time and the rate of the buses.

    Args:
        config: Configuration of the run, with the robot and the settings of its backend.
        settings: The settings of the driver type.
        section: Where the scenario has them, for messages.
        joints: The joints of the driver type.
        ports: The names that a joint's `port` may be.

    Raises:
        ConfigError: a port does not exist, or times do not suit each other.
    """
    for joint in joints:
        if joint.drive.port and joint.drive.port not in ports:
            raise ConfigError(
                f"{joint_label(config, joint)}: `port` = {joint.drive.port!r} is not among those of "
                f"`{section}`: {', '.join(ports) or 'none'}",
                code="bus/invalid-channel",
            )
    _check_watchdog(config, settings, section)
    _check_decimation(config, settings.decimation, section)


def _check_watchdog(config: RunConfig, settings: DriveSettings, section: str) -> None:
    decimation = settings.decimation
    min_s = MIN_WATCHDOG_PERIODS * decimation / config.rate_hz
    if settings.watchdog_s >= min_s:
        return
    decimation_text = f" and `decimation` = {decimation}" if decimation > 1 else ""
    raise ConfigError(
        f"`{section}.watchdog_s` = {settings.watchdog_s:g} s at `rate_hz` = {config.rate_hz:g}{decimation_text}: "
        f"one lost setpoint would stop the drives; give them {min_s:.3g} s or more",
        code="drive/watchdog-too-short",
    )


def _check_decimation(config: RunConfig, decimation: int, section: str) -> None:
    max_decimation = int(config.lease_ns / (MIN_LEASE_ROUNDS * config.period_ns))
    if decimation <= max_decimation:
        return
    age_ms = 1000 * decimation / config.rate_hz
    raise ConfigError(
        f"`{section}.decimation` = {decimation} at `rate_hz` = {config.rate_hz:g}: its joint states would be "
        f"{age_ms:.0f} ms old, and a lease is {config.lease_ns * 1e-6:.0f} ms; at most {max_decimation}",
        code="drive/watchdog-too-short",
    )


def answer_limit_s(config: RunConfig, decimation: int = 1) -> float:
    """Return how long a bus may wait for the answers of its drives."""
    if config.clock_mode == "lockstep":
        return LOCKSTEP_ANSWER_S
    return ANSWER_PERIODS * decimation * config.period_ns * 1e-9


def assign_ports(joints: Sequence[Joint], ports: Collection[str]) -> list[int]:
    """Return for every joint the index of its port.

    A joint without a `port` gets the port of its share: joints are distributed evenly, from the tail on. Without any
    ports all joints get index 0.
    """
    numbers = {port: i for i, port in enumerate(ports)}
    joints_per_port = -(-len(joints) // max(len(ports), 1))  # rounded up
    return [numbers.get(joint.drive.port, i // joints_per_port) for i, joint in enumerate(joints)]


def joint_label(config: RunConfig, joint: Joint) -> str:
    """Return a joint with its robot, as messages name it."""
    return f"robot {config.robot.name!r}, {joint.name}"
