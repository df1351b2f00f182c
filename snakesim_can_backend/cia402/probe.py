"""A second program that reads one CiA 402 drive."""

from snakesim_can_backend.can_drives.probe import CanDriveProbe
from snakesim_can_backend.cia402.configuration import list_configuration_steps
from snakesim_can_backend.cia402.frames import (
    UPLOAD_RESPONSE,
    FunctionCode,
    decode_sdo,
    encode_read,
    split_id,
)
from snakesim_can_backend.cia402.objects import STATUSWORD, ObjectEntry
from snakesim_can_backend.cia402.sdo import ReadStep
from snakesim_can_backend.cia402.state_machine import PowerState, decode_statusword
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_drivers.kit.drive_probe import DriveStatus, ReadBack

ENABLED_STATES = (PowerState.ENABLED, PowerState.QUICK_STOP)


class NodeProbe(CanDriveProbe):
    """Reads objects of a node by SDO."""

    def read_status(self, timeout_s: float) -> DriveStatus | None:
        """Read the statusword."""
        word = self._read_entry(STATUSWORD, timeout_s)
        if word is None:
            return None
        state = decode_statusword(word)
        return DriveStatus(state in ENABLED_STATES, state.value)

    def read_configuration(self, timeout_s: float) -> list[ReadBack]:
        """Read every object that the driver reads back at its start: watchdog, reactions and PDO mapping."""
        values: list[ReadBack] = []
        for step in list_configuration_steps(self.node_id, self.settings, self.period_s):
            if not isinstance(step, ReadStep) or step.expected is None:
                continue
            value = self._read_entry(step.entry, timeout_s)
            if value is None and step.optional:
                continue
            reported = None if value is None else value & step.mask
            name = f"{step.entry.name} ({step.entry.address})"
            values.append(ReadBack(name, "1", step.expected & step.mask, reported))
        return values

    def _read_entry(self, entry: ObjectEntry, timeout_s: float) -> int | None:
        def decode(frame: CanFrame) -> int | None:
            if split_id(frame) != (FunctionCode.SDO_RESPONSE, self.node_id):
                return None
            response = decode_sdo(frame.data)
            if response.kind != UPLOAD_RESPONSE or (response.index, response.sub) != (
                entry.index,
                entry.sub,
            ):
                return None
            return entry.decode(response.data)

        return self.request(
            CanFrame(FunctionCode.SDO_REQUEST | self.node_id, encode_read(entry)), decode, timeout_s
        )
