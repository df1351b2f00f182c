"""Makes emulated joint modules, chains of them, and the frames that a host sends to them."""

from collections.abc import Sequence
from typing import Any

from snakesim_can_backend.emulator.bus_time import BusTraffic
from snakesim_can_backend.emulator.chain import ModuleChain
from snakesim_can_backend.emulator.firmware import ModuleFirmware
from snakesim_can_backend.emulator.frames import ModuleReadings
from snakesim_can_backend.emulator.parameters import ParameterStore, make_factory_defaults
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.commands import make_command, make_sync
from snakesim_can_backend.protocol.definitions import (
    CanFrame,
    CommandAction,
    ModuleParameter,
    ModuleState,
    Opcode,
    ParameterOperation,
    parse_node,
    parse_opcode,
)
from snakesim_can_backend.settings import CanSettings
from snakesim_drivers.emulation.inertia import InertiaModel, InertiaSettings
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.physics.thermal import HeatLimits
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.can.driver_loop import make_can_config
from snakesim_testing.can.frames import decode_signals

NODE = 3
SERIAL = 0xC0FFEE
US_PER_MS = 1000.0
BOOTED_AT_US = 100 * US_PER_MS
TORQUE_LIMIT_NM = 4.0
PERIOD_US = 10_000
ARMED_AT_US = 110 * US_PER_MS  # after all modules have booted
HEAT = HeatLimits(derate_from_c=80.0, stop_at_c=105.0)
RESTING_READINGS = ModuleReadings(0, 0, 0)


def make_setpoint(
    count: int,
    mode: JointMode = JointMode.TORQUE,
    target: float = 1.0,
    limit: float = 3.0,
    node_id: int = NODE,
) -> CanFrame:
    """Return a setpoint for one module.

    Args:
        count: Number of the setpoint.
        mode: Mode of the joint.
        target: Angle in rad, speed in rad/s or torque in N·m, as the mode needs it.
        limit: Torque limit in N·m.
        node_id: The module.
    """
    target_signal = {
        JointMode.POSITION: "position",
        JointMode.VELOCITY: "velocity",
        JointMode.TORQUE: "torque",
        JointMode.PASSIVE: "torque",
    }[mode]
    signals: dict[str, float] = {
        "mode": mode,
        "count": count % 16,
        target_signal: target,
        "torque_limit": limit,
    }
    return load_layouts()[Opcode.SET_POINT].encode(node_id, **signals)


def make_parameter_request(
    index: int, value: float = 0.0, operation: int = ParameterOperation.WRITE, node_id: int = NODE
) -> CanFrame:
    """Return a request to read or write a parameter. The operation may be an unknown number."""
    frame = load_layouts()[Opcode.PARAMETER_REQUEST].encode(node_id, index=index, value=value)
    # The layout would reject unknown operations, therefore this byte is replaced after encoding.
    return CanFrame(frame.id, frame.data[:1] + bytes((operation,)) + frame.data[2:])


def decode_frames_of(
    frames: Sequence[CanFrame], opcode: Opcode, node_id: int | None = None
) -> list[dict[str, float]]:
    """Return the signals of all frames with an opcode, from one module or, with None, from all modules."""
    return [
        decode_signals(frame)
        for frame in frames
        if parse_opcode(frame.id) == opcode and node_id in (None, parse_node(frame.id))
    ]


def make_module(**flash: float) -> ModuleFirmware:
    """Return a module that is not powered yet.

    Args:
        **flash: Values of parameters in the flash memory that differ from the factory defaults.
    """
    values = make_factory_defaults(5.0, 6.0)
    values |= {ModuleParameter[name.upper()]: value for name, value in flash.items()}
    return ModuleFirmware(NODE, SERIAL, ParameterStore(values), HEAT)


def boot_module(**flash: float) -> ModuleFirmware:
    """Return a disarmed module that has booted, without the frames that it sent. See `make_module`."""
    module = make_module(**flash)
    module.poll(BOOTED_AT_US)
    module.frames.clear()
    assert module.state == ModuleState.DISARMED
    return module


def arm_module(**flash: float) -> ModuleFirmware:
    """Return an armed module, without the frames that it sent. See `make_module`."""
    module = boot_module(**flash)
    module.receive(make_command(CommandAction.ARM), BOOTED_AT_US)
    module.frames.clear()
    assert module.state == ModuleState.ARMED
    return module


