"""The modules' reports: raw numbers per joint, and counts of wrong frames.

Pure: frames and Sync numbers in, no clock and no bus. Values are stored as raw integers, and scaled for all joints at
once when a tick reads them.
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
    CommandAction,
    Frame,
    LastStop,
    ModuleFault,
    ModuleState,
    Opcode,
    frame_id,
    parse_node,
    parse_opcode,
)
from snakesim_hal.base.arrays import Floats

TOLD_WITHIN = 3  # Syncs from a module's fault to its heartbeat, at most
ONE_CLOCK_MS = 350  # two heartbeats whose uptimes differ by no more are of the same module
LATE_SYNCS = 3  # a state this many Syncs late is still accepted, with its age; older counts are wrong
COUNT_AT, STATE_AT = 3, 4  # in the result of `_read_state`
UNTOUCHED = b""
# Unknown ones count as FAULT.
STATES = [ModuleState(i) if i < len(ModuleState) else ModuleState.FAULT for i in range(16)]
STOPPED = (ModuleState.FAULT, ModuleState.EMERGENCY)  # until a Clear


@dataclass
class ModuleStatus:
    """The state of one module. Numbers of Syncs are not modulo."""

    node: int
    sync: int = -1  # that the newest good state answers; -1: none yet
    state: ModuleState = ModuleState.BOOT
    last_count: int = -1
    repeats: int = 0  # states in a row with the same count
    wrong_counts: int = 0  # in a row
    corrupt: int = 0  # in a row
    twice: int = 0  # Syncs in a row that were answered more than once, up to `twice_at`
    twice_at: int = -1
    frames: int = 0  # in this tick
    awaited: bool = True  # whether it has answered recently
    uptime_ms: int = -1
    uptime_before_ms: int = -1
    went_back: bool = False  # whether its uptime decreased in the newest heartbeat
    restarts: int = 0  # times that its uptime decreased and continued from there, unlike after a late heartbeat
    faults: int = 0  # bits, from the newest heartbeat
    last_stop: LastStop = LastStop.NONE
    heartbeat_sync: int = -1
    health_sync: int = -1  # of the last Health report
    stopped_syncs: int = 0  # in a row, in which its state was fault or emergency

    @property
    def needs_clearing(self) -> bool:
        """Whether it is in a latched state, and its heartbeat had the time to report the reason."""
        return self.state in STOPPED and (bool(self.faults) or self.stopped_syncs >= TOLD_WITHIN)

    def answered_twice(self, sync: int) -> int:
        """Syncs in a row, up to now, that were answered more than once."""
        return self.twice if self.twice_at >= sync - 1 else 0

    def fault_names(self) -> list[str]:
        """Names of the fault bits."""
        return [fault.name.lower() for fault in ModuleFault if self.faults >> fault & 1]


class ModuleReports:
    """The reports of all modules of a robot so far; joint i is node i + 1."""

    def __init__(self, joints: int) -> None:
        self.modules = [ModuleStatus(node) for node in range(1, joints + 1)]
        self.sync = -1  # the newest one sent
        self.states_missing = joints
        self.contacts_missing = 0
        self.answers_missing = 0  # to parameter requests
        self.unknown_nodes: Counter[int] = Counter()  # frames of unexpected nodes, since the last tick
        self.from_other_host: Counter[Opcode] = Counter()
        self.malformed = 0
        layouts = load_layouts()
        self._joint = [(0,) * 5 for _ in range(joints)]  # as returned by `_read_state`
        self._contact: list[bytes | None] = [None] * (joints + 1)  # by link; None: no report yet
        self._gyro: list[tuple[int, ...] | None] = [None] * joints
        self._acceleration: list[tuple[int, ...] | None] = [None] * joints
        self._health: list[tuple[int, ...] | None] = [None] * joints
        self.shaft_raw: list[int | None] = [None] * joints
        self._read_state = layouts[Opcode.JOINT_STATE].make_reader("angle", "velocity", "torque", "count", "state")
        signals = layouts[Opcode.JOINT_STATE].signals
        self._state_scale = np.array([[signals[name].scale] for name in ("angle", "velocity", "torque")])
        contact = layouts[Opcode.CONTACT]
        self._read_contact = contact.make_reader("force_x", "force_y", "force_z", "along", "bearing")
        self._read_touch = contact.make_reader("count", "touched")
        self._read_gyro = layouts[Opcode.GYRO].make_reader("rate_x", "rate_y", "rate_z", "count")
        names = ("acceleration_x", "acceleration_y", "acceleration_z", "count")
        self._read_acceleration = layouts[Opcode.ACCELEROMETER].make_reader(*names)
        names = ("voltage", "current", "motor_temperature", "board_temperature", "leak")
        self._read_health = layouts[Opcode.HEALTH].make_reader(*names)
        self._read_shaft = layouts[Opcode.SHAFT_LOAD].make_reader("torque")
        command = layouts[Opcode.COMMAND]
        self._read_action, self._command_length = command.make_reader("action"), command.length
        faults = [f"fault_{fault.name.lower()}" for fault in ModuleFault]
        self._read_heartbeat = layouts[Opcode.HEARTBEAT].make_reader("state", "last_stop", "uptime", *faults)
        # Functions rather than bound methods, which would keep this object until the garbage collector comes.
        takers = {
            Opcode.JOINT_STATE: ModuleReports._take_state,
            Opcode.CONTACT: ModuleReports._take_contact,
            Opcode.TAIL_CONTACT: ModuleReports._take_tail_contact,
            Opcode.HEARTBEAT: ModuleReports._take_heartbeat,
            Opcode.GYRO: ModuleReports._take_gyro,
            Opcode.ACCELEROMETER: ModuleReports._take_acceleration,
            Opcode.SHAFT_LOAD: ModuleReports._take_shaft,
            Opcode.HEALTH: ModuleReports._take_health,
        }
        self._known = {
            frame_id(opcode, module.node): (take, module, layouts[opcode].length)
            for opcode, take in takers.items()
            for module in self.modules
        }

    def begin_sync(self, sync: int, *, contacts: bool, tail: bool, questions: int = 0) -> None:
        """A Sync is sent. Only modules that have answered recently are waited for.

        contacts, tail: whether force reports are due, and whether the tail link sends one of its own.
        questions: number of parameter requests that are sent with it.
        """
        self.sync = sync
        for module in self.modules:
            module.awaited = module.sync >= sync - 1 - LATE_SYNCS or module.sync < 0
        self.states_missing = sum(module.awaited for module in self.modules)
        self.contacts_missing = (self.states_missing + (tail and self.modules[0].awaited)) if contacts else 0
        self.answers_missing = questions
        if contacts:
            self._contact = [None] * len(self._contact)
        self.forget_frames()

    @property
    def complete(self) -> bool:
        """Whether all awaited modules have answered."""
        return self.states_missing <= 0 and self.contacts_missing <= 0 and self.answers_missing <= 0

    def process_frame(self, frame: Frame) -> None:
        """Process one frame."""
        known = self._known.get(frame.id)
        if known is None:
            self._take_other(frame)
            return
        take, module, length = known
        module.frames += 1
        if len(frame.data) == length:
            take(self, module, frame)
        else:
            self.malformed += 1

    def _take_other(self, frame: Frame) -> None:
        opcode, node = parse_opcode(frame.id), parse_node(frame.id)
        if opcode in FROM_HOST:
            if not self._only_asks(frame):
                self.from_other_host[Opcode(opcode)] += 1
        elif not 1 <= node <= len(self.modules):
            self.unknown_nodes[node] += 1
        else:
            self.modules[node - 1].frames += 1
            self.answers_missing -= opcode == Opcode.PARAMETER_ANSWER

    def _only_asks(self, frame: Frame) -> bool:
        """Whether it is only an `identify` of another host."""
        is_command = parse_opcode(frame.id) == Opcode.COMMAND and len(frame.data) == self._command_length
        return is_command and self._read_action(frame.data) == (CommandAction.IDENTIFY,)

    def forget_frames(self) -> None:
        """Reset the frame counts, which cover more than one period."""
        for module in self.modules:
            module.frames = 0

    # --- joint states, in SI units ----------------------------------------------------------------------------

    def shaft_values(self) -> Floats:
        """Angle, velocity and torque of every module's shaft, (3, n_joints)."""
        return np.array(self._joint).T[:COUNT_AT] * self._state_scale

    def list_contacts(self) -> list[tuple[int, tuple[int, ...]]]:
        """(link, raw force x y z, place along and bearing) of every link that reported a contact at this Sync."""
        return [(link, self._read_contact(data)) for link, data in enumerate(self._contact) if data]

    def take_imu_reports(self) -> list[tuple[int, Sequence[int], Sequence[int]]]:
        """(link, raw rates, raw accelerations) of every link whose IMU has reported since the last call."""
        found = []
        for i, (gyro, acceleration) in enumerate(zip(self._gyro, self._acceleration, strict=True)):
            if gyro is not None and acceleration is not None and gyro[3] == acceleration[3]:  # of one Sync
                found.append((i + 1, gyro[:3], acceleration[:3]))
                self._gyro[i] = self._acceleration[i] = None
        return found

    def health(self) -> list[tuple[int, ...] | None]:
        """Raw voltage, current, two temperatures and leak of every module; None: no report yet."""
        return self._health

    # --- one kind of frame each ---------------------------------------------------------------------------------

    def _take_state(self, module: ModuleStatus, frame: Frame) -> None:
        identifier, data = frame
        if crc_hqx(data[:-1], identifier) & 0xFF != data[-1]:  # `intact`, without a call
            module.corrupt += 1
            return
        numbers = self._read_state(data)
        count = numbers[COUNT_AT]
        module.repeats = module.repeats + 1 if count == module.last_count else 0
        module.last_count = count
        late = (self.sync - count) % COUNTER_MODULUS
        if late > LATE_SYNCS:
            module.wrong_counts += 1
            return
        sync = self.sync - late
        if sync <= module.sync:
            if late == 0:
                self._answered_twice(module)
            return
        module.corrupt = module.wrong_counts = 0
        module.sync = sync
        module.state = STATES[numbers[STATE_AT]]
        module.stopped_syncs = module.stopped_syncs + 1 if module.state in STOPPED else 0
        self._joint[module.node - 1] = numbers
        if late == 0:
            self.states_missing -= module.awaited

    def _answered_twice(self, module: ModuleStatus) -> None:
        if module.twice_at < self.sync:
            module.twice = module.twice + 1 if module.twice_at == self.sync - 1 else 1
            module.twice_at = self.sync

    def _take_contact(self, module: ModuleStatus, frame: Frame) -> None:
        self._take_link(module, module.node, frame.data)

    def _take_tail_contact(self, module: ModuleStatus, frame: Frame) -> None:
        self._take_link(module, module.node - 1, frame.data)

    def _take_link(self, module: ModuleStatus, link: int, data: bytes) -> None:
        count, touched = self._read_touch(data)
        if (self.sync - count) % COUNTER_MODULUS == 0 and self._contact[link] is None:
            self._contact[link] = data if touched else UNTOUCHED
            self.contacts_missing -= module.awaited

    def _take_heartbeat(self, module: ModuleStatus, frame: Frame) -> None:
        state, last_stop, uptime_ms, *bits = self._read_heartbeat(frame.data)
        goes_on = 0 <= uptime_ms - module.uptime_ms < ONE_CLOCK_MS
        if module.went_back and goes_on and uptime_ms < module.uptime_before_ms:
            module.restarts += 1
        module.went_back = uptime_ms < module.uptime_ms and not has_wrapped(module.uptime_ms, uptime_ms)
        module.uptime_before_ms, module.uptime_ms = module.uptime_ms, uptime_ms
        module.heartbeat_sync = self.sync
        module.faults = sum(bit << i for i, bit in enumerate(bits))
        module.last_stop = LastStop(last_stop) if last_stop < len(LastStop) else LastStop.NONE
        module.state = STATES[state]

    def _take_gyro(self, module: ModuleStatus, frame: Frame) -> None:
        self._gyro[module.node - 1] = self._read_gyro(frame.data)

    def _take_acceleration(self, module: ModuleStatus, frame: Frame) -> None:
        self._acceleration[module.node - 1] = self._read_acceleration(frame.data)

    def _take_shaft(self, module: ModuleStatus, frame: Frame) -> None:
        self.shaft_raw[module.node - 1] = self._read_shaft(frame.data)[0]

    def _take_health(self, module: ModuleStatus, frame: Frame) -> None:
        self._health[module.node - 1] = self._read_health(frame.data)
        module.health_sync = self.sync


def has_wrapped(before_ms: int, now_ms: int) -> bool:
    """Return whether an uptime went on from 0 because its 32 bits were full, after 49.7 days.

    The protocol forbids that, but a firmware that does so must not stop the robot: such a module goes on, and a restart
    of it in that third of a second would show in its state. An uptime at the end of its range has stayed there, as the
    protocol demands; from there a lower one is a restart.
    """
    if before_ms >= MAX_UPTIME_MS:
        return False
    return (now_ms - before_ms) % UPTIME_RANGE_MS < ONE_CLOCK_MS
