"""A second program on a serial port, which reads one servo: for any protocol of this package.

The bus is half duplex. So the probe sends only while the host is frozen or has ended, and opens the port without
locking it, before the host does.
"""

from collections.abc import Mapping
from typing import Any, ClassVar, Generic, TypeVar

from snakesim_drivers.kit.drive_probe import DriveProbe, ReadBack
from snakesim_hal.model.scenario import RunConfig
from snakesim_serial_backend.request_port import RequestPort
from snakesim_serial_backend.wire import SerialWire

RESPONSE_GAP_S = 0.02  # silence that ends an answer
PortT = TypeVar("PortT", bound=RequestPort[Any])


class ServoProbe(DriveProbe, Generic[PortT]):
    """Reads registers of the first servo of a robot."""

    has_own_line = False
    # By name: address and value of one byte.
    required_registers: ClassVar[Mapping[str, tuple[int, int]]]

    def __init__(self, config: RunConfig, settings: Any, port_class: type[PortT]) -> None:
        """Open the port.

        Args:
            config: Configuration of the run.
            settings: Settings of the driver type.
            port_class: The protocol.
        """
        self.joint = config.robot.joint_table[0]
        self._wire = SerialWire(settings.ports[0], settings.baud, exclusive=False)
        self._port = port_class(self._wire, RESPONSE_GAP_S)

    def read_configuration(self, timeout_s: float) -> list[ReadBack]:
        """Read the registers that the driver has written or checked."""
        del timeout_s  # the port has its own
        values: list[ReadBack] = []
        for name, (address, required) in self.required_registers.items():
            data = self.read_registers(address, 1)
            values.append(ReadBack(name, "1", required, None if data is None else float(data[0])))
        return values

    def read_registers(self, address: int, size: int) -> bytes | None:
        """Return registers of the servo; None without an answer."""
        status = self._port.read(self.joint.id, address, size)
        return None if status is None else status.data

    def close(self) -> None:
        """Close the port."""
        self._wire.close()