def make_chain(
    run_config: RunConfig | None = None, *, is_stepped: bool = True, **options: Any
) -> ModuleChain:
    """Return a chain of modules whose flash memories contain the gains of the robot.

    Args:
        run_config: Configuration of the run. None for that of `make_can_config`.
        is_stepped: Whether the chain runs in steps with the driver.
        **options: Fields of `CanSettings`, a `physics_model`, and arguments of `ModuleChain`. Without a physics
            model, the chain moves an inertia for each joint.
    """
    run_config = run_config or make_can_config()
    physics_model = options.pop("physics_model", None)
    if physics_model is None:
        physics_model = InertiaModel(run_config, InertiaSettings())
    setting_names = [name for name in options if name in CanSettings.__struct_fields__]
    settings = CanSettings(**{name: options.pop(name) for name in setting_names})
    chain = ModuleChain(run_config, settings, physics_model, is_stepped=is_stepped, **options)
    motor = run_config.robot.motor
    for slot in chain.slots:
        slot.module.parameters.values |= {
            ModuleParameter.STIFFNESS: motor.stiffness_nm_per_rad,
            ModuleParameter.DAMPING: motor.damping_nm_s_per_rad,
            ModuleParameter.VELOCITY_GAIN: motor.velocity_gain_nm_s_per_rad,
        }
    return chain


class RigHost:
    """The host of a stepped chain on one bus, which sends Syncs and setpoints at 100 Hz."""

    def __init__(self, chain: ModuleChain) -> None:
        self.chain = chain
        self.count = -1  # number of the newest Sync
        chain.pop_frames(0)

    def arm(self) -> None:
        """Send a Sync, then arm all modules."""
        self.run_tick()
        self.chain.receive(0, make_command(CommandAction.ARM))

    def run_tick(
        self, target: float | None = None, mode: JointMode = JointMode.POSITION
    ) -> list[CanFrame]:
        """Send a Sync, and then setpoints to all modules.

        Args:
            target: Target of all modules, in the unit of the mode. None: no setpoints.
            mode: Mode of all modules.

        Returns:
            The frames that the modules have sent in response to the Sync.
        """
        self.count += 1
        self.chain.receive(0, make_sync(self.count, self.count * PERIOD_US))
        frames = self.chain.pop_frames(0)
        if target is not None:
            for node in range(1, self.chain.module_count + 1):
                frame = make_setpoint(self.count, mode, target, TORQUE_LIMIT_NM, node)
                self.chain.receive(0, frame)
        return frames

    def run_ticks(
        self, count: int, target: float | None = None, mode: JointMode = JointMode.POSITION
    ) -> list[CanFrame]:
        """Run several ticks, and return the frames that the modules have sent in the last one."""
        frames = list[CanFrame]()
        for _ in range(count):
            frames = self.run_tick(target, mode)
        return frames

    def states(self) -> list[ModuleState]:
        """Return the states of all modules."""
        return [slot.module.state for slot in self.chain.slots[: self.chain.module_count]]


def measure_bus_traffic(
    joint_count: int, rate_hz: int, duration_s: float = 2.0
) -> tuple[list[int], BusTraffic, BusTraffic, int]:
    """Run a whole bus of armed modules for some time, and measure its traffic.

    Args:
        joint_count: Number of modules on the bus.
        rate_hz: Rate of the Sync frames.
        duration_s: Duration of the run after arming.

    Returns:
        The lateness of each joint state in periods, the traffic counts before and after the run, and the maximum
        number of frames that waited for the bus.
    """
    emulators = make_chain(make_can_config(joint_count, rate_hz=rate_hz), is_stepped=False)
    emulators.slots[0].module.parameters.values[ModuleParameter.TAIL] = 1.0
    for slot in emulators.slots:
        slot.module.parameters.values |= {
            ModuleParameter.CONTACT_EVERY: 1.0,
            ModuleParameter.IMU_EVERY: 20.0,
        }
    emulators.advance_to(ARMED_AT_US)
    emulators.receive(0, make_command(CommandAction.ARM))
    traffic_before = emulators.read_traffic()[0]
    period_us = 1e6 / rate_hz
    lateness_periods: list[int] = []
    max_waiting_frames = 0
    for tick in range(round(duration_s * rate_hz)):
        emulators.advance_to(ARMED_AT_US + tick * period_us)
        for frame in emulators.pop_frames(0):
            if parse_opcode(frame.id) == Opcode.JOINT_STATE:
                sync_count = frame.data[6] & 0xF  # the number of the answered Sync, modulo 16
                lateness_periods.append(((tick - 1) - sync_count) % 16)
        emulators.receive(0, make_sync(tick, 0))
        for node in range(1, joint_count + 1):
            emulators.receive(0, make_setpoint(tick, node_id=node, target=0.0))
        waiting_frames = sum(
            map(len, emulators.buses[0]._waiting_frame_by_mailbox_by_sender.values())
        )
        max_waiting_frames = max(max_waiting_frames, waiting_frames)
    return lateness_periods, traffic_before, emulators.read_traffic()[0], max_waiting_frames
