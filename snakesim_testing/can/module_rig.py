"""One module, and whole chains, for the tests of the emulators."""

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
from snakesim_testing.can.driver_loop import config
from snakesim_testing.can.frames import read

NODE = 3
SERIAL = 0xC0FFEE
MS = 1000.0
BOOTED = 100 * MS
ARMED_AT_US = 110 * MS  # after all modules have booted
HEAT = HeatLimits(derate_from_c=80.0, stop_at_c=105.0)
QUIET = ModuleReadings(0, 0, 0)


def setpoint(
    count: int,
    mode: JointMode = JointMode.TORQUE,
    target: float = 1.0,
    limit: float = 3.0,
    node_id: int = NODE,
) -> CanFrame:
    signal = {
        JointMode.POSITION: "position",
        JointMode.VELOCITY: "velocity",
        JointMode.TORQUE: "torque",
        JointMode.PASSIVE: "torque",
    }[mode]
    values: dict[str, float] = {
        "mode": mode,
        "count": count % 16,
        signal: target,
        "torque_limit": limit,
    }
    return load_layouts()[Opcode.SET_POINT].encode(node_id, **values)


def parameter(
    index: int, value: float = 0.0, operation: int = ParameterOperation.WRITE, node_id: int = NODE
) -> CanFrame:
    frame = load_layouts()[Opcode.PARAMETER_REQUEST].encode(node_id, index=index, value=value)
    # Also operations that there are not.
    return CanFrame(frame.id, frame.data[:1] + bytes((operation,)) + frame.data[2:])


def only(
    frames: Sequence[CanFrame], opcode: Opcode, node_id: int | None = None
) -> list[dict[str, float]]:
    return [
        read(f)
        for f in frames
        if parse_opcode(f.id) == opcode and node_id in (None, parse_node(f.id))
    ]


def new_module(**flash: float) -> ModuleFirmware:
    values = make_factory_defaults(5.0, 6.0) | {
        ModuleParameter[name.upper()]: value for name, value in flash.items()
    }
    return ModuleFirmware(NODE, SERIAL, ParameterStore(values), HEAT)


def booted(**flash: float) -> ModuleFirmware:
    module = new_module(**flash)
    module.poll(BOOTED)
    module.frames.clear()
    assert module.state == ModuleState.DISARMED
    return module


def armed(**flash: float) -> ModuleFirmware:
    module = booted(**flash)
    module.receive(make_command(CommandAction.ARM), BOOTED)
    module.frames.clear()
    assert module.state == ModuleState.ARMED
    return module


def chain(run: RunConfig | None = None, *, is_stepped: bool = True, **given: Any) -> ModuleChain:
    """On the inertia physics model, with the robot's gains in every flash."""
    run = run or config()
    physics_model = given.pop("physics_model", None) or InertiaModel(run, InertiaSettings())
    settings = CanSettings(
        **{k: given.pop(k) for k in list(given) if k in CanSettings.__struct_fields__}
    )
    made = ModuleChain(run, settings, physics_model, is_stepped=is_stepped, **given)
    motor = run.robot.motor
    for slot in made.slots:
        slot.module.parameters.values |= {
            ModuleParameter.STIFFNESS: motor.stiffness_nm_per_rad,
            ModuleParameter.DAMPING: motor.damping_nm_s_per_rad,
            ModuleParameter.VELOCITY_GAIN: motor.velocity_gain_nm_s_per_rad,
        }
    return made


class RigHost:
    """Ticks of a stepped chain with one bus: Sync, answers, setpoints."""

    def __init__(self, made: ModuleChain) -> None:
        self.chain, self.count = made, -1
        made.pop_frames(0)

    def arm(self) -> None:
        self.tick()
        self.chain.receive(0, make_command(CommandAction.ARM))

    def tick(
        self, target: float | None = None, mode: JointMode = JointMode.POSITION
    ) -> list[CanFrame]:
        self.count += 1
        self.chain.receive(0, make_sync(self.count, self.count * 10_000))
        frames = self.chain.pop_frames(0)
        if target is not None:
            for node in range(1, self.chain.module_count + 1):
                self.chain.receive(0, setpoint(self.count, mode, target, 4.0, node))
        return frames

    def ticks(
        self, count: int, target: float | None = None, mode: JointMode = JointMode.POSITION
    ) -> list[CanFrame]:
        """So many; the frames of the last."""
        return [self.tick(target, mode) for _ in range(count)][-1]

    def states(self) -> list[ModuleState]:
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
    emulators = chain(config(joint_count, rate_hz=rate_hz), is_stepped=False)
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
            emulators.receive(0, setpoint(tick, node_id=node, target=0.0))
        waiting_frames = sum(
            map(len, emulators.buses[0]._waiting_frame_by_mailbox_by_sender.values())
        )
        max_waiting_frames = max(max_waiting_frames, waiting_frames)
    return lateness_periods, traffic_before, emulators.read_traffic()[0], max_waiting_frames
