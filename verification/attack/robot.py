"""The robot that is attacked: a `snakesim run` and an operator on its network."""

import contextlib
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import zenoh

from snakesim_testing.harness.command import RunningCommand
from snakesim_testing.harness.wait import wait_until
from verification.attack.command import HOLD_POSE_FOR_AN_HOUR, start_run
from verification.attack.robot_operator import ROBOT_KEYS, STATE_KEYS, Operator

RECOVERY_TIMEOUT_S = 20.0  # a robot that does not recover in this time is replaced
CONNECT_TIMEOUT_S = 0.5  # of one attempt to connect


@dataclass(frozen=True)
class RunHealth:
    """The processes and logs of a run at one moment."""

    process_ids: dict[str, int]  # by name of the part
    log_sizes: dict[Path, int]  # in bytes, by file


@dataclass(frozen=True)
class AttackedRobot:
    """A run, and an operator who can reset and arm it."""

    run: RunningCommand
    operator: Operator

    @property
    def endpoint(self) -> str:
        """The endpoint of its network."""
        return self.run.endpoint

    def record_health(self) -> RunHealth:
        """Return which processes run now, and how long their logs are."""
        log_sizes = {log: log.stat().st_size for log in self.run.out.glob("*.log")}
        return RunHealth(self.run.parts(), log_sizes)

    def assert_unharmed(self, health_before: RunHealth, attack: str = "") -> None:
        """Fail if a process of the run was replaced, or has logged an exception.

        Args:
            health_before: Health of the run before the attack.
            attack: Description of the attack, for the failure.
        """
        tracebacks: list[str] = []
        for log in sorted(self.run.out.glob("*.log")):
            text = log.read_text(errors="replace")
            new_text = text[health_before.log_sizes.get(log, 0) :]
            if "Traceback" in new_text:
                tracebacks.append(f"{log.stem}: {new_text[-300:]}")
        assert not tracebacks, f"{attack}: {'; '.join(tracebacks)}"
        printed = self.run.printed()[-1000:]
        assert self.run.parts() == health_before.process_ids, f"{attack}: {printed}"

    def assert_stays(self, lifecycle: str, duration_s: float) -> None:
        """Fail unless status and clock show this lifecycle state, and no other, for a time from now on."""
        start_s = time.monotonic()
        time.sleep(duration_s)
        lifecycles = {
            sample.message["lifecycle"]
            for key in STATE_KEYS
            for sample in self.operator.list_samples(key)
            if sample.received_s > start_s
        }
        assert lifecycles == {lifecycle}, f"{lifecycles}: {self.operator.read_reason()}"


def connect_operator(run: RunningCommand) -> Operator:
    """Return an operator on the network of a run, as soon as the network exists."""

    def try_to_connect() -> Operator | bool:
        with contextlib.suppress(zenoh.ZError):
            return Operator(run.endpoint, timeout_s=CONNECT_TIMEOUT_S)
        # Waiting is also over if the run has ended.
        return run.process.poll() is not None

    operator = wait_until(try_to_connect, f"a network at {run.endpoint}")
    assert isinstance(operator, Operator), run.describe_ending()
    operator.subscribe(*ROBOT_KEYS)
    return operator


@contextmanager
def start_armed_robot(
    home: Path, *arguments: str, command_prefix: Sequence[str] = ()
) -> Iterator[AttackedRobot]:
    """Start a run and arm its robot; the context ends the run.

    Args:
        home: Home folder of the run.
        *arguments: Arguments of `snakesim run`; by default a robot that holds its pose for an hour.
        command_prefix: Command line that runs it elsewhere, such as with a limit of open files.
    """
    arguments = arguments or HOLD_POSE_FOR_AN_HOUR
    with (
        start_run(home, *arguments, command_prefix=command_prefix) as run,
        connect_operator(run) as operator,
    ):
        operator.recover_robot()
        yield AttackedRobot(run, operator)


class SharedRobot:
    """One robot for many tests: it recovers after each attack, and is replaced if it does not.

    Starting a run takes seconds, so tests that leave the robot alive share it.
    """

    def __init__(
        self, home: Path, *extra_arguments: str, command_prefix: Sequence[str] = ()
    ) -> None:
        """Describe the robot, which starts when a test needs it.

        Args:
            home: Folder for the home folders of its runs.
            *extra_arguments: Arguments of `snakesim run`, besides those of a robot that holds its pose.
            command_prefix: Command line that runs it elsewhere.
        """
        self._home = home
        self._arguments = (*HOLD_POSE_FOR_AN_HOUR, *extra_arguments)
        self._command_prefix = command_prefix
        self._robot_context = ExitStack()
        self._robot: AttackedRobot | None = None
        self._run_number = 0

    def make_armed(self) -> AttackedRobot:
        """Return the robot, armed and following its controller."""
        if self._robot is not None:
            with contextlib.suppress(AssertionError):
                self._robot.operator.recover_robot(RECOVERY_TIMEOUT_S)
                self._robot.operator.discard_streams()
                return self._robot
        self.close()
        self._robot = self._start_robot()
        return self._robot

    def close(self) -> None:
        """End the run."""
        self._robot = None
        self._robot_context.close()

    def _start_robot(self) -> AttackedRobot:
        """Start another run in a new home folder."""
        self._run_number += 1
        home = self._home / str(self._run_number)
        home.mkdir()
        robot = start_armed_robot(home, *self._arguments, command_prefix=self._command_prefix)
        return self._robot_context.enter_context(robot)
