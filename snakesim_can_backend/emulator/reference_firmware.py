"""The reference firmware in C as emulated joint modules: the program, and the file that describes its modules.

`snakesim_native/joint_module` has the firmware, and the program that runs it for every module of a robot. Each module
moves a simulated joint of its own. The program has no MuJoCo: no ground, no obstacles and no neighbors.
"""

import os
from pathlib import Path
from typing import NoReturn
from zlib import crc32

from snakesim_can_backend.emulator.module_slot import assign_node_ids
from snakesim_can_backend.settings import CanSettings
from snakesim_drivers.emulation.mounted import build_actual_joints
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.model.scenario import RunConfig, compute_start_pose
from snakesim_native.compile import CannotCompileError
from snakesim_native.programs import JOINT_MODULES, get_program

MIN_INERTIA_KG_M2 = 1e-6  # of a joint, so that it can be simulated


def validate_firmware_settings(settings: CanSettings) -> None:
    """Check that the emulators in C have everything that the settings ask for.

    Raises:
        ConfigError: The settings have planned faults, or a module without a motor.
    """
    if settings.faults:
        raise ConfigError(
            "`backends.can.faults`: the reference firmware has no planned faults; put them into the scenario's "
            "`faults`, or type them, such as `mute joint_3`",
            code="injection/not-supported",
        )
    disconnected = [name for name, mount in settings.mounted.items() if not mount.connected]
    if disconnected:
        raise ConfigError(
            f"`backends.can.mounted`: every module of the reference firmware has a motor; remove `connected` of "
            f"{', '.join(disconnected)}",
            code="drive/unsupported-setting",
        )


def build_program() -> Path:
    """Return the compiled program. Raises BackendError if it cannot be compiled here."""
    try:
        return get_program(JOINT_MODULES)
    except (CannotCompileError, OSError) as error:
        raise BackendError(
            f"the reference firmware cannot be compiled: {error}", code="emulator/not-started"
        ) from error


def make_program_arguments(
    bus_folder: str, modules_path: str, duration_s: float | None = None, *, is_stepped: bool
) -> list[str]:
    """Return the arguments of the program.

    Args:
        bus_folder: Folder of its bus, as in the channel local:FOLDER.
        modules_path: Path of the file that describes the modules.
        duration_s: Time in s after which it ends; None for never.
        is_stepped: Whether time advances only from Sync to Sync.
    """
    arguments = ["--bus", bus_folder, "--modules", modules_path]
    if is_stepped:
        arguments.append("--stepped")
    if duration_s is not None:
        arguments += ["--duration", f"{duration_s:g}"]
    return arguments


def replace_this_process(
    config: RunConfig,
    settings: CanSettings,
    bus_folder: str,
    *,
    duration_s: float | None,
    is_stepped: bool,
) -> NoReturn:
    """Run the program instead of this process. The description of its modules is a file in memory.

    Args:
        config: Configuration of the run, with the robot.
        settings: Settings of the backend.
        bus_folder: Folder of the bus of the program, as in the channel local:FOLDER.
        duration_s: Time in s after which it ends; None for never.
        is_stepped: Whether time advances only from Sync to Sync.

    Raises:
        BackendError: The program cannot be compiled.
    """
    program = build_program()
    # Without MFD_CLOEXEC, so that the program can read it.
    descriptor = os.memfd_create("modules", 0)
    os.write(descriptor, describe_modules(config, settings).encode())
    modules_path = f"/proc/self/fd/{descriptor}"
    arguments = make_program_arguments(bus_folder, modules_path, duration_s, is_stepped=is_stepped)
    os.execv(program, [str(program), *arguments])


def describe_modules(config: RunConfig, settings: CanSettings) -> str:
    """Return the text that describes every module: one line each, tail to head, with values at the module's shaft.

    Args:
        config: Configuration of the run, with robot and start pose.
        settings: Settings of the backend, with the modules that are mounted otherwise than in the robot file.
    """
    robot = config.robot
    joints = build_actual_joints(robot, settings.mounted)
    node_ids = assign_node_ids(robot, settings)
    angles_rad = compute_start_pose(config).angles_rad
    lines: list[str] = []
    for i, joint in enumerate(joints):
        link_inertia_kg_m2 = robot.link_masses_kg[i + 1] * robot.link_lengths_m[i + 1] ** 2 / 12
        values = _describe_joint(joint, link_inertia_kg_m2, angles_rad[i])
        # The manufacturer sets the ratings, and does not know which gear the module will get.
        gear = robot.joint_table[i].drive.gear
        values["rated_torque_nm"] = joint.limits.torque_nm / gear
        values["rated_speed_rad_s"] = joint.limits.speed_rad_s * gear
        values["node"] = node_ids[i]
        values["serial"] = crc32(f"{config.seed}:{i + 1}".encode())
        values["has_imu"] = float(robot.sensors.imu is not None)
        pairs = " ".join(f"{key} {value:.12g}" for key, value in values.items())
        lines.append(f"{joint.name} {pairs}\n")
    return "".join(lines)


def _describe_joint(joint: Joint, link_inertia_kg_m2: float, start_rad: float) -> dict[str, float]:
    """Return what a joint is, as seen at the shaft of its module: behind gear, sign and zero.

    Args:
        joint: The joint as it is really built.
        link_inertia_kg_m2: Inertia of the link that it moves, about the link's middle.
        start_rad: Angle of the joint at the start.
    """
    motor = joint.motor
    limits = joint.limits
    drive = joint.drive
    ratio = drive.sign * drive.gear
    ends_rad = sorted(
        drive.zero_rad + ratio * angle for angle in (limits.lower_rad, limits.upper_rad)
    )
    inertia_kg_m2 = max(motor.armature_kg_m2 + link_inertia_kg_m2, MIN_INERTIA_KG_M2)
    return {
        "response_time_s": motor.response_time_s,
        "inertia_kg_m2": inertia_kg_m2 / drive.gear**2,
        "viscous_nm_s_per_rad": motor.viscous_nm_s_per_rad / drive.gear**2,
        "friction_nm": motor.friction_nm / drive.gear,
        "lower_rad": ends_rad[0],
        "upper_rad": ends_rad[1],
        "start_rad": drive.zero_rad + ratio * start_rad,
        "ambient_c": joint.heat.ambient_c,
        "rise_per_torque_squared": joint.heat.rise_at_rated_k / joint.rated_nm**2 * drive.gear**2,
        "time_constant_s": joint.heat.time_constant_s,
        "board_fraction": joint.heat.board_fraction,
        "derate_from_c": limits.derate_from_c,
        "stop_at_c": limits.stop_at_c,
        "voltage_v": joint.supply.voltage_v,
        "min_voltage_v": limits.min_voltage_v,
        "idle_a": joint.supply.idle_a,
    }
