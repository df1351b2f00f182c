"""A simulated robot whose controller drives it while an environment adds corrections to the position targets.

This is what the action `residual:CONTROLLER` of an environment uses: residual reinforcement learning. Host, simulation,
guidance, navigation and control run in this process, one tick for each step.
"""

import contextlib
import io
from collections.abc import Mapping
from typing import Any

import msgspec

from snakesim_gnc.control.service import SENSED
from snakesim_hal.base.errors import BackendError, ControllerError, SnakesimError
from snakesim_hal.controller import Controller, ControllerCommand, Observation, load_controller
from snakesim_hal.model.fault_kinds import CONTROL
from snakesim_hal.model.plugins import CONTROLLERS, offer_plugin
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.programs.single_process import InProcessRun
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    AppliedCommand,
    Description,
    JointState,
    LifecycleState,
    Message,
    Mode,
)
from snakesim_hal.wire.setpoints import RequestedSetpoints

SPARE_S = 1.0  # the run lasts longer than the episode, which must not end with it
OVER = object()


class AssistedRobot:
    """A simulated robot, armed, with guidance, navigation and control of its scenario.

    The control service runs a subclass of the scenario's controller, which adds the corrections of `step` to the
    position targets of that controller.
    """

    def __init__(self, config: RunConfig) -> None:
        """Start the run, and run ticks without corrections until the robot is armed.

        This blocks until then, which may take seconds. Nothing stays open if it fails.

        Args:
            config: Configuration of the run; its controller is the one whose targets are corrected.

        Raises:
            SnakesimError: The run cannot begin, or the robot is not ready to arm in time.
        """
        self._correction_rad: list[float] = [0.0] * config.robot.chain.modules  # the controller reads it in every tick
        # The part after the colon is the configuration section, which both controllers share.
        corrected_name = f"residual:{config.controller.rpartition(':')[2]}"
        corrected_class = _make_corrected(load_controller(config.controller), self._correction_rad)
        run_config = msgspec.structs.replace(config, controller=corrected_name, duration_s=config.duration_s + SPARE_S)

        self._service_output = io.StringIO()  # not shown: the reason of a failure is in `failed` of the run
        with offer_plugin(CONTROLLERS, corrected_name, corrected_class), contextlib.ExitStack() as opening:
            self._run = opening.enter_context(InProcessRun(run_config))
            self._subscribe(opening)
            self._ticks = self._run.iterate_ticks(before_services=True)
            opening.callback(self._ticks.close)
            self.description: Description = self._run.host.description
            self._index = {joint.name: i for i, joint in enumerate(self.description.joints)}
            self.newest: dict[str, Message] = {}  # the newest sample of every sensor besides the joints, by key
            self.limited: dict[int, str] = {}  # joint index -> which limit changed its target in the last tick
            self._run_until_armed()
            self._opened = opening.pop_all()  # from now on `close` closes everything

    def _subscribe(self, opening: contextlib.ExitStack) -> None:
        """Open the readers of what the environment observes."""
        session = self._run.network.session()
        opening.callback(session.close)
        self._joints = session.reader(keys.JOINTS, JointState)
        self._applied = session.reader(keys.APPLIED, AppliedCommand)
        self._sensors = {key: session.reader(key, message) for key, message in SENSED.items()}

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

    def step(self, mode: Mode, target: list[float]) -> None:
        """Run one tick. Joints that the controller commands in position mode get its target plus a correction.

        Args:
            mode: Not used: corrections are positions.
            target: (joints,) corrections in rad, tail to head.

        Raises:
            BackendError: The run has ended.
            ControllerError: The controller has failed.
        """
        self._correction_rad[:] = target
        self._run_tick()
        applied = self._applied.newest(lambda _: True)
        if applied is None:
            self.limited = {}
        else:
            self.limited = {self._index[name]: reason for name, reason in applied.limited.items()}

    def close(self) -> None:
        """End the run."""
        self._opened.close()

    def _run_until_armed(self) -> None:
        """Run one tick or more, until the robot is armed for the first time. Raises SnakesimError."""
        self._run_tick()
        while self._run.host.authority.arm_session == 0:
            self._run_tick()

    def _run_tick(self) -> None:
        """Run one tick and read its samples. Raises ControllerError, BackendError."""
        with contextlib.redirect_stderr(self._service_output):
            over = next(self._ticks, OVER) is OVER
        if self._run.failed:
            errors = self._run.take_errors()
            try:
                raise ControllerError("; ".join(self._run.failed)) from _find_cause(errors)
            finally:
                del errors  # the traceback in it holds this frame
        if over and self.lifecycle == "armed":
            raise BackendError(f"the run ended early: {self._run.host.ended_why or self._run.host.ended}")
        joints = self._joints.newest(lambda _: True)
        if joints is not None:
            self.joints = joints
        for key, reader in self._sensors.items():
            message = reader.newest(lambda _: True)
            if message is not None:
                self.newest[key] = message


def _find_cause(errors: Mapping[str, SnakesimError]) -> BaseException | None:
    """Return what the controller has raised, if that is what ended control."""
    error = errors.get(CONTROL)
    return None if error is None else error.__cause__


def _make_corrected(controller_class: type[Controller[Any]], corrections_rad: list[float]) -> type[Controller[Any]]:
    """Return a controller class that adds corrections to the position targets of another one.

    Args:
        controller_class: The class of the other controller.
        corrections_rad: (joints,) corrections in rad. The list is read in every tick.
    """

    # A subclass, so that it has the declarations, the parameters and the check of the other controller.
    class Corrected(controller_class):
        def update(self, observation: Observation) -> ControllerCommand:
            command = super().update(observation)  # pyright: ignore[reportAbstractUsage] - not abstract here
            setpoints = command.setpoints
            target = list(setpoints.target)
            for i, correction_rad in enumerate(corrections_rad):
                # A correction of 0 is not added, so that the target stays the same to the bit.
                if correction_rad and setpoints.mode[i] is Mode.POSITION:
                    target[i] = setpoints.target[i] + correction_rad
            corrected = RequestedSetpoints(setpoints.mode, target, setpoints.torque_limit_nm)
            return ControllerCommand(corrected, command.telemetry)

    return Corrected
