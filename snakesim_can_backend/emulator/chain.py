"""All modules of a robot, their motors and the physics model that they move, on one clock.

At a Sync the chain advances the physics model to the present, reads the sensors, and lets every module answer; then
every module follows its newest setpoint.

With `stepped`, time advances only when a Sync's time is later than that of the Sync before, and frames are sent at
once: a host may compute for any time, and every run is the same. Otherwise the caller passes in the time.
"""

from collections.abc import Callable, Sequence
from itertools import accumulate
from math import inf
from zlib import crc32

import msgspec
import numpy as np

from snakesim_can_backend.bus.load import count_joints_per_bus
from snakesim_can_backend.emulator.bus_time import BusTime, BusTraffic
from snakesim_can_backend.emulator.faults import parse_fault
from snakesim_can_backend.emulator.firmware import BOOT_US, ModuleFirmware
from snakesim_can_backend.emulator.frames import LENGTHS, read_sync
from snakesim_can_backend.emulator.module_sensors import ModuleSensors
from snakesim_can_backend.emulator.module_slot import ModuleSlot, assign_node_ids
from snakesim_can_backend.emulator.parameters import ParameterStore, make_factory_defaults
from snakesim_can_backend.protocol.definitions import (
    BROADCAST,
    FROM_HOST,
    CanFrame,
    ModuleParameter,
    Opcode,
    parse_node,
    parse_opcode,
)
from snakesim_can_backend.settings import CanSettings
from snakesim_drivers.emulation.mounted import (
    build_actual_config,
    build_actual_joints,
    compute_torque_ratios,
)
from snakesim_drivers.emulation.shaft_demand import set_shaft_demand
from snakesim_drivers.motion_capture.emulated_mocap import PoseCamera
from snakesim_drivers.mounting import DriveMounting
from snakesim_hal.model.fault_kinds import FaultInjection, FaultTransition, InjectionPlan
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.physics.motors import PowerStages
from snakesim_hal.physics.physics_model import PhysicsModel
from snakesim_hal.physics.thermal import ThermalModel
from snakesim_hal.wire.messages import JointMode

MAX_AT_ONCE_US = 200_000.0  # after a longer delay of this process, the modules skip the rest of it
THERMAL_DECIMATION = 10  # physics steps; windings heat up slowly
SYNC_TIME_RANGE_US = 1 << 32  # the time in a Sync has 32 bits and wraps around
# A Sync that is later by more is of another clock; no lockstep bus is cut for that long.
MAX_SYNC_INTERVAL_US = 60_000_000
# A Sync that is earlier by this much is of a restarted host, not a late one of another bus.
MIN_HOST_RESTART_US = 1_000_000
DUPLICATE_SERIAL_MASK = 0x0D0B1E00  # makes the serial number of an injected duplicate
HEARTBEAT_BYTES = 8


