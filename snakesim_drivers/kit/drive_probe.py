"""A second program on the bus of a drive: it reads the drive's own status and configuration, and writes nothing.

A measurement of what a drive does while its host is frozen or dead needs such a program, because the host cannot report
it.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True)
class DriveStatus:
    """What a drive reports about itself."""

    is_enabled: bool  # it would follow a setpoint
    text: str  # as the drive reports it, such as "mode 11"


@dataclass(frozen=True)
class ReadBack:
    """A value of a drive's configuration that the driver needs, and the value that the drive reports."""

    name: str  # of the value, as in the drive's manual
    unit: str  # "1": it has no unit
    required: float  # value that the driver needs
    reported: float | None  # None: the drive does not answer the request
    tolerance: float = 0.0  # largest allowed difference


class DriveProbe(ABC):
    """Reads one drive as a second program. A driver type returns one from `open_probe`.

    One thread makes all calls. No call sends anything but requests to read.
    """

    has_own_line: ClassVar[bool] = True
    """False: the bus is half duplex, so that the probe may only read while the host is frozen or has ended."""

    @abstractmethod
    def read_status(self, timeout_s: float) -> DriveStatus | None:
        """Request the drive's state, and return its answer.

        Args:
            timeout_s: Maximum wait for the answer.

        Returns:
            The state; None without an answer.
        """

    @abstractmethod
    def read_configuration(self, timeout_s: float) -> list[ReadBack]:
        """Read the settings that the driver has written or has checked at its start.

        Args:
            timeout_s: Maximum wait for each answer.
        """

    @abstractmethod
    def close(self) -> None:
        """Leave the bus."""
