"""What a qualification runs on: the scenario of one drive, and for emulated drives their bus."""

import platform
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec

from snakesim_hal.backend import Backend
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.scenario import KeyOverride, RunConfig, load_scenario, parse_set_option
from snakesim_hal.model.textfiles import write_text
from snakesim_hal.programs.preflight import (
    decode_backend_settings,
    load_backend_class,
    validate_and_complete_config,
)
from snakesim_operator.features.qualification.protocol.record import Computer
from snakesim_operator.features.qualification.protocol.steps import Bounds

MAX_TORQUE_NM = 2.0  # of the joint in its robot file; the first hour needs no more
MAX_TRAVEL_RAD = 0.35  # of the joint to either side, in its robot file
SERIAL_BUS = "servos"  # link to the pseudo terminal of emulated servos
# Friction of the emulated joint: it is more than the blocked joint's torque limit.
EMULATED_DRAG_NM = 0.35

ROBOT = """\
extends = "planar13"
name = "one_drive"
description = "One clamped drive, with low limits, for its first hour."

[chain]
modules = 1
axes = ["yaw"]

[limits]
angle_rad = 0.2
speed_rad_s = 0.5
acceleration_rad_s2 = 10.0
torque_nm = 1.0
torque_rate_nm_s = 20.0

[safety]
max_step_rad = 0.1
"""
SCENARIO = """\
title = "The first hour with one drive"
robot = "./one_drive.toml"
scene = "flat"
controller = "hold"
clock_mode = "realtime"
rate_hz = 50
duration_s = 3600
seed = 1

[start]
on_route = false

[services.control]
"""


@dataclass(frozen=True)
class Request:
    """What the command line asks for."""

    driver_type: str
    folder: Path
    scenario: Path | None = None  # None: one that is written into the folder
    channel: str | None = None  # None: that of the scenario, or an emulated drive
    sets: Sequence[str] = ()
    emulator_sets: Sequence[str] = ()  # of the emulated drive alone


@dataclass(frozen=True)
class Setup:
    """A checked configuration of one drive."""

    config: RunConfig
    backend: Any  # class of the driver type
    settings: Any  # an instance of its own `Settings`
    is_emulated: bool
    bus: str  # channel or port
    bounds: Bounds


def make_setup(request: Request) -> Setup:
    """Load and check the configuration of a qualification.

    Args:
        request: What the command line asks for. Without a channel in it or in its scenario, the drive is emulated.

    Raises:
        ConfigError: The configuration has not exactly one joint, its limits are too high, or it is invalid.
    """
    backend = load_backend_class(request.driver_type)
    port_key = find_port_key(backend, request.driver_type)
    scenario = str(request.scenario or write_scenario(request.folder))
    overrides = [
        KeyOverride("backend", request.driver_type, "drive qualify"),
        KeyOverride("clock_mode", "realtime", "drive qualify"),
        KeyOverride("services.control.external", True, "drive qualify"),
        *map(parse_set_option, request.sets),
    ]
    if request.channel is not None:
        overrides.append(KeyOverride(f"backend.{port_key}", [request.channel], "--channel"))
    loaded = load_scenario(scenario, overrides)
    settings = decode_backend_settings(loaded.config, backend, loaded.table)
    is_emulated = not getattr(settings, port_key)
    if is_emulated:
        channel = make_emulated_channel(port_key, request.folder)
        overrides += [
            KeyOverride(f"backend.{port_key}", [channel], "drive qualify"),
            KeyOverride("backend.physics_model", "inertia", "drive qualify"),
            KeyOverride(
                "backend.physics_model_settings.drag_nm", EMULATED_DRAG_NM, "drive qualify"
            ),
        ]
        loaded = load_scenario(scenario, overrides)
        settings = decode_backend_settings(loaded.config, backend, loaded.table)
    elif request.emulator_sets:
        raise ConfigError(
            f"--emulator-set {request.emulator_sets[0]}: the drive on {getattr(settings, port_key)[0]} is not "
            f"emulated; leave the option out",
            code="config/conflict",
        )
    config = loaded.config
    check_limits(config)
    ports: Sequence[str] = getattr(settings, port_key)
    if not is_emulated:  # the port of emulated servos is made later
        config = validate_and_complete_config(config, loaded.table)
    bounds = Bounds(
        has_watchdog=getattr(backend, "has_watchdog", True),
        watchdog_s=settings.watchdog_s,
        period_s=config.period_ns * 1e-9,
        polling_feeds_watchdog=getattr(backend, "polling_feeds_watchdog", False),
    )
    return Setup(config, backend, settings, is_emulated, ports[0], bounds)


def find_port_key(backend: type[Backend], driver_type: str) -> str:
    """Return the name of the setting with the buses of a driver type. Raises ConfigError if it has none."""
    fields = {field.name for field in msgspec.structs.fields(backend.Settings)}
    for key in ("channels", "ports"):
        if key in fields and hasattr(backend, "open_probe"):
            return key
    raise ConfigError(
        f"drive qualify {driver_type}: this backend has no drives on a bus; give a driver type, such as odrive",
        code="drive/unsupported-setting",
    )


def make_emulated_channel(port_key: str, folder: Path) -> str:
    """Return the channel or port of an emulated drive, in the folder of the record."""
    if port_key == "ports":
        return str(folder / SERIAL_BUS)
    return f"local:{folder / 'bus'}"


def write_scenario(folder: Path) -> Path:
    """Write the scenario and the robot file of one drive into a folder, unless they are there. Return the scenario."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in (("one_drive.toml", ROBOT), ("first_hour.toml", SCENARIO)):
        if not (folder / name).exists():
            write_text(folder / name, text)
    return folder / "first_hour.toml"


def check_limits(config: RunConfig) -> None:
    """Check that there is one joint, and that its robot file allows little travel and torque only.

    Raises:
        ConfigError: One of these is not true.
    """
    joints = config.robot.joint_table
    if len(joints) != 1:
        raise ConfigError(
            f"robot {config.robot.name!r} has {len(joints)} joints: the first hour is for one drive. Set "
            f"`[chain] modules = 1` in a robot file for it",
            code="config/conflict",
        )
    limits = joints[0].limits
    travel_rad = max(abs(limits.lower_rad), abs(limits.upper_rad))
    if travel_rad > MAX_TRAVEL_RAD:
        raise ConfigError(
            f"robot {config.robot.name!r}: `limits.angle_rad` allows {travel_rad:g} rad; for the first hour at most "
            f"{MAX_TRAVEL_RAD:g} rad. Lower it in a robot file for one drive",
            code="config/out-of-range",
        )
    if limits.torque_nm > MAX_TORQUE_NM:
        raise ConfigError(
            f"robot {config.robot.name!r}: `limits.torque_nm` = {limits.torque_nm:g} N·m; for the first hour at most "
            f"{MAX_TORQUE_NM:g} N·m. Lower it in a robot file for one drive",
            code="config/out-of-range",
        )


def describe_computer() -> Computer:
    """Return what the record contains about this computer."""
    system = platform.uname()
    return Computer(
        name=system.node,
        kernel=f"{system.system} {system.release}",
        machine=system.machine,
        python=platform.python_version(),
        snakesim=version("snakesim"),
    )


def detect_adapter(bus: str) -> str:
    """Return the kernel driver of an adapter, such as "gs_usb"; "unknown" if it cannot be found."""
    name = Path(bus).name
    for folder in (Path("/sys/class/net", name), Path("/sys/class/tty", name)):
        driver = folder / "device" / "driver"
        if driver.exists():
            return driver.resolve().name
    return "unknown"
