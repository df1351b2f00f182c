"""All modules of a robot, their motors and the physics model that they move, on one clock.

    at a Sync: the physics model is advanced to now, sensors are read, every module answers, then enacts its setpoint

With `stepped`, time advances only when a Sync's time is later than that of the one before, and frames are sent at once:
a host may compute for any time, and every run is the same. Otherwise the caller passes in the time.
"""

from collections.abc import Callable
from itertools import accumulate
from math import inf
from zlib import crc32

import msgspec

from snakesim_can_backend.bus.load import joints_per_bus
from snakesim_can_backend.emulator.bus_time import BusTime, Traffic
from snakesim_can_backend.emulator.faults import parse_fault
from snakesim_can_backend.emulator.firmware import BOOT_US, ModuleFirmware
from snakesim_can_backend.emulator.frames import LENGTHS, read_sync
from snakesim_can_backend.emulator.module_sensors import ModuleSensors
from snakesim_can_backend.emulator.module_slot import ModuleSlot
from snakesim_can_backend.emulator.node_ids import node_ids
from snakesim_can_backend.emulator.parameters import ParameterStore, make_factory_defaults
from snakesim_can_backend.protocol.definitions import (
    BROADCAST,
    FROM_HOST,
    Frame,
    ModuleParameter,
    Opcode,
    parse_node,
    parse_opcode,
)
from snakesim_can_backend.settings import CanSettings
from snakesim_drivers.emulation.mounted import as_built, built
from snakesim_drivers.motion_capture.emulated_mocap import PoseCamera
from snakesim_drivers.mounting import Mounting, joint_target
from snakesim_hal.model.fault_kinds import Change, Injection, Plan
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.physics.motors import Motors
from snakesim_hal.physics.physics_model import PhysicsModel
from snakesim_hal.physics.thermal import Thermal
from snakesim_hal.wire.messages import Mode

MAX_AT_ONCE_US = 200_000.0  # after a longer delay of this process, the modules skip the rest of it
HEAT_EVERY = 10  # steps
ROUND_US = 1 << 32  # Sync times wrap around
# A Sync that is later by more is of another clock; no bus is cut for that long in lockstep.
LONGEST_STEP_US = 60_000_000
NEW_HOST_US = 1_000_000  # a Sync that is earlier by this much is of a restarted host, not a late one of another bus
OTHER_SERIAL = 0x0D0B1E00


