"""Which settings of an axis the driver reads, and where: ids of RxSdo and TxSdo differ with firmware and hardware.

ODrive publishes the ids with each firmware, in a file `flat_endpoints.json`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from struct import Struct

import msgspec

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.textfiles import read_text


class AxisSetting(StrEnum):
    """Settings of an axis, by their paths in `odrivetool`."""

    WATCHDOG_ENABLED = "axis0.config.enable_watchdog"
    WATCHDOG_TIMEOUT = "axis0.config.watchdog_timeout"  # s
    CURRENT = "axis0.config.motor.current_soft_max"  # A
    SPEED = "axis0.controller.config.vel_limit"  # turns/s


SETTING_TYPES = {
    AxisSetting.WATCHDOG_ENABLED: "bool",
    AxisSetting.WATCHDOG_TIMEOUT: "float",
    AxisSetting.CURRENT: "float",
    AxisSetting.SPEED: "float",
}
VALUE_FORMATS = {"bool": Struct("<?"), "float": Struct("<f")}


@dataclass(frozen=True)
class EndpointIds:
    """Endpoint ids of one firmware on one hardware."""

    firmware: str  # such as 0.6.11
    hardware: str  # such as 4.4.58
    ids: Mapping[AxisSetting, int]

    def find_setting(self, endpoint: int) -> AxisSetting | None:
        """Return the setting with this endpoint id; None if no setting of the driver has it."""
        return next((setting for setting, number in self.ids.items() if number == endpoint), None)


# Of emulated axes. The numbers are their own: no firmware of ODrive has them.
EMULATED = EndpointIds(
    "0.6.11", "4.4.58", {setting: 200 + i for i, setting in enumerate(AxisSetting)}
)


class _EndpointEntry(msgspec.Struct):
    type: str
    id: int = -1


class _EndpointFile(msgspec.Struct):
    fw_version: str
    hw_version: str
    endpoints: dict[str, _EndpointEntry]


def read_all_endpoints(paths: Sequence[str]) -> list[EndpointIds]:
    """Read all endpoint files that the scenario names.

    Raises:
        ConfigError: A file cannot be read, or a setting is missing in it.
    """
    return [read_endpoints(path) for path in paths]


def read_endpoints(path: str) -> EndpointIds:
    """Read from a `flat_endpoints.json` of ODrive the ids of the settings that this driver uses.

    Args:
        path: Path of the file.

    Returns:
        The ids, with the firmware and the hardware that the file is for.

    Raises:
        ConfigError: The file cannot be read, or a setting is missing in it or has another type.
    """
    context = "`backends.odrive.endpoints`"
    suggestion = "take the flat_endpoints.json that ODrive publishes with the axes' firmware"
    try:
        file = msgspec.json.decode(read_text(Path(path)), type=_EndpointFile)
    except ConfigError as error:
        raise ConfigError(f"{context}: {error}; {suggestion}", code="file/not-readable") from None
    except (msgspec.DecodeError, RecursionError) as error:
        raise ConfigError(
            f"{context}: {path}: {error}; {suggestion}", code="file/not-readable"
        ) from None
    ids: dict[AxisSetting, int] = {}
    for setting in AxisSetting:
        endpoint = file.endpoints.get(setting)
        if endpoint is None or not 0 <= endpoint.id <= 0xFFFF:
            raise ConfigError(
                f"{context}: {path} has no endpoint {setting} with an id of 0 to 65535; {suggestion}",
                code="file/not-readable",
            )
        if endpoint.type != SETTING_TYPES[setting]:
            raise ConfigError(
                f"{context}: {path}: {setting} has the type {endpoint.type!r}, and this driver needs "
                f"{SETTING_TYPES[setting]!r}; {suggestion}",
                code="file/not-readable",
            )
        ids[setting] = endpoint.id
    # A release may have a suffix, which axes do not report.
    firmware = file.fw_version.partition("-")[0]
    return EndpointIds(firmware, file.hw_version, ids)
