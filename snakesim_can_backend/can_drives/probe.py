"""A second program on a CAN bus, which reads one drive: the base class for all driver types on CAN."""

from collections.abc import Callable
from typing import Any, TypeVar

from snakesim_can_backend.bus.adapter import open_wire
from snakesim_can_backend.bus.request import request_response
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_drivers.kit.drive_probe import DriveProbe
from snakesim_hal.model.scenario import RunConfig

ResponseT = TypeVar("ResponseT")


class CanDriveProbe(DriveProbe):
    """Reads the drive of the first joint of a robot."""

    def __init__(self, config: RunConfig, settings: Any) -> None:
        """Open the bus of the drive.

        Args:
            config: Configuration of the run.
            settings: Settings of the driver type.

        Raises:
            ConfigError: There is no such channel.
            BackendError: The bus cannot be opened.
        """
        self.joint = config.robot.joint_table[0]
        self.node_id = self.joint.id
        self.settings = settings
        self.period_s = config.period_ns * 1e-9
        self._wire = open_wire(settings.channels[0], None, settings.bit_rate, settings.fd_rate)

    def request(
        self,
        request: CanFrame | None,
        decode: Callable[[CanFrame], ResponseT | None],
        timeout_s: float,
    ) -> ResponseT | None:
        """Send a request, and return the first answer to it; None without an answer in time.

        Args:
            request: Frame to send; None to wait for what the drive sends by itself.
            decode: Function that returns the content of an answer, and None for any other frame.
            timeout_s: Maximum wait.
        """
        return request_response(self._wire, request, decode, timeout_s)

    def close(self) -> None:
        """Leave the bus."""
        self._wire.close()
