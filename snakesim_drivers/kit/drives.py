"""The interface that a driver type implements: `Drives`, the drives of one bus.

`Drives` is the base class of every driver type's protocol. This file shows each of its members with its arguments,
their units, when it is called, by which thread, and how long it may take.

Call order
    `bring_up` once. Then in every control cycle `read`, `send_setpoints`, `poll` and `list_findings`. In the end
    `close`, which may also follow a failed `bring_up`. `reset_faults` comes before the `send_setpoints` of the same
    cycle, and `inject` at any time.

Threads
    The host's thread creates the object and calls `bring_up` and `inject`. In real time each bus has a thread of its
    own, which makes all other calls. In lockstep the host's thread makes all calls. No two calls overlap, except that
    `inject` may run while the bus thread is in another method.

Time
    `bring_up` may take `bring_up_limit_s` of the settings, 10 s by default, and `close` 2 s for all buses together. All
    other calls of a cycle together may take one control period times the `decimation` of the bus. `read` should wait
    at most `drive_settings.compute_response_timeout_s` for answers, half of that time. A bus that is slower delays
    neither the host nor other buses: its joint states become older, and after one lease they are invalid.

Start-up
    What takes seconds after `bring_up`, such as homing, goes into `start_up`, as steps with a time limit each. After
    every `read`, the same thread calls the functions of the steps, each of which returns at once. Until a drive has
    finished, it is not among `BusCommand.enabled_drives`, and the robot cannot be armed. In lockstep all steps end
    before the first control cycle.

Errors
    An exception of any call ends the run safely. The bus first switches its drives off, by `send_setpoints` without
    followers, and then closes. A drive that is silent or reports an error is no exception but a `FaultFinding`.

All drives are numbered by their place on this bus, from tail to head. All values are those at the shafts of the drives,
in SI units (rad, rad/s, N·m): `mounting` converts them from and to joint values. What drives measure is stored in the
`DriveReadings` that the driver type gets when the bus is opened. If a value is not finite, the call that stores it is
ignored, with its other values.
"""

from abc import ABC, abstractmethod
from typing import NamedTuple

from snakesim_drivers.kit.findings import FaultFinding
from snakesim_drivers.kit.start_up import StartUp
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.fault_kinds import FaultInjection
from snakesim_hal.wire.messages import JointMode


class BusCommand(NamedTuple):
    """What all drives of a bus are to do until the next command."""

    # Indices of the drives that follow setpoints; all others are switched off.
    enabled_drives: frozenset[int]
    # Of every drive. An enabled drive may get PASSIVE, whatever modes its type has: it stays on, without a torque.
    modes: list[JointMode]
    # (n_drives,) in rad, rad/s or N·m, by the mode of each drive (0 for passive drives).
    targets: Floats
    limits_nm: Floats  # (n_drives,) torque limits, not negative
    may_enable: bool  # True: the robot is armed (False: a drive that is off stays off)
    emergency: bool  # True: drives stop by their own emergency stop, where they have one


class Drives(ABC):
    """The drives of one driver type on one bus. Derive from it, and implement the abstract methods."""

    emulated: bool = False  # whether no real motor moves (set by the constructor)
    # Steps that take seconds, made by the constructor; None: bring-up is enough.
    start_up: StartUp | None = None

    @abstractmethod
    def bring_up(self) -> None:
        """Find every drive, check it, write its settings and store its serial number. No drive is enabled.

        Raises:
            BackendError: A drive is missing or does not suit its joint. Name all such drives in one error, a line each.
        """

    @abstractmethod
    def read(self) -> None:
        """Request motion and torque of every drive, and put the answers into the readings.

        Do not wait for drives that were silent before: the readings of the drives contain whether waiting is useful.
        The drives in `DriveReadings.drives_to_check` may have stopped by themselves. If your drives do not report with
        every answer whether they are on, request this state of these drives. Call `mark_checked` for each drive that
        has reported it.

        Raises:
            BackendError: The bus cannot be used any more.
        """

    @abstractmethod
    def send_setpoints(self, command: BusCommand) -> None:
        """Send setpoints to the enabled drives, and switch off all others.

        A drive that is switched on gets its setpoint first. `drive_states.DriveStates` decides which drives get a
        command to switch on or off. While a drive reports that it is still off, it gets the command to switch on again.
        So a drive that reaches operation over several states can get its next state each time.

        Args:
            command: Setpoints, and which drives are enabled. It replaces the command of the cycle before.

        Raises:
            BackendError: The bus cannot be used any more.
        """

    @abstractmethod
    def reset_faults(self, joints: frozenset[int]) -> None:
        """Clear the errors of these drives, and write the settings that a restart may have lost. Enable none.

        Only the operator's reset of a fault leads to this call.

        Args:
            joints: Indices of the drives on this bus.

        Raises:
            BackendError: The bus cannot be used any more.
        """

    @abstractmethod
    def close(self) -> None:
        """Switch all drives off and close the bus. Allowed in every state.

        Raises:
            BackendError: The bus cannot be closed.
        """

    def list_findings(self) -> list[FaultFinding]:
        """Return what is wrong now with the drives and their bus. The caller reports each finding once.

        Drives that do not answer need not be included: the caller counts the requests that they left unanswered.
        """
        return []

    def poll(self) -> None:
        """Receive what has arrived, without waiting. Drives that are emulated here simulate up to the current time.

        Real drives that only answer requests need nothing here, which is the default.

        Raises:
            BackendError: The bus cannot be used any more.
        """
        return

    def inject(self, injection: FaultInjection, *, begins: bool) -> bool:
        """Start or end an injected fault of the bus, `bus_1`, or of a drive emulated here, `joint_1` for drive 0.

        Args:
            injection: The fault.
            begins: True to start the fault, False to end it.

        Returns:
            True if the fault was started or ended; False, the default, if it cannot be injected here.

        Raises:
            ConfigError: The fault cannot be injected here.
        """
        del injection, begins
        return False
