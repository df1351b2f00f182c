"""A simulated robot whose controller drives it while an environment adds corrections to the position targets.

This is what the action `residual:CONTROLLER` of an environment uses: residual reinforcement learning. Host, simulation,
guidance, navigation and control run in this process, one tick for each step.
"""

import contextlib
import io
from collections.abc import Mapping
from typing import Any

import msgspec

from snakesim_gnc.control.service.control_service import SENSOR_MESSAGE_TYPES
from snakesim_hal.base.errors import BackendError, ControllerError, SnakesimError
from snakesim_hal.controller import Controller, ControllerCommand, Observation, load_controller
from snakesim_hal.model.fault_kinds import CONTROL
from snakesim_hal.model.plugins import CONTROLLERS, register_plugin_temporarily
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.programs.single_process import InProcessRun
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    AppliedCommand,
    JointMode,
    JointState,
    LifecycleState,
    Message,
    RobotDescription,
)
from snakesim_hal.wire.setpoints import RequestedSetpoints

EXTRA_DURATION_S = 1.0  # the run lasts longer than the episode, which must not end with it
RUN_ENDED = object()


class AssistedRobot:
    """A simulated robot, armed, with guidance, navigation and control of its scenario.

    The control service runs a subclass of the scenario's controller, which adds the corrections of `step` to the
    position targets of that controller.
    """

    def __init__(self, config: RunConfig) -> None:
        """Start the run, and run ticks without corrections until the robot is armed.

        This may block for seconds. If it fails, everything is closed again.

        Args:
            config: Configuration of the run. Actions correct the targets of the controller in it.

        Raises:
            SnakesimError: The run cannot begin, or the robot is not ready to arm in time.
        """
        # The controller reads it in every tick.
        self._correction_rad: list[float] = [0.0] * config.robot.chain.modules
        # The part after the colon is the configuration section, which both controllers share.
        corrected_name = f"residual:{config.controller.rpartition(':')[2]}"
        corrected_class = _make_correcting_class(
            load_controller(config.controller), self._correction_rad
        )
        run_config = msgspec.structs.replace(
            config, controller=corrected_name, duration_s=config.duration_s + EXTRA_DURATION_S
        )

        # Not shown: the reason of a failure is in `failed` of the run.
        self._service_output = io.StringIO()
        with (
            register_plugin_temporarily(CONTROLLERS, corrected_name, corrected_class),
            contextlib.ExitStack() as opening,
        ):
            self._run = opening.enter_context(InProcessRun(run_config))
            self._open_readers(opening)
            self._tick_iterator = self._run.iterate_ticks(before_services=True)
            opening.callback(self._tick_iterator.close)
            self.description: RobotDescription = self._run.host.description
            self._joint_index_by_name = {
                joint.name: i for i, joint in enumerate(self.description.joints)
            }
            # The newest sample of every sensor besides the joints, by key.
            self.newest_samples: dict[str, Message] = {}
            # Joint index -> which limit changed its target in the last tick.
            self.limit_by_joint: dict[int, str] = {}
            self._step_until_armed()
            self._exit_stack = opening.pop_all()  # from now on `close` closes everything

    def _open_readers(self, opening: contextlib.ExitStack) -> None:
        """Open the readers of joint states, applied commands and sensor samples. The stack closes their session."""
        session = self._run.network.create_session()
        opening.callback(session.close)
        self._joint_reader = session.declare_reader(keys.JOINTS, JointState)
        self._applied_reader = session.declare_reader(keys.APPLIED, AppliedCommand)
        self._sensor_readers = {
            key: session.declare_reader(key, message)
            for key, message in SENSOR_MESSAGE_TYPES.items()
        }

    @property
    def lifecycle(self) -> LifecycleState:
        """The lifecycle state, as the host publishes it."""
        return self._run.host.authority.state

    @property
    def reason(self) -> str:
        """Why the robot is in this state."""
        return self._run.host.authority.reason

    @property
    def digest(self) -> str:
        """The digest of all setpoints, as the `command_digest` of a run."""
        return self._run.host.black_box.command_digest

    def step(self, mode: JointMode, target: list[float]) -> None:
        """Run one tick. Joints that the controller commands in position mode get its target plus a correction.

        Args:
            mode: Not used, because corrections are always added to positions.
            target: A correction in rad for each joint, tail to head.

        Raises:
            BackendError: The run has ended.
            ControllerError: The controller has failed.
        """
        self._correction_rad[:] = target
        self._run_tick()
        applied = self._applied_reader.pop_newest(lambda _: True)
        if applied is None:
            self.limit_by_joint = {}
        else:
            self.limit_by_joint = {
                self._joint_index_by_name[name]: reason for name, reason in applied.limited.items()
            }

    def close(self) -> None:
        """End the run."""
        self._exit_stack.close()

    def _step_until_armed(self) -> None:
        """Run one tick or more, until the robot is armed for the first time. Raises SnakesimError."""
        self._run_tick()
        while self._run.host.authority.arm_session == 0:
            self._run_tick()

    def _run_tick(self) -> None:
        """Run one tick and read its samples.

        Raises:
            ControllerError: A service of the run has failed.
            BackendError: The run has ended although the robot is armed.
        """
        with contextlib.redirect_stderr(self._service_output):
            is_over = next(self._tick_iterator, RUN_ENDED) is RUN_ENDED
        if self._run.failed_services:
            errors = self._run.pop_errors()
            try:
                raise ControllerError("; ".join(self._run.failed_services)) from _find_cause(errors)
            finally:
                del errors  # it refers to a traceback with this frame, and would be part of a reference cycle
        if is_over and self.lifecycle == "armed":
            raise BackendError(
                f"the run ended early: {self._run.host.ending_reason or self._run.host.ending_status}"
            )
        joints = self._joint_reader.pop_newest(lambda _: True)
        if joints is not None:
            self.joints = joints
        for key, reader in self._sensor_readers.items():
            message = reader.pop_newest(lambda _: True)
            if message is not None:
                self.newest_samples[key] = message


def _find_cause(errors: Mapping[str, SnakesimError]) -> BaseException | None:
    """Return the exception that the controller has raised, or None if control did not end by such an exception."""
    error = errors.get(CONTROL)
    return None if error is None else error.__cause__


def _make_correcting_class(
    controller_class: type[Controller[Any]], corrections_rad: list[float]
) -> type[Controller[Any]]:
    """Return a controller class that adds corrections to the position targets of another controller.

    Args:
        controller_class: Class of the other controller.
        corrections_rad: A correction in rad for each joint, tail to head. The list is read in every tick, so the caller
            changes it in place.
    """

    # A subclass, so that the class attributes, the parameters and the check of the other controller are inherited.
    class CorrectedController(controller_class):
        def update(self, observation: Observation) -> ControllerCommand:
            command = super().update(observation)  # pyright: ignore[reportAbstractUsage] - not abstract here
            setpoints = command.setpoints
            target = list(setpoints.target)
            for i, correction_rad in enumerate(corrections_rad):
                # A correction of 0 is not added, so that the target stays the same to the bit.
                if correction_rad and setpoints.mode[i] is JointMode.POSITION:
                    target[i] = setpoints.target[i] + correction_rad
            corrected_setpoints = RequestedSetpoints(
                setpoints.mode, target, setpoints.torque_limit_nm
            )
            return ControllerCommand(corrected_setpoints, command.telemetry)

    return CorrectedController
