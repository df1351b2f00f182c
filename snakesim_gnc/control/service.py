"""The control process: runs one controller, holds the lease, sends the commands, and says what it is doing."""

import sys
from collections.abc import Sequence

from snakesim_gnc.control.controller import Controller, Report, View
from snakesim_gnc.control.states import locomotion_state
from snakesim_gnc.service import Service, serve
from snakesim_hal import keys
from snakesim_hal.client import Client, Commander
from snakesim_hal.messages import Clock, ControlState, Description, JointState, Message, Trajectory, World
from snakesim_hal.plugins import CONTROLLERS, find_plugin, plugin_settings
from snakesim_hal.scenario import RunConfig

TELEMETRY_S = 0.05


class Control(Service):
    """Runs the scenario's controller."""

    name = "control"
    urgent = True

    def __init__(self, client: Client, config: RunConfig) -> None:
        """Finds the controller and checks its settings."""
        self._controller_name = config.controller
        self._plugin: type[Controller] = find_plugin(CONTROLLERS, config.controller)
        self._settings = plugin_settings(
            self._plugin, config.control_settings, f"scenario {config.name!r}", config.control_section
        )
        self._client = client
        self._joints = client.subscribe(keys.JOINTS, JointState)
        self._world = client.subscribe(keys.WORLD, World)
        self._trajectory = client.subscribe(keys.TRAJECTORY, Trajectory)
        self._robot: Description | None = None
        self._commander: Commander | None = None
        self._controller: Controller | None = None
        self._arming = -1
        self._armed_at_ns = 0
        self._last_told: tuple[object, ...] = ()
        self._tell_at_ns = 0
        self._last_clock: Clock | None = None

    def meet(self, robot: Description) -> None:
        """Get ready to command this robot."""
        self._robot = robot
        self._commander = Commander(self._client, robot)
        self._controller = None
        self._last_told = ()

    def outputs(self, clock: Clock) -> list[tuple[str, Message]] | None:
        """Command the robot; armed, as the controller says, otherwise to stay as it is."""
        assert self._robot is not None and self._commander is not None
        self._last_clock = clock
        joints = self._client.read(self._joints)
        if joints is None:
            return None
        if not self._commander.holds(clock):
            self._controller = None
            why = f"no right to command: {self._commander.refusal or 'the lease is not ours'}"
            return self._tell(clock, Report(why=why[:400]), armed=False, wants=False)
        if clock.lifecycle != "armed":
            self._controller = None
            self._commander.send(clock, self._commander.stay(joints))
            return self._tell(clock, Report(), armed=False, wants=False)
        if self._controller is None or clock.arming != self._arming:
            self._controller = self._plugin(self._robot, self._settings)
            self._arming, self._armed_at_ns = clock.arming, clock.stamp_ns
        trajectory = self._client.read(self._trajectory)
        view = View(
            tick=clock.tick,
            time_s=(clock.stamp_ns - self._armed_at_ns) * 1e-9,
            period_s=clock.period_ns * 1e-9,
            joints=joints,
            world=self._client.read(self._world),
            trajectory=trajectory,
        )
        action = self._controller.update(view)
        self._commander.send(clock, action.set_points)
        wants = trajectory is not None and trajectory.speed_m_s != 0.0
        return self._tell(clock, action.report, armed=True, wants=wants)

    def silence(self) -> list[tuple[str, Message]]:
        """The HAL is gone: PowerOff."""
        if self._last_clock is None:
            return []
        self._controller = None
        return self._tell(self._last_clock, Report(), armed=False, wants=False, answers=False)

    def _tell(
        self, clock: Clock, report: Report, *, armed: bool, wants: bool, answers: bool = True
    ) -> list[tuple[str, Message]]:
        """The telemetry, at a few hertz, and at once when something worth knowing changed."""
        state, reason = locomotion_state(
            hal_answers=answers,
            armed=armed,
            wants_to_move=wants,
            usable_push_points=report.usable_push_points,
            obstacle=report.why,
        )
        mark = (state, report.propulsion_joint, report.jammed, clock.lifecycle, clock.arming)
        if mark == self._last_told and clock.stamp_ns < self._tell_at_ns:
            return []
        self._last_told, self._tell_at_ns = mark, clock.stamp_ns + round(TELEMETRY_S * 1e9)
        joints = self._robot.joints if self._robot is not None else []
        told = ControlState(
            tick=clock.tick,
            stamp_ns=clock.stamp_ns,
            controller=self._controller_name[-64:],
            state=state,
            reason=reason[:500],
            path_s_m=report.path_s_m,
            propulsion_joint=None if report.propulsion_joint is None else joints[report.propulsion_joint].name,
            propulsion_n=report.propulsion_n,
            push_points=list(report.push_points),
            solved_force_n=list(report.solved_force_n),
            propulsion_torque_nm=report.propulsion_torque_nm,
            bending_torque_nm=list(report.bending_torque_nm),
            reference_rad=list(report.reference_rad),
            condition=report.condition,
            torque_headroom_nm=report.torque_headroom_nm,
            saturated=report.saturated,
            jammed=report.jammed,
        )
        return [(keys.CONTROL_STATE, told)]


def main(argv: Sequence[str] | None = None) -> int:
    """Run control until its robot is gone."""
    return serve(Control, argv)


if __name__ == "__main__":
    sys.exit(main())
