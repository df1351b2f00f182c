"""The backend `odrive`: settings, checks, and the buses that it opens."""

import uuid
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from snakesim_can_backend.bus.adapter import check_channel, is_emulated, open_wire
from snakesim_can_backend.bus.bus import VirtualWire, Wire
from snakesim_can_backend.bus.load import MAX_LOAD, worst_bits
from snakesim_can_backend.bus.log import LoggedWire, open_log
from snakesim_can_backend.odrive.axes import Axes
from snakesim_can_backend.odrive.protocol import LAST_NODE
from snakesim_can_backend.odrive.twin import OdriveTwin
from snakesim_hal.drivers.drive_backend import Clock, DriveBackend
from snakesim_hal.drivers.drive_settings import DriveSettings, answer_limit_s, check_settings, port_of, who
from snakesim_hal.drivers.mocap import receiver
from snakesim_hal.drivers.mocap_twin import PoseSender
from snakesim_hal.drivers.readings import Readings
from snakesim_hal.drivers.twin_body import TwinBody, make_plant
from snakesim_hal.errors import ConfigError
from snakesim_hal.injection import KINDS
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.physics.motor import check_gains
from snakesim_hal.wire.messages import Pace

NAME = "odrive"
HEARTBEATS_HZ = 10
TWIN_CONSTANT = 1.0  # N·m/A, of twins whose robot file says none


class OdriveSettings(DriveSettings, frozen=True, kw_only=True):
    """The scenario's `[backends.odrive]` section. `watchdog_s` is what the axes have in `watchdog_timeout`."""

    # Buses: SocketCAN interfaces such as can0, or INTERFACE:CHANNEL of python-can. Empty: emulated axes, here.
    channels: Annotated[list[Annotated[str, Meta(min_length=1, max_length=127)]], Meta(max_length=8)] = []
    bit_rate: Annotated[int, Meta(ge=10_000, le=1_000_000, extra_json_schema={"unit": "bit/s"})] = 1_000_000
    log: str = ""  # candump file of all frames; empty: none


class OdriveBackend(DriveBackend):
    """A `snakesim_hal.backend.Backend` on ODrive axes, real or emulated."""

    Settings = OdriveSettings

    @staticmethod
    def check(config: RunConfig, settings: OdriveSettings) -> tuple[Pace, ...]:
        """Axes on a bus support real time only; emulated ones in this process lockstep, too. Raises ConfigError."""
        check_gains(config.robot)
        here = not settings.channels
        bus_faults = {*KINDS["bus"]} - (set() if here else {"full"})
        check_settings(config, settings, settings.channels, twins=here, bus_faults=bus_faults)
        for channel in settings.channels:
            check_channel(channel)
        check_joints(config, settings)
        check_load(config, settings)
        return ("lockstep", "realtime") if here else ("realtime",)

    def __init__(self, config: RunConfig, settings: OdriveSettings) -> None:
        """Open the buses and find every axis; nothing is enabled. Raises ConfigError and BackendError."""
        self.check(config, settings)
        clock = Clock(config)
        own = not settings.channels
        mocap = receiver(config, settings.pose_listen, twins=own, clock=lambda _stamp_ns: clock.ns())
        joints = config.robot.joint_table

        def make_axes(readings: Readings) -> Axes:
            pose = mocap.address if mocap is not None and own else None
            twin = None
            if own:
                name = f"virtual-{uuid.uuid4().hex[:8]}"
                twin = twin_on(config, settings, [VirtualWire(name)], clock, pose)
                wires: list[Wire] = [VirtualWire(name, twin)]
            else:
                wires = [open_wire(channel, bit_rate=settings.bit_rate) for channel in settings.channels]
            if settings.log:
                log = open_log(Path(settings.log))
                wires = [LoggedWire(wire, log) for wire in wires]
            return Axes(
                joints,
                [wires[bus] for bus in port_of(config, settings.channels)],
                constants(config),
                readings,
                twin=twin,
                emulated=all(map(is_emulated, settings.channels)),
                answer_s=answer_limit_s(config),
                bring_up_s=settings.bring_up_limit_s,
                clock_ns=clock.ns,
            )

        super().__init__(config, NAME, "+".join(settings.channels), clock, mocap, make_axes)


def check_joints(config: RunConfig, settings: OdriveSettings) -> None:
    """Raise ConfigError for joints that no axis can be."""
    real = not all(map(is_emulated, settings.channels))
    for joint in config.robot.joint_table:
        if joint.id > LAST_NODE:
            raise ConfigError(f"{who(config, joint)}: `id` = {joint.id}; node ids of CANSimple are 0 to {LAST_NODE}")
        if joint.motor.damping_nm_s_per_rad <= 0:
            raise ConfigError(
                f"{who(config, joint)}: `damping_nm_s_per_rad` must be above 0: an ODrive's position loop needs it"
            )
        if joint.motor.torque_constant_nm_per_a is None and real:
            raise ConfigError(
                f"{who(config, joint)}: `torque_constant_nm_per_a` is not given, and ODrives measure and limit "
                f"amperes: take it from the motor's data sheet (8.27 / KV), as `axis0.config.motor.torque_constant` "
                f"has it"
            )


def check_load(config: RunConfig, settings: OdriveSettings) -> None:
    """Raise ConfigError when a bus cannot carry its axes."""
    load, fits_hz, fullest = load_of(config, settings)
    if load > MAX_LOAD:
        raise ConfigError(
            f"{fullest} axes at {config.rate_hz:g} Hz need {load:.0%} of a bus of {settings.bit_rate:g} bit/s, at "
            f"worst-case stuffing; at most {MAX_LOAD:.0%}: use rate_hz = {fits_hz}, or more `backends.odrive.channels`"
        )


def load_of(config: RunConfig, settings: OdriveSettings) -> tuple[float, int, int]:
    """Of the fullest bus: its load at worst, the rate in Hz that fits, its axes.

    An axis' tick is two questions, two answers and an input; one axis a tick is asked three questions more.
    """
    on = port_of(config, settings.channels)
    fullest = max(on.count(bus) for bus in set(on))
    tick_bits = fullest * (2 * worst_bits(0) + 3 * worst_bits(8)) + 3 * (worst_bits(0) + worst_bits(8))
    steady = fullest * HEARTBEATS_HZ * worst_bits(8) / settings.bit_rate
    load = tick_bits * config.rate_hz / settings.bit_rate + steady
    return load, int((MAX_LOAD - steady) * settings.bit_rate / tick_bits), fullest


def constants(config: RunConfig) -> list[float]:
    """Torque constants of all joints, N·m/A."""
    return [joint.motor.torque_constant_nm_per_a or TWIN_CONSTANT for joint in config.robot.joint_table]


def twin_on(
    config: RunConfig, settings: OdriveSettings, wires: list[Wire], clock: Clock, pose: str | None
) -> OdriveTwin:
    """Emulated axes of a whole robot."""
    plant = make_plant(config, NAME, settings.plant, settings.plant_settings)
    body = TwinBody(config, plant, settings.mounted, PoseSender(pose) if pose else None)
    each = [wires[bus] for bus in port_of(config, settings.channels)]
    return OdriveTwin(body, each, constants(config), settings.watchdog_s, clock.ns)
