"""The start-up of drives that takes seconds: steps with a time limit each, between bring-up and arming.

A driver type makes a `StartUp` in its constructor, as `Drives.start_up`, and lists the steps of a drive in order:

    self.start_up = StartUp(labels, readings, clock_ns, steps=[
        StartUpStep("configuring", timeout_s=1.0, start=self.write_profile, is_done=self.has_acknowledged),
        StartUpStep("homing", timeout_s=10.0, start=self.start_homing, is_done=self.is_homed, abort=self.stop_homing,
                    moves_joint=True),
    ], may_move=settings.home_at_start)

The kit then calls `update` after every `read`. All drives go through their steps at the same time. Until a drive has
finished, the robot cannot be armed, and `snakesim status` and the console name the step: "joint_3 (node 4 on can0):
homing, 2.1 of 10 s". A step that fails or takes too long is aborted, and is tried again after the operator's reset.

Pure: the clock is passed in.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from snakesim_drivers.kit.findings import FaultFinding
from snakesim_drivers.kit.readings import DriveReadings


class StepFailedError(Exception):
    """Raised by `StartUpStep.is_done` if a drive reports that the step has failed. The text is the reason."""


def do_nothing(_i: int) -> None:
    """Send nothing."""


@dataclass(frozen=True)
class StartUpStep:
    """One step of a drive's start-up. All functions get the index of the drive, and return at once."""

    name: str  # as an operator reads it, such as "homing"
    timeout_s: float  # time after which the step has failed
    start: Callable[[int], None]  # sends what starts the step
    # Whether the drive has acknowledged it; called in every cycle of the bus.
    is_done: Callable[[int], bool]
    # Sends what ends the step, after a failure or an emergency stop.
    abort: Callable[[int], None] = do_nothing
    moves_joint: bool = False  # True: the drive moves its joint by itself, as in homing


@dataclass
class _StartUpProgress:
    """How far one drive is."""

    # Index of the current step; equal to the number of steps if the start-up is finished.
    step: int = 0
    start_time_ns: int | None = None  # when the current step was started; None: not yet
    failure: str = ""  # why the start-up ended early; empty: it did not
    is_fault: bool = False  # False: the operator ended it, by an emergency stop


