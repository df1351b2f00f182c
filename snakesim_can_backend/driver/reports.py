"""Collects the reports of the joint modules: the raw numbers of every joint, and counts of wrong frames.

This module is pure: it gets frames and the numbers of Syncs, and uses neither a clock nor a bus. It stores values as
raw integers, and scales them for all joints at once when a control cycle reads them.
"""

from binascii import crc_hqx
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import (
    COUNTER_MODULUS,
    FROM_HOST,
    MAX_UPTIME_MS,
    UPTIME_RANGE_MS,
    CanFrame,
    CommandAction,
    LastStop,
    ModuleFault,
    ModuleState,
    Opcode,
    frame_id,
    parse_node,
    parse_opcode,
)
from snakesim_hal.base.arrays import Floats

MAX_REPORT_DELAY_SYNCS = 3  # from a module's fault to the heartbeat that gives its reason
# Heartbeats whose uptimes differ by less are of one module; it sends one every 100 ms.
MAX_HEARTBEAT_GAP_MS = 350
# A state that is later has a wrong counter; one that is not is accepted, with its age.
MAX_LATE_SYNCS = 3
NO_CONTACT = b""  # report of a link that touches nothing

# Signals of each frame in the order in which this module reads them.
STATE_SIGNALS = ("angle", "velocity", "torque", "count", "state")
SHAFT_SIGNALS = STATE_SIGNALS[:3]
COUNT_INDEX = STATE_SIGNALS.index("count")
STATE_INDEX = STATE_SIGNALS.index("state")
CONTACT_SIGNALS = ("force_x", "force_y", "force_z", "along", "bearing")
GYRO_SIGNALS = ("rate_x", "rate_y", "rate_z", "count")
ACCELERATION_SIGNALS = ("acceleration_x", "acceleration_y", "acceleration_z", "count")
HEALTH_SIGNALS = ("voltage", "current", "motor_temperature", "board_temperature", "leak")
HEARTBEAT_SIGNALS = (
    "state",
    "last_stop",
    "uptime",
    *(f"fault_{fault.name.lower()}" for fault in ModuleFault),
)

# The state field has four bits; a number that the protocol does not define counts as FAULT.
STATES = [ModuleState(i) if i < len(ModuleState) else ModuleState.FAULT for i in range(16)]
# A module leaves them only after a Clear.
LATCHED_STATES = ModuleState.FAULT, ModuleState.EMERGENCY


@dataclass
class ModuleStatus:
    """What the driver knows of one module. Numbers of Syncs count from the start, without wrapping around."""

    node_id: int

    # Newest joint state.
    sync: int = -1  # the Sync that the newest good state answers; -1: none yet
    state: ModuleState = ModuleState.BOOT
    last_count: int = -1  # 0 to 15, as in the frame
    is_awaited: bool = True  # whether the module has answered recently
    stopped_syncs: int = 0  # consecutive states that were FAULT or EMERGENCY

    # Wrong frames.
    repeated_state_count: int = 0  # consecutive states with the same count
    wrong_counter_count: int = 0  # consecutive
    corrupt_state_count: int = 0  # consecutive states with a wrong checksum
    # Consecutive Syncs that were answered more than once, up to `double_answer_sync`.
    double_answers: int = 0
    double_answer_sync: int = -1
    frame_count: int = 0  # in this control cycle

    # Heartbeats and Health reports.
    uptime_ms: int = -1  # -1: no heartbeat yet
    previous_uptime_ms: int = -1
    uptime_decreased: bool = False  # in the newest heartbeat
    # Times that the uptime decreased and continued from there, unlike after a late heartbeat.
    restarts: int = 0
    faults: int = 0  # bits of ModuleFault, from the newest heartbeat
    last_stop: LastStop = LastStop.NONE
    heartbeat_sync: int = -1  # the Sync before the newest heartbeat
    health_sync: int = -1  # the Sync before the newest Health report

    @property
    def is_clear_required(self) -> bool:
        """Return whether the state is latched and the module has had time to report the reason in a heartbeat."""
        reason_is_due = bool(self.faults) or self.stopped_syncs >= MAX_REPORT_DELAY_SYNCS
        return self.state in LATCHED_STATES and reason_is_due

    def count_double_answers(self, sync: int) -> int:
        """Return how many consecutive Syncs, up to this one, the module answered more than once."""
        if self.double_answer_sync < sync - 1:
            return 0
        return self.double_answers

    def list_fault_names(self) -> list[str]:
        """Return the names of the active fault bits, in lower case."""
        return [fault.name.lower() for fault in ModuleFault if self.faults >> fault & 1]