class ModuleChain:
    """Every module of a robot, tail to head. Joint i moves with node i, unless the settings mount it elsewhere."""

    def __init__(
        self,
        config: RunConfig,
        settings: CanSettings,
        physics_model: PhysicsModel,
        *,
        is_stepped: bool,
        send_pose: Callable[[bytes], None] | None = None,
    ) -> None:
        """Create all modules; they boot.

        Args:
            config: Configuration of the run, with the robot.
            settings: Settings of the backend: buses, faults, and how the modules are really mounted.
            physics_model: Physics model that the motors move.
            is_stepped: Whether time advances only from Sync to Sync.
            send_pose: Function that sends a MocapSample as JSON, after every Sync and before the joint states; None
                without motion capture.

        Raises:
            ConfigError: The modules do not fit on the buses, or a fault or a node id is impossible.
        """
        robot = config.robot

        # Modules and buses.
        self.is_stepped = is_stepped
        self.module_count = robot.chain.modules
        self.modules_per_bus = count_joints_per_bus(config, settings)
        self.buses = [BusTime(settings.bit_rate) for _ in self.modules_per_bus]
        self.slots: list[ModuleSlot] = []  # tail to head; then injected duplicates
        self._node_ids = assign_node_ids(robot, settings)
        self._configured_joints = robot.joint_table  # as the robot file describes them
        self._joints = build_actual_joints(robot, settings.mounted)  # as they are really built
        unconnected = {name for name, mount in settings.mounted.items() if not mount.connected}
        self._unconnected_joints = {
            i for i, joint in enumerate(self._joints) if joint.name in unconnected
        }

        # The body.
        self.physics_model = physics_model
        self.motors = PowerStages(
            build_actual_config(config, settings.mounted).robot, physics_model.step_s
        )
        # Real torque of each module divided by the torque that it computes from its current.
        self._torque_ratios = np.array(compute_torque_ratios(robot, settings.mounted))
        self.thermal = ThermalModel(self._joints)

        # Time.
        self.now_us = 0.0  # module time, since the emulators were started
        self.skipped_us = 0.0  # time in which this process did not run
        self._step_us = physics_model.step_s * 1e6
        self._step_count = 0
        self._next_poll_us = 0.0  # when `_poll_modules` is due
        self._last_sync_time: int | None = None  # time in the newest Sync; None: none yet

        # Frames.
        self.refused_frame_count = 0  # frames that no host sends
        # By bus, in stepped time.
        self._outgoing: list[list[CanFrame]] = [[] for _ in self.modules_per_bus]

        # Injected faults.
        self.fault_log: list[str] = []  # each start and end of a fault
        self._injection_plan = InjectionPlan(
            parse_fault(text, self.module_count) for text in settings.faults
        )
        # In stepped time: until when they have sent.
        self._babble_start_us_by_slot: dict[ModuleSlot, float] = {}

        # Motion capture.
        self._send_pose = send_pose
        self._camera: PoseCamera | None = None
        self._pose_time: int | None = None  # time in the Sync that the newest pose belongs to
        self._encode = msgspec.json.Encoder().encode
        if send_pose is not None and robot.sensors.pose is not None:
            camera_seed = (config.seed, len(self.modules_per_bus))
            self._camera = PoseCamera(
                robot.sensors.pose, physics_model, camera_seed, config.period_ns
            )

        self._sensors: list[ModuleSensors] = []  # by bus
        starts = [0, *accumulate(self.modules_per_bus)]
        for channel, count in enumerate(self.modules_per_bus):
            first = starts[channel]
            joints = range(first, first + count)
            for joint in joints:
                serial = crc32(f"{config.seed}:{joint + 1}".encode())
                self._add_module(joint, channel, serial, -BOOT_US if is_stepped else 0.0)
            mounting = DriveMounting(self._joints[first : first + count])
            self._sensors.append(
                ModuleSensors(robot, physics_model, mounting, first, (config.seed, channel))
            )
        self._poll_modules(0.0)

    def _add_module(
        self, joint_index: int, channel: int, serial: int, now_us: float, *, drives: bool = True
    ) -> None:
        """Put a module of a joint on a bus; drives: whether a motor of its own moves the joint."""
        joint_model = self._joints[joint_index]
        limits = joint_model.limits
        # The manufacturer sets the ratings, and does not know which gear the module will get.
        gear = self._configured_joints[joint_index].drive.gear
        firmware = ModuleFirmware(
            self._node_ids[joint_index],
            serial,
            ParameterStore(
                make_factory_defaults(limits.torque_nm / gear, limits.speed_rad_s * gear)
            ),
            self.thermal.limits[joint_index],
            min_voltage_v=limits.min_voltage_v,
            is_stepped=self.is_stepped,
            now_us=now_us,
        )
        has_motor = drives and joint_index not in self._unconnected_joints
        self.slots.append(
            ModuleSlot(
                len(self.slots), channel, joint_index, firmware, joint_model, drives=has_motor
            )
        )

    # --- time ----------------------------------------------------------------------------------------------

    def advance_to(self, clock_us: float) -> None:
        """Advance everything to a time since the start. Not for stepped chains, whose time advances at Syncs."""
        now_us = clock_us - self.skipped_us
        delay_us = now_us - self.now_us
        if delay_us > MAX_AT_ONCE_US:
            self.skipped_us += now_us - self.now_us - MAX_AT_ONCE_US
            now_us = self.now_us + MAX_AT_ONCE_US
        if now_us > self.now_us:
            due_steps = int(now_us / self._step_us)
            self._run_physics(now_us, due_steps - self._step_count)

    def find_next_due_us(self) -> float:
        """Return the module time at which a frame is sent or a module is due; inf for a stepped chain."""
        if self.is_stepped:
            return inf
        return min(self._next_poll_us, *(bus.next_us() for bus in self.buses))

    def _run_physics(self, until_us: float, step_count: int) -> None:
        """Advance the physics model by some steps, and the modules to a time."""
        physics_model = self.physics_model
        motors = self.motors
        step_us = self._step_us
        for _ in range(step_count):
            physics_model.advance(
                motors.compute_torques(physics_model.angle_rad, physics_model.velocity_rad_s)
            )
            self._step_count += 1
            if self._step_count % THERMAL_DECIMATION == 0:
                self._heat_motors()
            time_us = self._step_count * step_us
            if time_us >= self._next_poll_us:
                self.now_us = max(min(time_us, until_us), self.now_us)
                self._poll_modules(self.now_us)
        self.now_us = until_us
        if until_us >= self._next_poll_us:
            self._poll_modules(until_us)

    def _heat_motors(self) -> None:
        """Update the temperatures of all motors, and poll the modules at once if one is too hot."""
        self.thermal.advance_temperatures(
            THERMAL_DECIMATION * self.physics_model.step_s, self.motors.pop_mean_square_torque()
        )
        self._derate_motors()
        if (self.thermal.winding_temperature_c >= self.thermal.stop_at_c).any():
            self._next_poll_us = -inf

    def _derate_motors(self) -> None:
        remaining_fraction = self.thermal.compute_remaining_fractions()
        if remaining_fraction is not None:
            self.motors.apply_derating(remaining_fraction)

    def _poll_modules(self, now_us: float) -> None:
        """Run everything that depends on time, except physics: planned faults, firmware and babbling modules.

        The time at which the next call is due is stored.

        Args:
            now_us: Current module time.
        """
        for change in self._injection_plan.pop_due_transitions(now_us / 1e6):
            self._apply_fault(change, now_us)
        speeds_rad_s = self.physics_model.velocity_rad_s.tolist()
        windings_c = self.thermal.winding_temperature_c.tolist()
        boards_c = self.thermal.compute_board_temperatures_c().tolist()
        powers_w = self.thermal.compute_power_w(
            self.motors.torque_nm, self.physics_model.velocity_rad_s
        ).tolist()
        due_us = self._injection_plan.next_transition_s() * 1e6
        for slot in self.slots:
            joint = slot.joint
            slot.update_health(
                speeds_rad_s[joint], powers_w[joint], windings_c[joint], boards_c[joint]
            )
            due_us = min(due_us, slot.module.poll(now_us))
            self._apply_module_outputs(slot)
        if self._babble_start_us_by_slot:
            self._send_babble(now_us)
            due_us = now_us
        self._next_poll_us = due_us

    def _send_babble(self, now_us: float) -> None:
        """In stepped time, send as many heartbeats of babbling modules as the bus could have carried."""
        for slot, since_us in self._babble_start_us_by_slot.items():
            frame_us = self.buses[slot.channel].frame_duration_us_by_length[HEARTBEAT_BYTES]
            frames = int((now_us - since_us) / frame_us)
            self._outgoing[slot.channel].extend([slot.module.make_heartbeat(now_us)] * frames)
            self._babble_start_us_by_slot[slot] = since_us + frames * frame_us

    # --- frames from the bus -------------------------------------------------------------------------------

    def receive(self, channel: int, frame: CanFrame) -> None:
        """Process a frame of the host that has arrived on a bus: pass it to the modules that it addresses.

        Args:
            channel: Index of the bus.
            frame: Received frame. A frame that no host sends, such as a Sync to one node or a frame of a wrong length,
                is only counted.
        """
        opcode = parse_opcode(frame.id)
        node = parse_node(frame.id)
        # An Emergency is valid at any length.
        has_wrong_length = opcode != Opcode.EMERGENCY and len(frame.data) != LENGTHS.get(opcode)
        is_sync_to_one_node = opcode == Opcode.SYNC and node != BROADCAST
        if opcode not in FROM_HOST or has_wrong_length or is_sync_to_one_node:
            self.refused_frame_count += 1
            return
        if self.is_stepped:
            self.buses[channel].count_frame(frame)
        else:
            self.buses[channel].record_host_frame(frame, self.now_us)
        match opcode:
            case Opcode.SYNC:
                self._receive_sync(channel, frame)
            case Opcode.SET_POINT:
                for slot in self._find_slots(channel, node):
                    slot.module.receive_setpoint(frame, self.now_us)
                    if slot.module.frames:
                        self._apply_module_outputs(slot)
            case Opcode.PARAMETER_REQUEST:
                self._deliver_to_slots(self._find_slots(channel, node), frame)
            case _:  # Emergency and Command
                if node == BROADCAST:
                    slots = [slot for slot in self.slots if slot.channel == channel]
                else:
                    slots = self._find_slots(channel, node)
                self._deliver_to_slots(slots, frame)
                self._poll_modules(self.now_us)

    def pop_frames(self, channel: int) -> list[CanFrame]:
        """Return the frames that are on a bus by now, in the order of arbitration, each once."""
        if not self.is_stepped:
            return self.buses[channel].pop_sent_frames(self.now_us)
        frames = self._outgoing[channel]
        self._outgoing[channel] = []
        for frame in frames:
            self.buses[channel].count_frame(frame)
        return frames

    def read_traffic(self) -> list[BusTraffic]:
        """Return the traffic of each bus until now."""
        return [bus.traffic(self.now_us) for bus in self.buses]

    def _deliver_to_slots(self, slots: Sequence[ModuleSlot], frame: CanFrame) -> None:
        for slot in slots:
            slot.module.receive(frame, self.now_us)
            self._apply_module_outputs(slot)

    def _find_slots(self, channel: int, node_id: int) -> list[ModuleSlot]:
        """Return the modules with a node id on a bus: one, or several if there are duplicates."""
        slots: list[ModuleSlot] = []
        if 1 <= node_id <= self.module_count:
            slots.append(self.slots[self._node_ids.index(node_id)])
        if len(self.slots) > self.module_count:
            slots += [
                slot for slot in self.slots[self.module_count :] if slot.module.node_id == node_id
            ]
        return [slot for slot in slots if slot.channel == channel]

    # --- a Sync --------------------------------------------------------------------------------------------

    def _receive_sync(self, channel: int, frame: CanFrame) -> None:
        """Advance to a Sync, send the pose, and let every module of the bus respond and follow its setpoint.

        Responses are sent in the order of arbitration.

        Args:
            channel: Index of the bus on which the Sync arrived.
            frame: Received Sync, with its number and time.
        """
        count, time_us = read_sync(frame.data)
        outgoing = self._outgoing[channel]
        sent_before = len(outgoing)
        if self.is_stepped:
            self._advance_to_sync(time_us)
        self._send_pose_once(time_us)

        # Tail to head, then duplicates.
        slots_on_bus = [slot for slot in self.slots if slot.channel == channel]
        joint_slots = slots_on_bus[: self.modules_per_bus[channel]]
        is_imu_due = [slot.module.is_imu_due() for slot in joint_slots]
        readings = self._sensors[channel].read(
            self.motors.torque_nm / self._torque_ratios, self.motors.find_derated(), is_imu_due
        )
        first_joint = sum(self.modules_per_bus[:channel])
        for slot in slots_on_bus:
            slot.module.handle_sync(count, readings[slot.joint - first_joint])
            self._apply_module_outputs(slot)

        # Answers to the same Sync arrive in the order of arbitration: the lowest id first.
        outgoing[sent_before:] = sorted(outgoing[sent_before:], key=lambda answer: answer.id)

    def _advance_to_sync(self, sync_time: int) -> None:
        """Advance by the time from the latest Sync to this one. The first sets zero, as does one of another clock."""
        later_us = 0
        if self._last_sync_time is not None:
            later_us = (sync_time - self._last_sync_time) % SYNC_TIME_RANGE_US
        earlier_us = SYNC_TIME_RANGE_US - later_us
        if 0 < later_us <= MAX_SYNC_INTERVAL_US:
            until_us = self.now_us + later_us
            self._run_physics(until_us, round(until_us / self._step_us) - self._step_count)
        elif 0 < earlier_us < MIN_HOST_RESTART_US:
            return
        self._last_sync_time = sync_time

    def _send_pose_once(self, sync_time: int) -> None:
        """Send the pose for a Sync; a Sync of the same time on another bus sends none."""
        if self._camera is None or self._send_pose is None or sync_time == self._pose_time:
            return
        self._pose_time = sync_time
        sample = self._camera.capture(round(self.now_us * 1000))
        if sample is not None:
            self._send_pose(self._encode(sample))

    # --- frames and demands of the modules -----------------------------------------------------------------

    def _apply_module_outputs(self, slot: ModuleSlot) -> None:
        """Send a module's frames, and apply its demand to its motor."""
        for frame in slot.pop_frames():
            if self.is_stepped:
                self._outgoing[slot.channel].append(frame)
            else:
                self.buses[slot.channel].enqueue(slot.sender, frame, self.now_us)
        if slot.module.demand is not slot.driven and slot.drives:
            self._drive_motor(slot)

    def _drive_motor(self, slot: ModuleSlot) -> None:
        """Apply a module's demand and gains to its motor, converted from the module's shaft to the joint.

        The module computes torques from its current, so the real torques are those times its torque ratio.

        Args:
            slot: Place of the module on the bus, with the joint that it moves; its `driven` demand is updated.
        """
        demand = slot.module.demand
        slot.driven = demand
        values = slot.module.parameters.values
        damping = ModuleParameter.VELOCITY_GAIN
        if demand.mode == JointMode.POSITION:
            damping = ModuleParameter.DAMPING
        torque_limit_nm = inf
        if demand.mode != JointMode.PASSIVE:
            torque_limit_nm = min(demand.torque_limit_nm, values[ModuleParameter.TORQUE_LIMIT])
        set_shaft_demand(
            self.motors,
            slot.joint,
            slot.joint_model.drive,
            float(self._torque_ratios[slot.joint]),
            mode=demand.mode,
            target=demand.target,
            torque_limit_nm=torque_limit_nm,
            stiffness=values[ModuleParameter.STIFFNESS],
            damping=values[damping],
            speed_limit_rad_s=values[ModuleParameter.SPEED_LIMIT],
        )

    # --- injected faults -----------------------------------------------------------------------------------

    def inject(self, fault: FaultInjection, *, begins: bool = True) -> None:
        """Start or end a fault now."""
        self._apply_fault(FaultTransition(self.now_us / 1e6, fault, begins), self.now_us)
        self._poll_modules(self.now_us)

    def _apply_fault(self, change: FaultTransition, now_us: float) -> None:
        fault = change.injection
        begins = change.is_start
        joint = fault.target_index
        slot = self.slots[joint]
        self.fault_log.append(f"{now_us * 1e-6:.2f} s {fault} {'begins' if begins else 'ends'}")
        match fault.kind:
            case "overheat":
                self.thermal.inject_heat(joint, heat=begins, hold=begins and fault.end_s != inf)
                self._derate_motors()
            case "duplicate":
                self._set_duplicate(slot, begins, now_us)
            case "babble":
                self._set_babbling(slot, begins, now_us)
            case kind:
                slot.set_fault(kind, begins, now_us)

    def _set_duplicate(self, slot: ModuleSlot, begins: bool, now_us: float) -> None:
        """Add a second module with the node id of a module, or remove it."""
        if begins:
            serial = slot.module.serial ^ DUPLICATE_SERIAL_MASK
            self._add_module(slot.joint, slot.channel, serial, now_us - BOOT_US, drives=False)
            return
        duplicates = self.slots[self.module_count :]
        self.slots[self.module_count :] = [
            other for other in duplicates if other.joint != slot.joint
        ]

    def _set_babbling(self, slot: ModuleSlot, begins: bool, now_us: float) -> None:
        """Let a module send heartbeats without a pause, or end that."""
        if self.is_stepped:
            self._babble_start_us_by_slot.pop(slot, None)
            if begins:
                self._babble_start_us_by_slot[slot] = now_us
            return
        frame = slot.module.make_heartbeat(now_us) if begins else None
        self.buses[slot.channel].set_babbling(slot.sender, frame, now_us)
