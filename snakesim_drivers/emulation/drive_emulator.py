"""The base class of emulated drives of any type, and a loop that runs them as a process."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Generic, Protocol, TypeVar

from snakesim_drivers.emulation.emulated_body import EmulatedBody
from snakesim_drivers.emulation.emulator_control import TrueState
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.process import (
    SERVICE_PRIORITY,
    call_on_stop_signals,
    drop_priority_after,
    set_realtime_priority,
    tune_garbage_collector,
)
from snakesim_hal.base.terminal import print_line
from snakesim_hal.model.fault_kinds import FaultInjection

MAX_WAIT_S = 0.001  # longest wait for frames or bytes, of drives in a process of their own
# Computing without a pause, after which emulated drives give up their real-time priority.
MAX_REALTIME_BUSY_S = 0.2


def serve_until_stopped(
    ready_text: str,
    run_cycle: Callable[[], object],
    wait: Callable[[float], object],
    run_control: Callable[[], object] = lambda: None,
) -> None:
    """Run emulated drives until this process gets a stop signal.

    The process gets real-time priority if the system allows it, because real drives answer however busy the computer
    is.

    Args:
        ready_text: Line that is printed when the drives are ready.
        run_cycle: Function that handles what has arrived, and simulates up to the current time.
        wait: Function that waits until frames or bytes arrive; its argument is the maximum wait in s.
        run_control: Function that is called in each cycle, for typed faults and a log.
    """
    # A list, because a signal handler may change it at any instruction without a lock.
    is_running = [True]
    call_on_stop_signals(is_running.clear)
    tune_garbage_collector()
    if set_realtime_priority(SERVICE_PRIORITY) is None:
        drop_priority_after(MAX_REALTIME_BUSY_S)
    print_line(ready_text)
    while is_running:
        run_cycle()
        run_control()
        wait(MAX_WAIT_S)


class BusEnd(Protocol):
    """The drives' end of a bus."""

    def close(self) -> None:
        """Close it."""
        ...

    def inject(self, kind: str, *, begins: bool) -> None:
        """Start or end a fault of the bus at this end, such as "cut"."""
        ...


BusEndT = TypeVar("BusEndT", bound=BusEnd)


class DriveEmulator(ABC, Generic[BusEndT]):
    """Emulated drives of one type on their body. In all methods `i` is the index of a drive, from tail to head.

    A driver type implements the abstract methods. The thread that calls the emulator calls them while it holds the
    lock of the body.
    """

    def __init__(
        self, body: EmulatedBody, bus_ends: Sequence[BusEndT], clock_ns: Callable[[], int]
    ) -> None:
        """Start to simulate at the current time of the clock.

        Args:
            body: Body that these drives move.
            bus_ends: The drives' end of the bus of every drive. Drives of one bus have the same object. `close` closes
                them.
            clock_ns: Function that returns a steady time in ns, with any origin.
        """
        self.body = body
        self._clock_ns = clock_ns
        self._start_ns = clock_ns()
        self._bus_ends: list[BusEndT] = list(
            {id(bus_end): bus_end for bus_end in bus_ends}.values()
        )  # each once
        body.add_step_callback(self.on_step)

    @abstractmethod
    def restart(self, i: int) -> None:
        """Put a drive into its state after power-on."""

    @abstractmethod
    def on_step(self, now_us: float) -> None:
        """Update the drives after a physics step: watchdogs, over-temperature, and reports that are due."""

    def list_enabled(self) -> list[bool]:
        """Return for each drive whether it would follow a setpoint now, for the contract suite and the drive log."""
        raise NotImplementedError(f"{type(self).__name__}.list_enabled")

    def read_true_state(self) -> TrueState:
        """Return what the drives really do now."""
        return TrueState(
            self.list_enabled(),
            [self.body.read_joint_angle_rad(i) for i in range(len(self.body.joints))],
        )

    def inject_typed(self, injection: FaultInjection, begins: bool) -> None:
        """Start or end a fault that was typed: of a drive, or of a bus at the drives' end.

        Args:
            injection: The fault, with its joint or bus.
            begins: Whether the fault starts; otherwise it ends.

        Raises:
            ConfigError: There is no such fault, joint or bus.
        """
        if injection.target_type != "bus":
            self.inject(injection, begins=begins)
            return
        if injection.target_index >= len(self._bus_ends):
            raise ConfigError(
                f"there is no {injection.target}; these drives are on bus_1 to bus_{len(self._bus_ends)}",
                code="injection/unknown-target",
            )
        self._bus_ends[injection.target_index].inject(injection.kind, begins=begins)

    def catch_up(self) -> None:
        """Simulate the time in which this process was paused, before any frame that has arrived since is handled.

        Real drives do not pause with the computer: their watchdogs expire.
        """
        clock_us = self._read_clock_us()
        if self.body.is_late(clock_us):
            self.body.advance_to(clock_us)

    def simulate_to_now(self) -> None:
        """Simulate up to the current time."""
        self.body.advance_to(self._read_clock_us())

    def inject(self, injection: FaultInjection, *, begins: bool) -> None:
        """Start or end an injected fault of a drive.

        Args:
            injection: The fault.
            begins: True to start the fault, False to end it.

        Raises:
            ConfigError: There is no such fault, or no such joint.
        """
        with self.body.lock:
            restarted_drive = self.body.inject(injection, begins=begins)
            if restarted_drive is not None:
                self.restart(restarted_drive)

    def close(self) -> None:
        """Leave the body and close the buses."""
        self.body.remove_step_callback(self.on_step)
        for bus_end in self._bus_ends:
            bus_end.close()

    def _read_clock_us(self) -> float:
        """Return the time since these drives began."""
        return (self._clock_ns() - self._start_ns) / 1000