class StartUp:
    """The start-up of all drives on one bus, by their indices on it."""

    def __init__(
        self,
        labels: Sequence[str],
        readings: DriveReadings,
        clock_ns: Callable[[], int],
        *,
        steps: Sequence[StartUpStep],
        may_move: bool = True,
    ) -> None:
        """Create the start-up of drives, none of which is ready; `update` starts the steps.

        Args:
            labels: Names of the drives for messages, such as "joint_3 (node 4 on can0)".
            readings: Readings of these drives, in which the reason is stored why a drive is not ready.
            clock_ns: Function that returns the driver's time in ns.
            steps: Steps that each drive has to finish, in order.
            may_move: Whether steps that move a joint may start. An operator allows it in the scenario.
        """
        self._labels = labels
        self._readings = readings
        self._clock_ns = clock_ns
        self._steps = steps
        self._may_move = may_move
        self._progress = [_StartUpProgress() for _ in labels]
        self._publish_not_ready_reasons()

    def update(self) -> None:
        """Start the steps that are due, and finish those that the drives have acknowledged."""
        for i, progress in enumerate(self._progress):
            if not progress.failure:
                self._update_drive(i, progress)
        self._publish_not_ready_reasons()

    def is_ready(self, i: int) -> bool:
        """Return whether a drive has finished its start-up."""
        progress = self._progress[i]
        return progress.step == len(self._steps) and not progress.failure

    def can_continue(self) -> bool:
        """Return whether a drive is still at a step that neither has failed nor waits for the operator."""
        for progress in self._progress:
            is_finished = progress.step == len(self._steps)
            if not is_finished and not progress.failure and not self._is_motion_forbidden(progress):
                return True
        return False

    def invalidate(self, i: int, reason: str) -> None:
        """Note that a drive has lost what its start-up has established, for example by a restart.

        This is a fault. The start-up begins again after the operator's reset.

        Args:
            i: Index of the drive.
            reason: Cause for the operator, such as "position unknown after a restart".
        """
        progress = self._progress[i]
        if not progress.failure:
            self._abort_start_up(i, progress, reason)
        self._publish_not_ready_reasons()

    def abort(self, reason: str) -> None:
        """Abort all steps that are in progress, for example after an emergency stop; a reset starts them again.

        Args:
            reason: Cause for the operator.
        """
        for i, progress in enumerate(self._progress):
            if progress.start_time_ns is not None:
                step_name = self._steps[progress.step].name
                self._abort_start_up(i, progress, f"{step_name} was aborted: {reason}")
                progress.is_fault = False
        self._publish_not_ready_reasons()

    def reset(self, drives: frozenset[int]) -> None:
        """Restart the start-up of those of these drives whose start-up has failed, after the operator's reset."""
        for i in drives:
            if self._progress[i].failure:
                self._progress[i] = _StartUpProgress()
        self._publish_not_ready_reasons()

    def list_findings(self) -> list[FaultFinding]:
        """Return a finding for each drive whose start-up has failed or was invalidated."""
        findings: list[FaultFinding] = []
        for i, progress in enumerate(self._progress):
            if progress.is_fault:
                findings.append(
                    FaultFinding(
                        "drive_not_ready",
                        f"{self._labels[i]}: {progress.failure}",
                        i,
                        affects_only_joint=True,
                    )
                )
        return findings

    # --- inside -----------------------------------------------------------------------------------------------

    def _update_drive(self, i: int, progress: _StartUpProgress) -> None:
        """Start the current step of a drive, or the next one if the drive has acknowledged the current one.

        A step that fails or exceeds its time limit is aborted, and ends the start-up of the drive.

        Args:
            i: Index of the drive.
            progress: Progress of the drive, which is updated.
        """
        while progress.step < len(self._steps) and not self._is_motion_forbidden(progress):
            step = self._steps[progress.step]
            if progress.start_time_ns is None:
                progress.start_time_ns = self._clock_ns()
                step.start(i)
                return  # the drive responds in a later cycle
            try:
                is_done = step.is_done(i)
            except StepFailedError as error:
                self._abort_start_up(i, progress, f"{step.name} failed: {error}")
                return
            if not is_done:
                if self._elapsed_s(progress) > step.timeout_s:
                    self._abort_start_up(
                        i, progress, f"{step.name} did not end within {step.timeout_s:g} s"
                    )
                return
            progress.step += 1
            progress.start_time_ns = None

    def _abort_start_up(self, i: int, progress: _StartUpProgress, failure: str) -> None:
        """Abort the current step, and end the start-up of a drive with a failure."""
        if progress.start_time_ns is not None:
            self._steps[progress.step].abort(i)
            progress.start_time_ns = None
        progress.failure = failure
        progress.is_fault = True

    def _is_motion_forbidden(self, progress: _StartUpProgress) -> bool:
        if progress.step == len(self._steps):
            return False
        return self._steps[progress.step].moves_joint and not self._may_move

    def _elapsed_s(self, progress: _StartUpProgress) -> float:
        start_time_ns = progress.start_time_ns
        return 0.0 if start_time_ns is None else (self._clock_ns() - start_time_ns) * 1e-9

    def _publish_not_ready_reasons(self) -> None:
        """Store in the readings why each drive is not ready."""
        for i, progress in enumerate(self._progress):
            reason = self._describe_not_ready_reason(progress)
            self._readings.set_not_ready(i, f"{self._labels[i]}: {reason}" if reason else "")

    def _describe_not_ready_reason(self, progress: _StartUpProgress) -> str:
        """Return the step and the reason why a drive is not ready; empty if it is."""
        if progress.failure:
            return f"{progress.failure}; `snakesim robot reset` begins its start-up again"
        if progress.step == len(self._steps):
            return ""
        step = self._steps[progress.step]
        if self._is_motion_forbidden(progress):
            return f"{step.name} moves the joint, and the settings of its driver do not allow that at the start"
        return f"{step.name}, {self._elapsed_s(progress):.1f} of {step.timeout_s:g} s"
