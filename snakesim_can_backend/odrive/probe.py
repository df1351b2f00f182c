"""A second program that reads one ODrive axis."""

from snakesim_can_backend.bus.adapter import is_emulated
from snakesim_can_backend.can_drives.probe import CanDriveProbe
from snakesim_can_backend.odrive.endpoints import (
    EMULATED,
    SETTING_TYPES,
    VALUE_FORMATS,
    AxisSetting,
    EndpointIds,
    read_all_endpoints,
)
from snakesim_can_backend.odrive.protocol import (
    PAYLOADS,
    AxisState,
    MessageId,
    decode_setting_answer,
    describe_errors,
    encode_request,
    encode_setting_request,
    split_id,
)
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_drivers.kit.drive_probe import DriveStatus, ReadBack

WATCHDOG_TOLERANCE_S = 0.001


class AxisProbe(CanDriveProbe):
    """Reads the state of an axis from its heartbeat, and its watchdog by SDO."""

    def read_status(self, timeout_s: float) -> DriveStatus | None:
        """Poll the errors of the axis, and return the state in its next heartbeat."""

        def decode(frame: CanFrame) -> DriveStatus | None:
            if split_id(frame) != (self.node_id, MessageId.HEARTBEAT):
                return None
            errors, state, *_ = PAYLOADS[MessageId.HEARTBEAT].unpack(frame.data)
            text = f"state {state}"
            if errors:
                text += f", {describe_errors(errors)}"
            return DriveStatus(state == AxisState.CLOSED_LOOP, text)

        return self.request(encode_request(self.node_id, MessageId.ERROR), decode, timeout_s)

    def read_configuration(self, timeout_s: float) -> list[ReadBack]:
        """Read the watchdog, if an endpoint file of the firmware is known."""
        endpoints = self._find_endpoints(timeout_s)
        required = {
            AxisSetting.WATCHDOG_ENABLED: 1.0,
            AxisSetting.WATCHDOG_TIMEOUT: self.settings.watchdog_s,
        }
        values: list[ReadBack] = []
        for setting, value in required.items():
            reported = None
            if endpoints is not None:
                reported = self._read_setting(
                    endpoints.ids[setting], SETTING_TYPES[setting], timeout_s
                )
            unit = "s" if setting is AxisSetting.WATCHDOG_TIMEOUT else "1"
            values.append(ReadBack(str(setting), unit, value, reported, WATCHDOG_TOLERANCE_S))
        return values

    def _find_endpoints(self, timeout_s: float) -> EndpointIds | None:
        """Return the endpoint file of the axis' firmware and hardware; None if the settings name none."""
        files = read_all_endpoints(self.settings.endpoints)
        if not files and all(map(is_emulated, self.settings.channels)):
            files = [EMULATED]

        def decode(frame: CanFrame) -> tuple[str, str] | None:
            if split_id(frame) != (self.node_id, MessageId.VERSION) or not frame.data:
                return None
            values = PAYLOADS[MessageId.VERSION].unpack(frame.data)
            return ".".join(map(str, values[4:7])), ".".join(map(str, values[1:4]))

        version = self.request(encode_request(self.node_id, MessageId.VERSION), decode, timeout_s)
        return next((file for file in files if (file.firmware, file.hardware) == version), None)

    def _read_setting(self, endpoint: int, type_name: str, timeout_s: float) -> float | None:
        def decode(frame: CanFrame) -> float | None:
            if split_id(frame) != (self.node_id, MessageId.TX_SDO):
                return None
            answered_endpoint, value = decode_setting_answer(frame.data)
            if answered_endpoint != endpoint:
                return None
            (number,) = VALUE_FORMATS[type_name].unpack(value)
            return float(number)

        return self.request(encode_setting_request(self.node_id, endpoint), decode, timeout_s)
