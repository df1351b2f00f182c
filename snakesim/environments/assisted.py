"""A robot whose controller drives it, and an environment corrects: a whole run in this process, turn by turn."""

import contextlib
import io
from collections.abc import Mapping
from typing import Any

import msgspec

from snakesim_gnc.control.controller import Action, Controller, View
from snakesim_gnc.control.service import SENSED
from snakesim_hal.base.errors import BackendError, ControllerError, SnakesimError
from snakesim_hal.model.plugins import CONTROLLERS, find_plugin, offered
from snakesim_hal.model.scenario import CONTROL, RunConfig
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

SPARE_S = 1.0  # the run must not be over before the episode is
OVER = object()


class AssistedRobot:
    """A simulated robot, armed, with guidance, navigation and control of its scenario."""

    def __init__(self, config: RunConfig) -> None:
        """Raises SnakesimError when the run cannot begin."""
        self._residual: list[float] = [0.0] * config.robot.chain.modules
        name = f"residual:{config.controller.rpartition(':')[2]}"  # which has the same section of settings
        plugin = _corrected(find_plugin(CONTROLLERS, config.controller), self._residual)
        longer = msgspec.structs.replace(config, controller=name, duration_s=config.duration_s + SPARE_S)
        self._said = io.StringIO()  # by the services; the reason of a failure is in `failed`
        with offered(CONTROLLERS, name, plugin), contextlib.ExitStack() as opening:
            self._run = opening.enter_context(InProcessRun(longer))
            session = self._run.network.session()
            opening.callback(session.close)
            self._joints = session.reader(keys.JOINTS, JointState)
            self._applied = session.reader(keys.APPLIED, AppliedCommand)
            self._sensors = {key: session.reader(key, message) for key, message in SENSED.items()}
            self._turns = self._run.iterate_ticks(before_services=True)
            opening.callback(self._turns.close)
            self.description: Description = self._run.host.description
            self._index = {joint.name: i for i, joint in enumerate(self.description.joints)}
            self.newest: dict[str, Message] = {}
            self.limited: dict[int, str] = {}
            self._turn()
            while not self._run.host.authority.arm_session:
                self._turn()
            self._opened = opening.pop_all()

    @property
    def lifecycle(self) -> LifecycleState:
        """As the host publishes it."""
        return self._run.host.authority.state

    @property
    def why(self) -> str:
        """Why it is in this state."""
        return self._run.host.authority.why

    @property
    def digest(self) -> str:
        """`command_digest` of the run."""
        return self._run.host.black_box.command_digest

    def step(self, mode: Mode, target: list[float]) -> None:
        """One tick; the targets are added to the controller's own, of the joints that it commands in this mode."""
        self._residual[:] = target
        self._turn()
        applied = self._applied.newest(lambda _: True)
        self.limited = {} if applied is None else {self._index[name]: why for name, why in applied.limited.items()}

    def close(self) -> None:
        """End the run."""
        self._opened.close()

    def _turn(self) -> None:
        with contextlib.redirect_stderr(self._said):
            over = next(self._turns, OVER) is OVER
        if self._run.failed:
            errors = self._run.take_errors()
            try:
                raise ControllerError("; ".join(self._run.failed)) from _cause_of(errors)
            finally:
                del errors  # the traceback in it holds this frame
        if over and self.lifecycle == "armed":
            raise BackendError(f"the run ended early: {self._run.host.ended_why or self._run.host.ended}")
        if (joints := self._joints.newest(lambda _: True)) is not None:
            self.joints = joints
        for key, reader in self._sensors.items():
            if (message := reader.newest(lambda _: True)) is not None:
                self.newest[key] = message


def _cause_of(errors: Mapping[str, SnakesimError]) -> BaseException | None:
    """Return what the controller has raised, if that is what ended control."""
    error = errors.get(CONTROL)
    return None if error is None else error.__cause__


def _corrected(plugin: type[Controller], residual_rad: list[float]) -> Any:
    """The controller with a residual on its position targets. residual_rad: read at every tick."""

    class Corrected:
        Settings = plugin.Settings
        NEEDS, SENSES = getattr(plugin, "NEEDS", "world"), getattr(plugin, "SENSES", False)

        def __init__(self, robot: Description, settings: Any) -> None:
            self._inner = plugin(robot, settings)

        def update(self, view: View) -> Action:
            action = self._inner.update(view)
            points = action.setpoints
            target = [
                asked + by if by and mode is Mode.POSITION else asked  # by nothing: to the bit what was asked
                for asked, by, mode in zip(points.target, residual_rad, points.mode, strict=True)
            ]
            return Action(RequestedSetpoints(points.mode, target, points.torque_limit_nm), action.report)

    return Corrected
