"""A second program that reads one moteus controller."""

from snakesim_can_backend.can_drives.probe import CanDriveProbe
from snakesim_can_backend.moteus.controllers import describe_fault
from snakesim_can_backend.moteus.protocol import (
    INT8,
    INT32,
    READ,
    REGISTER_MAP,
    REPLY,
    MoteusMode,
    Register,
    decode_subframes,
    encode_subframe,
    make_frame,
    split_addresses,
)
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_drivers.kit.drive_probe import DriveStatus, ReadBack

PROBE_ID = 125  # the driver of the host has 0, and controllers are numbered from 1


class ControllerProbe(CanDriveProbe):
    """Reads registers of a controller. The watchdog time is part of each command, so no register confirms it."""

    def read_status(self, timeout_s: float) -> DriveStatus | None:
        """Read mode and fault."""
        registers = self._read_registers(
            [
                encode_subframe(READ, INT8, Register.MODE, count=1),
                encode_subframe(READ, INT8, Register.FAULT, count=1),
            ],
            Register.MODE,
            timeout_s,
        )
        if registers is None:
            return None
        mode = int(registers[Register.MODE])
        reason = describe_fault(mode, int(registers.get(Register.FAULT, 0)))
        return DriveStatus(
            mode == MoteusMode.POSITION, f"mode {mode}" + (f", {reason}" if reason else "")
        )

    def read_configuration(self, timeout_s: float) -> list[ReadBack]:
        """Read the version of the register map."""
        request = [encode_subframe(READ, INT32, Register.MAP_VERSION, count=1)]
        registers = self._read_registers(request, Register.MAP_VERSION, timeout_s)
        version = None if registers is None else registers[Register.MAP_VERSION]
        return [ReadBack("version of the register map", "1", REGISTER_MAP, version)]

    def _read_registers(
        self, subframes: list[bytes], required_register: int, timeout_s: float
    ) -> dict[int, float] | None:
        """Return the values of registers by number; None without an answer that has the required one."""

        def decode(frame: CanFrame) -> dict[int, float] | None:
            if split_addresses(frame) != (self.node_id, PROBE_ID):
                return None
            values: dict[int, float] = {}
            for subframe in decode_subframes(frame.data):
                if subframe.kind == REPLY:
                    values |= {
                        subframe.register + i: value for i, value in enumerate(subframe.values)
                    }
            return values if required_register in values else None

        return self.request(
            make_frame(PROBE_ID, self.node_id, *subframes, reply=True), decode, timeout_s
        )
