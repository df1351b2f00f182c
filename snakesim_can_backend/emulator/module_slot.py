"""A module's place on a bus, and its injected faults."""

from dataclasses import dataclass

from snakesim_can_backend.emulator.firmware import Demand, ModuleFirmware
from snakesim_can_backend.protocol.definitions import Frame, Opcode, checksum, parse_opcode
from snakesim_hal.model.joints import Joint

SAGGED = 2 / 3  # of the least voltage


@dataclass(slots=True, eq=False)
class ModuleSlot:
    """One module, the joint it moves, and the bus it is on."""

    sender: int  # its index in the bus's queue
    channel: int
    joint: int  # 0 at the tail
    module: ModuleFirmware
    joint_model: Joint
    drives: bool = True  # False: it has no motor of its own; a duplicate
    driven: Demand | None = None  # the last demand applied to its motor
    mute: bool = False
    wrong_count: bool = False
    wrong_checksum: bool = False

    def __post_init__(self) -> None:
        """Under its supply."""
        self.module.health.voltage_v = self.joint_model.supply.voltage_v

    def set_fault(self, kind: str, wrong: bool, now_us: float) -> None:
        """Begin or end a fault of this module."""
        match kind:
            case "mute":
                self.mute = wrong
            case "freeze":
                self.module.hangs = wrong
            case "counter":
                self.wrong_count = wrong
            case "checksum":
                self.wrong_checksum = wrong
            case "leak":
                self.module.health.leak = wrong
            case "undervoltage":
                sagged_v = SAGGED * self.joint_model.limits.min_voltage_v
                self.module.health.voltage_v = sagged_v if wrong else self.joint_model.supply.voltage_v
            case "reboot" if wrong:
                self.module.reboot(now_us)
            case _:
                pass

    def update_health(self, speed_rad_s: float, power_w: float, winding_c: float, board_c: float) -> None:
        """Update its internal measurements."""
        inside = self.module.health
        inside.speed_rad_s, inside.winding_c = speed_rad_s, winding_c
        inside.board_c = board_c
        inside.current_a = self.joint_model.supply.idle_a + power_w / inside.voltage_v

    def take_frames(self) -> list[Frame]:
        """The module's frames to send, with faults applied; each frame once."""
        frames = self.module.frames
        if not frames:
            return frames
        self.module.frames = []
        if self.mute:
            return []
        if self.wrong_count or self.wrong_checksum:
            return [self._corrupted(frame) for frame in frames]
        return frames

    def _corrupted(self, frame: Frame) -> Frame:
        if parse_opcode(frame.id) != Opcode.JOINT_STATE:
            return frame
        data = bytearray(frame.data)
        if self.wrong_count:
            data[6] = (data[6] & 0xF0) | (data[6] + 7 & 0x0F)
            data[7] = checksum(frame.id, bytes(data[:7]))
        if self.wrong_checksum:
            data[7] ^= 0x5A
        return Frame(frame.id, bytes(data))
