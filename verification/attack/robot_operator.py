"""The operator of an attacked robot: reads its state, resets and arms it, and measures when it stops."""

import contextlib
import time
from typing import Any

from snakesim_testing.harness.wait import TIMEOUT_S, wait_until
from verification.attack.client import NetworkClient

ROBOT_KEYS = ("hal/status", "hal/clock", "hal/applied", "hal/description")
STATE_KEYS = ("hal/status", "hal/clock")  # their messages contain the lifecycle state
RETRY_PERIOD_S = 0.05
FOLLOW_TIMEOUT_S = 1.5
APPLIED_COMMANDS = 10  # different ones, after which the robot counts as following its controller


class Operator(NetworkClient):
    """A client that operates the robot as its user does."""

    def read_status(self) -> dict[str, Any]:
        """Return the newest message of `hal/status`."""
        return self.read_newest("hal/status")

    def read_reason(self) -> str:
        """Return the reason that the newest status gives for the state of the robot."""
        return self.read_status()["reason"]

    def read_lifecycle(self) -> str:
        """Return the lifecycle state in the newest message of status or clock."""
        newest = [sample for key in STATE_KEYS for sample in self.list_samples(key)[-1:]]
        if not newest:
            return self.read_status()["lifecycle"]
        return max(newest, key=lambda sample: sample.received_s).message["lifecycle"]

    def wait_for_lifecycle(self, lifecycle: str, timeout_s: float = TIMEOUT_S) -> None:
        """Wait until the robot is in a lifecycle state."""
        wait_until(lambda: self.read_lifecycle() == lifecycle, f"the state {lifecycle}", timeout_s)

    def wait_for_stop(self, timeout_s: float = TIMEOUT_S) -> None:
        """Wait until the robot is no longer armed."""
        wait_until(lambda: self.read_lifecycle() != "armed", "a stop", timeout_s)

    def request_emergency_stop(self, timeout_s: float = 3.0) -> list[Any]:
        """Request an emergency stop over the network, and return all answers."""
        return self.query("hal/estop", {"requester": "operator"}, timeout_s)

    def recover_robot(self, timeout_s: float = TIMEOUT_S) -> None:
        """Reset and arm the robot until it follows its controller, whatever state it is in.

        Raises:
            AssertionError: The robot was not armed in time.
        """
        self.subscribe(*ROBOT_KEYS)
        # Without this check, the loop below waits up to 0.2 s for the next status of an armed robot.
        if self.read_lifecycle() == "armed" and self.is_following_controller():
            return
        deadline_s = time.monotonic() + timeout_s
        last_answer: Any = None
        while time.monotonic() < deadline_s:
            status = self.wait_for_next("hal/status", timeout_s)
            lifecycle = status["lifecycle"]
            if lifecycle == "armed":
                if self.is_following_controller():
                    return
            elif lifecycle in ("fault", "estop"):
                last_answer = self.request_lifecycle("reset")
            elif status["ready_to_arm"]:
                last_answer = self.request_lifecycle("arm")
            time.sleep(RETRY_PERIOD_S)
        raise AssertionError(
            f"not armed within {timeout_s:g} s: {self.read_reason()}; last answer: {last_answer}"
        )

    def disarm_robot(self, timeout_s: float = TIMEOUT_S) -> None:
        """Bring the robot into the state `disarmed`, ready to arm. A busy machine may have stopped it before.

        Raises:
            AssertionError: The robot was not ready to arm in time.
        """
        deadline_s = time.monotonic() + timeout_s
        while time.monotonic() < deadline_s:
            status = self.wait_for_next("hal/status", timeout_s)
            match status["lifecycle"]:
                case "disarmed":
                    if status["ready_to_arm"]:
                        return
                case "armed":
                    self.request_lifecycle("disarm")
                case _:
                    self.request_lifecycle("reset")
        raise AssertionError(f"not ready to arm within {timeout_s:g} s: {self.read_reason()}")

    def is_following_controller(self) -> bool:
        """Return whether the armed robot applies new commands of its controller, one after the other."""
        start_s = time.monotonic()

        def are_commands_applied() -> bool:
            sequences = {
                sample.message["sequence"]
                for sample in self.list_samples("hal/applied")
                if sample.received_s > start_s
            }
            return len(sequences - {None}) >= APPLIED_COMMANDS

        with contextlib.suppress(AssertionError):
            wait_until(are_commands_applied, "applied commands", FOLLOW_TIMEOUT_S)
            return self.read_lifecycle() == "armed"
        return False

    def wait_for_emergency_stop(self, since_s: float, timeout_s: float) -> float:
        """Wait until status or clock shows an emergency stop.

        Args:
            since_s: Monotonic time before which messages do not count.
            timeout_s: Time in s after which this fails.

        Returns:
            Monotonic time of the first message that shows it.
        """

        def list_stop_times() -> list[float]:
            return [
                sample.received_s
                for key in STATE_KEYS
                for sample in self.list_samples(key)
                if sample.received_s >= since_s and sample.message["lifecycle"] == "estop"
            ]

        return min(wait_until(list_stop_times, "an emergency stop", timeout_s))


class HostTickTimes:
    """Computes when the host began a tick, by the monotonic clock of this process.

    The network may delay samples. So the times are computed from the number of a tick and the least delayed sample.
    """

    def __init__(self, operator: Operator) -> None:
        operator.wait_for_next("hal/clock")
        self._period_s = operator.read_newest("hal/clock")["period_ns"] * 1e-9
        self._first_tick_s = self._estimate_first_tick(operator)

    def time_of_tick(self, tick: int) -> float:
        """Return the monotonic time in s of a tick."""
        return self._first_tick_s + tick * self._period_s

    def measure_lost_time(self, operator: Operator) -> float:
        """Return how much later the ticks come than at the beginning, in s: the host did not run for this time."""
        operator.discard_streams()
        wait_until(lambda: len(operator.list_samples("hal/clock")) >= 10, "ten ticks")
        return self._estimate_first_tick(operator) - self._first_tick_s

    def _estimate_first_tick(self, operator: Operator) -> float:
        """Return the monotonic time in s of tick 0, if the host had kept its rate since then."""
        return min(
            sample.received_s - sample.message["tick"] * self._period_s
            for sample in operator.list_samples("hal/clock")
        )