class ModuleChain:
    """Every module, tail to head; joint_i is node i."""

    def __init__(
        self,
        config: RunConfig,
        settings: CanSettings,
        physics_model: PhysicsModel,
        *,
        stepped: bool,
        send_pose: Callable[[bytes], None] | None = None,
    ) -> None:
        """send_pose: gets a MocapSample as JSON after every Sync, before the joint states. Raises ConfigError."""
        robot, self.stepped, self.physics_model = config.robot, stepped, physics_model
        self.module_count = robot.chain.modules
        self.modules_per_bus = joints_per_bus(config, settings)  # modules on each bus
        self.motors = Motors(as_built(config, settings.mounted).robot, physics_model.step_s)
        self._joints, self._told = built(robot, settings.mounted), robot.joint_table
        self._nodes = node_ids(robot, settings)
        loose = {name for name, truth in settings.mounted.items() if not truth.connected}
        self._loose = {i for i, joint in enumerate(self._joints) if joint.name in loose}
        self.thermal = Thermal(self._joints)
        self.buses = [BusTime(settings.bit_rate) for _ in self.modules_per_bus]
        self.now_us = 0.0  # module time: since the emulators were started
        self.skipped_us = 0.0  # time in which this process did not run
        self.refused = 0  # frames that no host sends
        self.fault_log: list[str] = []  # injected faults, each begin and end
        self._plan = Plan(parse_fault(text, self.module_count) for text in settings.faults)
        self._step_us, self._steps, self._due_us = physics_model.step_s * 1e6, 0, 0.0
        self._sync_time: int | None = None
        self._pose_time: int | None = None
        starts = [0, *accumulate(self.modules_per_bus)]
        self.slots: list[ModuleSlot] = []
        for channel, count in enumerate(self.modules_per_bus):
            for joint in range(starts[channel], starts[channel] + count):
                serial = crc32(f"{config.seed}:{joint + 1}".encode())
                self._seat(joint, channel, serial, -BOOT_US if stepped else 0.0)
        self._senses = [
            ModuleSensors(
                robot, physics_model, Mounting(self._joints[start : start + count]), start, (config.seed, channel)
            )
            for channel, (start, count) in enumerate(zip(starts, self.modules_per_bus, strict=False))
        ]
        self._send_pose = send_pose
        self._camera: PoseCamera | None = None
        if send_pose is not None and robot.sensors.pose is not None:
            self._camera = PoseCamera(
                robot.sensors.pose, physics_model, (config.seed, len(self.modules_per_bus)), config.period_ns
            )
        self._encode = msgspec.json.Encoder().encode
        self._out: list[list[Frame]] = [[] for _ in self.modules_per_bus]
        self._babblers: dict[ModuleSlot, float] = {}  # in stepped time: until when they have sent
        self._poll(0.0)

    # --- time ----------------------------------------------------------------------------------------------

    def advance_to(self, clock_us: float) -> None:
        """Advance everything to a time since the start. Not for stepped chains, whose time advances at Syncs."""
        now_us = clock_us - self.skipped_us
        if now_us - self.now_us > MAX_AT_ONCE_US:
            self.skipped_us += now_us - self.now_us - MAX_AT_ONCE_US
            now_us = self.now_us + MAX_AT_ONCE_US
        if now_us > self.now_us:
            self._pass(now_us, int(now_us / self._step_us) - self._steps)

    def next_us(self) -> float:
        """Module time at which a frame is sent or a module is due; inf for a stepped chain."""
        if self.stepped:
            return inf
        return min(self._due_us, *(bus.next_us() for bus in self.buses))

    def _pass(self, until_us: float, steps: int) -> None:
        physics_model, motors, step_us = self.physics_model, self.motors, self._step_us
        for _ in range(steps):
            physics_model.advance(motors.step(physics_model.angle_rad, physics_model.velocity_rad_s))
            self._steps += 1
            if self._steps % HEAT_EVERY == 0:
                self._warm()
            time_us = self._steps * step_us
            if time_us >= self._due_us:
                self.now_us = max(min(time_us, until_us), self.now_us)
                self._poll(self.now_us)
        self.now_us = until_us
        if until_us >= self._due_us:
            self._poll(until_us)

    def _warm(self) -> None:
        self.thermal.pass_time(HEAT_EVERY * self.physics_model.step_s, self.motors.take_heat())
        self._derate()
        if (self.thermal.winding_c >= self.thermal.stop_at_c).any():
            self._due_us = -inf

    def _derate(self) -> None:
        if (remaining_fraction := self.thermal.remaining_fraction()) is not None:
            self.motors.derate(remaining_fraction)

    def _poll(self, now_us: float) -> None:
        """Everything that depends on time, except physics."""
        for change in self._plan.until(now_us / 1e6):
            self._go_wrong(change, now_us)
        speeds = self.physics_model.velocity_rad_s.tolist()
        windings, boards = self.thermal.winding_c.tolist(), self.thermal.board_c().tolist()
        watts = self.thermal.power_w(self.motors.torque_nm, self.physics_model.velocity_rad_s).tolist()
        due_us = self._plan.next_s() * 1e6
        for slot in self.slots:
            j = slot.joint
            slot.update_health(speeds[j], watts[j], windings[j], boards[j])
            due_us = min(due_us, slot.module.poll(now_us))
            self._follow_up(slot)
        for slot, since_us in self._babblers.items():
            frame_us = self.buses[slot.channel].frame_us[8]
            burst = int((now_us - since_us) / frame_us)
            self._out[slot.channel].extend([slot.module.heartbeat(now_us)] * burst)
            self._babblers[slot] = since_us + burst * frame_us
        self._due_us = now_us if self._babblers else due_us

    # --- frames from the bus -------------------------------------------------------------------------------

    def receive(self, channel: int, frame: Frame) -> None:
        """A frame of the host has arrived."""
        opcode, node = parse_opcode(frame.id), parse_node(frame.id)
        # An Emergency is valid at any length.
        wrong_length = opcode != Opcode.EMERGENCY and len(frame.data) != LENGTHS.get(opcode)
        if opcode not in FROM_HOST or wrong_length:
            self.refused += 1
            return
        if self.stepped:
            self.buses[channel].count_frame(frame)
        else:
            self.buses[channel].record_host_frame(frame, self.now_us)
        if opcode == Opcode.SYNC:
            self._sync(channel, frame)
        elif opcode == Opcode.SET_POINT:
            for slot in self._at(channel, node):
                slot.module.receive_setpoint(frame, self.now_us)
                if slot.module.frames:
                    self._follow_up(slot)
        else:
            everybody = node == BROADCAST and opcode != Opcode.PARAMETER_REQUEST
            for slot in self.slots if everybody else self._at(channel, node):
                if slot.channel == channel:
                    slot.module.receive(frame, self.now_us)
                    self._follow_up(slot)
            if opcode != Opcode.PARAMETER_REQUEST:
                self._poll(self.now_us)

    def take_frames(self, channel: int) -> list[Frame]:
        """Frames that are on the bus by now, in the order of arbitration, each once."""
        if not self.stepped:
            return self.buses[channel].take_sent_frames(self.now_us)
        frames, self._out[channel] = self._out[channel], []
        for frame in frames:
            self.buses[channel].count_frame(frame)
        return frames

    def traffic(self) -> list[Traffic]:
        """Traffic of each bus until now."""
        return [bus.traffic(self.now_us) for bus in self.buses]

    def _sync(self, channel: int, frame: Frame) -> None:
        count, time = read_sync(frame.data)
        sent = len(self._out[channel])
        if self.stepped:
            self._step_to(time)
        if self._camera is not None and self._send_pose is not None and time != self._pose_time:
            self._pose_time = time
            sample = self._camera.look(round(self.now_us * 1000))
            if sample is not None:
                self._send_pose(self._encode(sample))
        first = sum(self.modules_per_bus[:channel])
        slots = [slot for slot in self.slots if slot.channel == channel]  # tail to head, then duplicates
        imu_due = [slot.module.imu_is_due() for slot in slots[: self.modules_per_bus[channel]]]
        readings = self._senses[channel].read(self.motors.torque_nm, self.motors.derated(), imu_due)
        for slot in slots:
            slot.module.sync(count, readings[slot.joint - first])
            self._follow_up(slot)
        out = self._out[channel]
        out[sent:] = sorted(out[sent:], key=lambda frame: frame.id)  # in the order of arbitration

    def _step_to(self, sync_time: int) -> None:
        """Advance by the time from the latest Sync to this one. The first sets zero, as does one of another clock."""
        later_us = 0 if self._sync_time is None else (sync_time - self._sync_time) % ROUND_US
        if 0 < later_us <= LONGEST_STEP_US:
            until_us = self.now_us + later_us
            self._pass(until_us, round(until_us / self._step_us) - self._steps)
        elif 0 < ROUND_US - later_us < NEW_HOST_US:
            return
        self._sync_time = sync_time

    def _at(self, channel: int, node: int) -> list[ModuleSlot]:
        found = [self.slots[self._nodes.index(node)]] if 1 <= node <= self.module_count else []
        if len(self.slots) > self.module_count:
            found += [slot for slot in self.slots[self.module_count :] if slot.module.node == node]
        return [slot for slot in found if slot.channel == channel]

    # --- what goes out -------------------------------------------------------------------------------------

    def _follow_up(self, slot: ModuleSlot) -> None:
        """Send a module's frames, and apply its demand to its motor."""
        for frame in slot.take_frames():
            if self.stepped:
                self._out[slot.channel].append(frame)
            else:
                self.buses[slot.channel].enqueue(slot.sender, frame, self.now_us)
        demand = slot.module.demand
        if demand is slot.driven or not slot.drives:
            return
        slot.driven = demand
        values = slot.module.parameters.values
        damping = ModuleParameter.DAMPING if demand.mode == Mode.POSITION else ModuleParameter.VELOCITY_GAIN
        mount = slot.joint_model.drive
        self.motors.drive(
            slot.joint,
            demand.mode,
            joint_target(mount, demand.mode, demand.target),
            min(demand.torque_limit_nm, values[ModuleParameter.TORQUE_LIMIT]) * mount.gear if demand.mode else inf,
            values[ModuleParameter.STIFFNESS] * mount.gear**2,
            values[damping] * mount.gear**2,
            values[ModuleParameter.SPEED_LIMIT] / mount.gear,
        )

    # --- injected faults -----------------------------------------------------------------------------------

    def inject(self, fault: Injection, *, begins: bool = True) -> None:
        """Begin or end a fault now."""
        self._go_wrong(Change(self.now_us / 1e6, fault, begins), self.now_us)
        self._poll(self.now_us)

    def _go_wrong(self, change: Change, now_us: float) -> None:
        fault, joint = change.injection, change.injection.number
        slot = self.slots[joint]
        self.fault_log.append(f"{now_us * 1e-6:.2f} s {fault} {'begins' if change.begins else 'ends'}")
        match fault.kind:
            case "overheat":
                self.thermal.inject(joint, heat=change.begins, hold=change.begins and fault.end_s != inf)
                self._derate()
            case "duplicate":
                if change.begins:
                    self._seat(joint, slot.channel, slot.module.serial ^ OTHER_SERIAL, now_us - BOOT_US, drives=False)
                else:
                    self.slots[self.module_count :] = [s for s in self.slots[self.module_count :] if s.joint != joint]
            case "babble" if self.stepped:
                self._babblers.pop(slot, None)
                if change.begins:
                    self._babblers[slot] = now_us
            case "babble":
                frame = slot.module.heartbeat(now_us) if change.begins else None
                self.buses[slot.channel].set_babbling(slot.sender, frame, now_us)
            case kind:
                slot.set_fault(kind, change.begins, now_us)

    def _seat(self, number: int, channel: int, serial: int, now_us: float, *, drives: bool = True) -> None:
        joint, gear = self._joints[number], self._told[number].drive.gear  # its maker does not know where it ends up
        module = ModuleFirmware(
            self._nodes[number],
            serial,
            ParameterStore(make_factory_defaults(joint.limits.torque_nm / gear, joint.limits.speed_rad_s * gear)),
            self.thermal.limits[number],
            min_voltage_v=joint.limits.min_voltage_v,
            stepped=self.stepped,
            now_us=now_us,
        )
        self.slots.append(
            ModuleSlot(len(self.slots), channel, number, module, joint, drives=drives and number not in self._loose)
        )
