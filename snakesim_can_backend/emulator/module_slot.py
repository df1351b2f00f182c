"""A module's place on a bus: its node id, its joint, and its injected faults."""

from dataclasses import dataclass

from snakesim_can_backend.emulator.firmware import ModuleFirmware, MotorDemand
from snakesim_can_backend.protocol.definitions import CanFrame, Opcode, checksum, parse_opcode
from snakesim_can_backend.settings import CanSettings
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.model.robot_file.robot import RobotFile

SAGGED_FRACTION = 2 / 3  # of the minimum voltage, at an injected undervoltage

# The end of a JointState, for injected faults.
COUNT_BYTE = 6  # its lower four bits are the counter
COUNT_MASK = 0x0F
CHECKSUM_BYTE = 7
WRONG_COUNT_OFFSET = 7  # further from the right counter than any lost or late frame
WRONG_CHECKSUM_MASK = 0x5A


@dataclass(slots=True, eq=False)
class ModuleSlot:
    """One module, the joint that it moves, and the bus that it is on."""

    sender: int  # index in the queue of the bus
    channel: int  # index of the bus
    joint: int  # 0 at the tail
    module: ModuleFirmware
    joint_model: Joint  # the joint as it is really built
    drives: bool = True  # False: the module moves no motor, as a duplicate does not
    driven: MotorDemand | None = None  # the demand that was last applied to the motor

    # Injected faults.
    is_mute: bool = False
    has_wrong_counter: bool = False
    has_wrong_checksum: bool = False

    def __post_init__(self) -> None:
        """Switch the supply on."""
        self.module.health.voltage_v = self.joint_model.supply.voltage_v

    def set_fault(self, kind: str, is_active: bool, now_us: float) -> None:
        """Start or end an injected fault of this module; a kind that is no fault of a single module has no effect.

        Args:
            kind: Kind of the fault, such as "mute" or "leak".
            is_active: True to start the fault, False to end it.
            now_us: Current time.
        """
        health = self.module.health
        match kind:
            case "mute":
                self.is_mute = is_active
            case "freeze":
                self.module.is_hanging = is_active
            case "counter":
                self.has_wrong_counter = is_active
            case "checksum":
                self.has_wrong_checksum = is_active
            case "leak":
                health.leak = is_active
            case "undervoltage" if is_active:
                health.voltage_v = SAGGED_FRACTION * self.joint_model.limits.min_voltage_v
            case "undervoltage":
                health.voltage_v = self.joint_model.supply.voltage_v
            case "reboot" if is_active:
                self.module.reboot(now_us)
            case _:
                pass

    def update_health(
        self, speed_rad_s: float, power_w: float, winding_c: float, board_c: float
    ) -> None:
        """Update the internal measurements of the module."""
        health = self.module.health
        health.speed_rad_s = speed_rad_s
        health.winding_c = winding_c
        health.board_c = board_c
        health.current_a = self.joint_model.supply.idle_a + power_w / health.voltage_v

    def pop_frames(self) -> list[CanFrame]:
        """Return the frames that the module sends, with injected faults applied; each frame once."""
        frames = self.module.frames
        if not frames:
            return frames
        self.module.frames = []
        if self.is_mute:
            return []
        if self.has_wrong_counter or self.has_wrong_checksum:
            return [self._corrupt(frame) for frame in frames]
        return frames

    def _corrupt(self, frame: CanFrame) -> CanFrame:
        """Return a joint state with a wrong counter or checksum, and any other frame as it is."""
        if parse_opcode(frame.id) != Opcode.JOINT_STATE:
            return frame
        data = bytearray(frame.data)
        if self.has_wrong_counter:
            count_byte = data[COUNT_BYTE]
            has_wrong_counter = (count_byte + WRONG_COUNT_OFFSET) & COUNT_MASK
            data[COUNT_BYTE] = (count_byte & ~COUNT_MASK) | has_wrong_counter
            data[CHECKSUM_BYTE] = checksum(frame.id, bytes(data[:CHECKSUM_BYTE]))
        if self.has_wrong_checksum:
            data[CHECKSUM_BYTE] ^= WRONG_CHECKSUM_MASK
        return CanFrame(frame.id, bytes(data))


def assign_node_ids(robot: RobotFile, settings: CanSettings) -> list[int]:
    """Return the node id of every emulated module, tail to head.

    A module has the number of its joint, unless the settings give it another id.

    Args:
        robot: Robot file, with the names of the joints.
        settings: Settings of the backend, which may give modules other ids in `mounted`.

    Raises:
        ConfigError: A node id from 1 to the number of joints occurs more than once, or not at all.
    """
    names = [joint.name for joint in robot.joint_table]
    expected_ids = list(range(1, len(names) + 1))
    node_ids = list(expected_ids)
    for name, mount in settings.mounted.items():
        if mount.id is not None and name in names:
            node_ids[names.index(name)] = mount.id
    if sorted(node_ids) != expected_ids:
        raise ConfigError(
            f"`backends.can.mounted`: the modules would have the ids {node_ids}; give each from 1 to {len(names)} once",
            code="drive/unsupported-setting",
        )
    return node_ids
