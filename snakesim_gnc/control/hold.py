"""Holds every joint at its angle at arming. This is the control condition of experiments, and the safest controller."""

from snakesim_hal.controller import (
    Controller,
    ControllerCommand,
    NoParameters,
    Observation,
    Telemetry,
    make_position_setpoints,
)
from snakesim_hal.wire.messages import RobotDescription


class HoldPose(Controller[NoParameters]):
    """Keeps the pose of the first observation."""

    needs_world = False

    def __init__(self, robot: RobotDescription, parameters: NoParameters) -> None:
        super().__init__(robot, parameters)
        # None if there has been no observation yet.
        self._start_angles_rad: list[float] | None = None

    def update(self, observation: Observation) -> ControllerCommand:
        """Return the angles of the first observation."""
        if self._start_angles_rad is None:
            self._start_angles_rad = list(observation.joints.angle_rad)
        return ControllerCommand(
            make_position_setpoints(self.robot, self._start_angles_rad),
            Telemetry(reason="holding", reference_rad=self._start_angles_rad),
        )
