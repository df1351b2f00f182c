"""The interface that a driver type implements: `Drives`, the drives of one bus.

Call order: `bring_up` once; then, in every control cycle, `read`, `command`, `poll` and `findings`; in the end `close`,
which may also follow a failed `bring_up`. `reset_faults` comes before the `command` of the same cycle, and `inject` at
any time.

Threads: the host's thread creates the object and calls `bring_up` and `inject`. In real time each bus of `Buses` has
a thread of its own, which makes all other calls. In lockstep the host's thread makes all calls. No two calls overlap,
except that `inject` may run while the bus thread is in another method.

All joint numbers are indices on this bus, from tail to head. All physical values are those at the shafts of the
drives, in SI units (rad, rad/s, N·m): `mounting` converts them from and to joint values. What drives measure goes into
the `DriveReadings` that the driver type gets when the bus is opened.
"""

from typing import Protocol

from snakesim_drivers.kit.findings import Finding
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.fault_kinds import Injection
from snakesim_hal.wire.messages import Mode


class Drives(Protocol):
    """The drives of one driver type on one bus.

    Every method except `bring_up` and `close` returns within a control cycle.
    """

    emulated: bool  # True: no real motor moves

    def bring_up(self) -> None:
        """Find every drive, check it and write its settings. No drive is enabled. May take seconds.

        Raises:
            BackendError: a drive is missing or does not suit its joint.
        """
        ...

    def read(self) -> None:
        """Request the state of every drive, and put the answers into the readings.

        The method does not wait for drives that have been silent before.
        """
        ...

    def command(
        self,
        following: frozenset[int],
        modes: list[Mode],
        targets: Floats,
        limits_nm: Floats,
        *,
        may_enable: bool,
        emergency: bool,
    ) -> None:
        """Send setpoints to the drives that follow, and switch off all others.

        A drive that begins to follow is enabled after it has received its setpoint. A drive that should be off but
        reports that it is on is switched off again.

        Args:
            following: The drives that get setpoints.
            modes: The mode of every drive.
            targets: (n_drives,) in rad, rad/s or N·m, by the mode of each drive; 0 for passive drives.
            limits_nm: (n_drives,) torque limits.
            may_enable: True if the robot is armed. Otherwise a drive that is off stays off.
            emergency: True if drives stop by their own emergency stop, where they have one.
        """
        ...

    def reset_faults(self, joints: frozenset[int]) -> None:
        """Clear the errors of these drives, and write the settings that a restart may have lost.

        Only the operator's reset of a fault leads to this call.
        """
        ...

    def findings(self) -> list[Finding]:
        """Return what is wrong now with the drives and their bus. Silent drives need not be included."""
        ...

    def poll(self) -> None:
        """Receive what has arrived. Drives that are emulated in this process simulate up to the present time."""
        ...

    def inject(self, injection: Injection, *, begins: bool) -> bool:
        """Begin or end an injected fault of the bus or of a drive emulated here.

        Returns:
            False if the fault concerns neither of them.

        Raises:
            ConfigError: the fault cannot be injected here.
        """
        ...

    def close(self) -> None:
        """Switch all drives off and close the bus. Allowed in every state."""
        ...