class ModuleReports:
    """The newest reports of all modules of a robot. Joint i is node i + 1."""

    def __init__(self, joint_count: int) -> None:
        """Prepare to read the frames of all modules of a robot, none of which has sent a report yet.

        Functions that read each kind of frame are compiled here, because they run for every frame.

        Args:
            joint_count: Number of joints. Joint i has node i + 1.
        """
        self.modules = [ModuleStatus(node) for node in range(1, joint_count + 1)]

        # What is still missing of the answers to the newest Sync.
        self.sync = -1  # number of the newest Sync; -1: none was sent
        self.states_missing = joint_count
        self.contacts_missing = 0
        self.answers_missing = 0  # to parameter requests

        # Frames that no module of this robot should send.
        # Frames by node, since the last control cycle.
        self.unknown_node_frame_counts: Counter[int] = Counter()
        self.other_host_frame_counts: Counter[Opcode] = Counter()
        self.malformed = 0  # frames of known modules with a wrong length

        # Raw numbers of the newest reports, by joint or link; None: no report yet.
        self._raw_shaft_values = [(0,) * len(STATE_SIGNALS) for _ in range(joint_count)]
        self._contacts: list[bytes | None] = [None] * (joint_count + 1)
        self._gyro: list[tuple[int, ...] | None] = [None] * joint_count
        self._acceleration: list[tuple[int, ...] | None] = [None] * joint_count
        self._health: list[tuple[int, ...] | None] = [None] * joint_count
        self.shaft_raw: list[int | None] = [None] * joint_count

        # Frame layouts.
        layouts = load_layouts()
        joint_state = layouts[Opcode.JOINT_STATE]
        contact = layouts[Opcode.CONTACT]
        command = layouts[Opcode.COMMAND]
        self._read_state = joint_state.make_reader(*STATE_SIGNALS)
        self._shaft_scale = np.array([[joint_state.signals[name].scale] for name in SHAFT_SIGNALS])
        self._read_contact = contact.make_reader(*CONTACT_SIGNALS)
        self._read_touch = contact.make_reader("count", "touched")
        self._read_gyro = layouts[Opcode.GYRO].make_reader(*GYRO_SIGNALS)
        self._read_acceleration = layouts[Opcode.ACCELEROMETER].make_reader(*ACCELERATION_SIGNALS)
        self._read_health = layouts[Opcode.HEALTH].make_reader(*HEALTH_SIGNALS)
        self._read_shaft_load = layouts[Opcode.SHAFT_LOAD].make_reader("torque")
        self._read_heartbeat = layouts[Opcode.HEARTBEAT].make_reader(*HEARTBEAT_SIGNALS)
        self._read_action = command.make_reader("action")
        self._command_length = command.length

        # Functions rather than bound methods, which would keep this object until the garbage collector runs.
        handlers = {
            Opcode.JOINT_STATE: ModuleReports._handle_joint_state,
            Opcode.CONTACT: ModuleReports._handle_contact,
            Opcode.TAIL_CONTACT: ModuleReports._handle_tail_contact,
            Opcode.HEARTBEAT: ModuleReports._handle_heartbeat,
            Opcode.GYRO: ModuleReports._handle_gyro,
            Opcode.ACCELEROMETER: ModuleReports._handle_acceleration,
            Opcode.SHAFT_LOAD: ModuleReports._handle_shaft_load,
            Opcode.HEALTH: ModuleReports._handle_health,
        }
        self._handlers = {
            frame_id(opcode, module.node_id): (handler, module, layouts[opcode].length)
            for opcode, handler in handlers.items()
            for module in self.modules
        }

    # --- one Sync ---------------------------------------------------------------------------------------------

    def start_sync(
        self, sync: int, *, has_contacts: bool, has_tail_contact: bool, query_count: int = 0
    ) -> None:
        """Start to count the responses to a Sync. Only modules that have responded recently are waited for.

        Args:
            sync: Number of this Sync.
            has_contacts: Whether the modules report contact forces at this Sync.
            has_tail_contact: Whether the tail link sends a contact report of its own, too.
            query_count: Number of parameter requests that are sent with this Sync.
        """
        self.sync = sync
        for module in self.modules:
            module.is_awaited = module.sync >= sync - 1 - MAX_LATE_SYNCS or module.sync < 0
        self.states_missing = sum(module.is_awaited for module in self.modules)
        self.contacts_missing = 0
        if has_contacts:
            # The first module also reports for the tail link.
            is_tail_awaited = has_tail_contact and self.modules[0].is_awaited
            self.contacts_missing = self.states_missing + is_tail_awaited
            self._contacts = [None] * len(self._contacts)
        self.answers_missing = query_count
        self.reset_frame_counts()

    @property
    def is_complete(self) -> bool:
        """Return whether all awaited modules have answered."""
        return self.states_missing <= 0 and self.contacts_missing <= 0 and self.answers_missing <= 0

    def reset_frame_counts(self) -> None:
        """Forget how many frames each module sent, because the counts cover more than one period."""
        for module in self.modules:
            module.frame_count = 0

    def reset_sender_counts(self) -> None:
        """Forget the frames of unknown nodes and of other hosts, because the next control cycle counts its own."""
        self.unknown_node_frame_counts.clear()
        self.other_host_frame_counts.clear()

    def process_frame(self, frame: CanFrame) -> None:
        """Store the report in one received frame, or count the frame if it is none of this robot's."""
        known = self._handlers.get(frame.id)
        if known is None:
            self._count_other_frame(frame)
            return
        handler, module, length = known
        module.frame_count += 1
        if len(frame.data) == length:
            handler(self, module, frame)
        else:
            self.malformed += 1

    def _count_other_frame(self, frame: CanFrame) -> None:
        opcode = parse_opcode(frame.id)
        node = parse_node(frame.id)
        if opcode in FROM_HOST:
            if not self._is_identify(frame):
                self.other_host_frame_counts[Opcode(opcode)] += 1
        elif not 1 <= node <= len(self.modules):
            self.unknown_node_frame_counts[node] += 1
        else:
            self.modules[node - 1].frame_count += 1
            self.answers_missing -= opcode == Opcode.PARAMETER_ANSWER

    def _is_identify(self, frame: CanFrame) -> bool:
        """Return whether a frame of another host only requests the identity of modules, which disturbs nothing."""
        if parse_opcode(frame.id) != Opcode.COMMAND or len(frame.data) != self._command_length:
            return False
        return self._read_action(frame.data) == (CommandAction.IDENTIFY,)

    # --- values -----------------------------------------------------------------------------------------------

    def shaft_values(self) -> Floats:
        """Return the angle in rad, velocity in rad/s and torque in N·m of every module's shaft, (3, n_joints)."""
        return np.array(self._raw_shaft_values).T[: len(SHAFT_SIGNALS)] * self._shaft_scale

    def list_contacts(self) -> list[tuple[int, tuple[int, ...]]]:
        """Return every link that reported a contact at this Sync, with the raw numbers of CONTACT_SIGNALS."""
        return [
            (link, self._read_contact(data)) for link, data in enumerate(self._contacts) if data
        ]

    def pop_imu_reports(self) -> list[tuple[int, Sequence[int], Sequence[int]]]:
        """Remove and return the complete reports of all IMUs that have arrived since the last call.

        A report is complete if gyro and accelerometer were sampled at the same Sync (the CAN message that starts a
        sample). An incomplete one is kept until its other half arrives.

        Returns:
            Link index, raw angular rates (3,) and raw accelerations (3,) of each complete report.
        """
        reports: list[tuple[int, Sequence[int], Sequence[int]]] = []
        for joint, (gyro, acceleration) in enumerate(
            zip(self._gyro, self._acceleration, strict=True)
        ):
            if gyro is None or acceleration is None:
                continue
            *rates, gyro_sync_counter = gyro
            *accelerations, acceleration_sync_counter = acceleration
            if gyro_sync_counter != acceleration_sync_counter:
                continue
            # A module carries its IMU in the link ahead of its joint; link 0 is the tail.
            link = joint + 1
            reports.append((link, rates, accelerations))
            self._gyro[joint] = None
            self._acceleration[joint] = None
        return reports

    def list_health_reports(self) -> list[tuple[int, ...] | None]:
        """Return the raw numbers of HEALTH_SIGNALS of every module; None where no report has arrived yet."""
        return self._health

    # --- one kind of frame each -------------------------------------------------------------------------------

    def _handle_joint_state(self, module: ModuleStatus, frame: CanFrame) -> None:
        """Store the joint state that a module has sent, if its checksum and its count are valid.

        The count is the number of the Sync to which the module responds, modulo COUNTER_MODULUS. A response to an older
        Sync is accepted if it is at most MAX_LATE_SYNCS late.

        Args:
            module: Status of the module that sent the frame, which is updated.
            frame: Received joint state.
        """
        identifier, data = frame
        # `has_valid_checksum`, without the cost of a call.
        if crc_hqx(data[:-1], identifier) & 0xFF != data[-1]:
            module.corrupt_state_count += 1
            return
        raw_values = self._read_state(data)
        count = raw_values[COUNT_INDEX]
        if count == module.last_count:
            module.repeated_state_count += 1
        else:
            module.repeated_state_count = 0
        module.last_count = count
        lateness_syncs = (self.sync - count) % COUNTER_MODULUS
        if lateness_syncs > MAX_LATE_SYNCS:
            module.wrong_counter_count += 1
            return
        sync = self.sync - lateness_syncs
        if sync <= module.sync:
            if lateness_syncs == 0:
                self._count_double_answer(module)
            return
        module.corrupt_state_count = 0
        module.wrong_counter_count = 0
        module.sync = sync
        module.state = STATES[raw_values[STATE_INDEX]]
        if module.state in LATCHED_STATES:
            module.stopped_syncs += 1
        else:
            module.stopped_syncs = 0
        self._raw_shaft_values[module.node_id - 1] = raw_values
        if lateness_syncs == 0:
            self.states_missing -= module.is_awaited

    def _count_double_answer(self, module: ModuleStatus) -> None:
        """Count a Sync that a module answered more than once; a third answer to it is not counted again."""
        if module.double_answer_sync >= self.sync:
            return
        if module.double_answer_sync == self.sync - 1:
            module.double_answers += 1
        else:
            module.double_answers = 1
        module.double_answer_sync = self.sync

    def _handle_contact(self, module: ModuleStatus, frame: CanFrame) -> None:
        self._store_contact(module, module.node_id, frame.data)

    def _handle_tail_contact(self, module: ModuleStatus, frame: CanFrame) -> None:
        self._store_contact(module, module.node_id - 1, frame.data)

    def _store_contact(self, module: ModuleStatus, link_index: int, data: bytes) -> None:
        """Store the first contact report of a link that answers the newest Sync."""
        count, touched = self._read_touch(data)
        answers_this_sync = (self.sync - count) % COUNTER_MODULUS == 0
        if answers_this_sync and self._contacts[link_index] is None:
            self._contacts[link_index] = data if touched else NO_CONTACT
            self.contacts_missing -= module.is_awaited

    def _handle_heartbeat(self, module: ModuleStatus, frame: CanFrame) -> None:
        state, last_stop, uptime_ms, *fault_bits = self._read_heartbeat(frame.data)
        self._update_uptime(module, uptime_ms)
        module.heartbeat_sync = self.sync
        module.faults = sum(bit << i for i, bit in enumerate(fault_bits))
        module.last_stop = LastStop(last_stop) if last_stop < len(LastStop) else LastStop.NONE
        module.state = STATES[state]

    def _update_uptime(self, module: ModuleStatus, uptime_ms: int) -> None:
        """Store an uptime, and count a restart if the uptime decreased and then continued from the lower value."""
        continues = 0 <= uptime_ms - module.uptime_ms < MAX_HEARTBEAT_GAP_MS
        if module.uptime_decreased and continues and uptime_ms < module.previous_uptime_ms:
            module.restarts += 1
        module.uptime_decreased = uptime_ms < module.uptime_ms and not has_wrapped(
            module.uptime_ms, uptime_ms
        )
        module.previous_uptime_ms = module.uptime_ms
        module.uptime_ms = uptime_ms

    def _handle_gyro(self, module: ModuleStatus, frame: CanFrame) -> None:
        self._gyro[module.node_id - 1] = self._read_gyro(frame.data)

    def _handle_acceleration(self, module: ModuleStatus, frame: CanFrame) -> None:
        self._acceleration[module.node_id - 1] = self._read_acceleration(frame.data)

    def _handle_shaft_load(self, module: ModuleStatus, frame: CanFrame) -> None:
        (torque,) = self._read_shaft_load(frame.data)
        self.shaft_raw[module.node_id - 1] = torque

    def _handle_health(self, module: ModuleStatus, frame: CanFrame) -> None:
        self._health[module.node_id - 1] = self._read_health(frame.data)
        module.health_sync = self.sync


def has_wrapped(before_ms: int, now_ms: int) -> bool:
    """Return whether an uptime continued from 0 because its 32 bits were full, after 49.7 days.

    The protocol forbids that, but a firmware that does so must not stop the robot. A real restart within that third of
    a second is still detected, by the module's state. The protocol demands that an uptime at the end of its range stays
    there; a lower uptime after that is a restart.
    """
    if before_ms >= MAX_UPTIME_MS:
        return False
    return (now_ms - before_ms) % UPTIME_RANGE_MS < MAX_HEARTBEAT_GAP_MS
