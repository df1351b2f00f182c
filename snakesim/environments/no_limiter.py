"""A safety core without limits, for environments that command the motors directly."""

from snakesim_hal.backend import SafeSetpoints
from snakesim_hal.safety.authority import TickOutput
from snakesim_hal.wire.messages import (
    Fault,
    JointMode,
    JointState,
    LifecycleState,
    Power,
    RobotDescription,
)


class NoLimiter:
    """A stand-in for the authority of a simulated robot: it passes every target on, and is always armed.

    It is the one place outside of the limiter that declares setpoints safe, so it must never drive a real robot.
    """

    def __init__(self, description: RobotDescription) -> None:
        self._full_torque_nm = [joint.torque_limit_nm for joint in description.joints]
        self._modes = [JointMode.PASSIVE] * len(description.joints)
        self._target = [0.0] * len(description.joints)
        self._failure = ""

    @property
    def state(self) -> LifecycleState:
        """`armed`, until the backend fails."""
        return "fault" if self._failure else "armed"

    @property
    def reason(self) -> str:
        """Why it is in this state."""
        return self._failure or "no limiter"

    def command(self, modes: list[JointMode], target: list[float]) -> None:
        """Set the modes and targets of the next period."""
        self._modes = modes
        self._target = target

    def observe_joints(self, joints: JointState, now_ns: int) -> None:
        """Ignore the joint states."""

    def set_backend_obstacles(self, obstacles: list[str]) -> None:
        """Ignore them: simulated robots are always ready."""

    def observe_power(self, power: Power, now_ns: int) -> None:
        """Ignore the power samples."""

    def latch_faults_and_expire_lease(self, now_ns: int, tick: int) -> None:
        """Do nothing: there is no lease that could expire."""

    def compute_setpoints(self, max_tick: int | None = None) -> TickOutput:
        """Return the targets unchanged."""
        return TickOutput(SafeSetpoints(self._modes, self._target, self._full_torque_nm), None, {})

    def latch_fault(self, fault: Fault) -> None:
        """Remember a fault of the whole robot; a fault of a joint changes nothing."""
        if fault.scope == "robot":
            self._failure = fault.cause
