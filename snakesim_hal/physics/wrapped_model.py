"""A physics model that wraps another one, and has its state: the base class of models that change a part of it."""

from snakesim_hal.base.arrays import Floats
from snakesim_hal.physics.physics_model import LinkLoad, PhysicsModel
from snakesim_hal.wire.messages import Imu, Pose


class WrappedModel(PhysicsModel):
    """Advances another model, and returns its state. Derive from it, and override what differs."""

    def __init__(self, physics_model: PhysicsModel) -> None:
        """Wrap a model, at its present state."""
        self._physics_model = physics_model
        self.step_s = physics_model.step_s

    def advance(self, torque_nm: Floats) -> None:
        self._physics_model.advance(torque_nm)

    @property
    def angle_rad(self) -> Floats:
        return self._physics_model.angle_rad

    @property
    def velocity_rad_s(self) -> Floats:
        return self._physics_model.velocity_rad_s

    def shaft_torque_nm(self) -> Floats:
        return self._physics_model.shaft_torque_nm()

    def loads(self) -> list[LinkLoad]:
        return self._physics_model.loads()

    def imu(self) -> Imu | None:
        return self._physics_model.imu()

    def pose(self) -> Pose | None:
        return self._physics_model.pose()
