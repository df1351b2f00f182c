"""Controllers run on drives with few modes and measurements if they need no others (refusals: refusals.toml)."""

from snakesim_gnc.control.hold import HoldPose
from snakesim_gnc.control.service.guarded import GuardedController
from snakesim_hal.base.errors import ControllerError
from snakesim_hal.controller import NoParameters, Observation
from snakesim_hal.model.robot_file.robot import describe_robot
from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_hal.wire.messages import JointMode
from snakesim_operator.run.in_process import simulate
from snakesim_testing.hal.small_robots import make_joint_state
from snakesim_testing.messages import raises_error

POSITION_SERVOS = ('robot.drive.modes=["position"]', "robot.drive.measures=[]")


def test_position_servos_without_measurements_run_undemanding_controllers() -> None:
    options = ("controller=lateral_undulation", "duration_s=2", *POSITION_SERVOS)
    result = simulate(load_scenario("peg_row", [parse_set_option(text) for text in options]).config)
    assert result.summary.ended == "complete"
    assert (result.summary.path_distance_m or 0.0) > 0.1
    assert not result.record.torque_nm.any(), "a torque that is not measured is reported"
    assert set(result.record.mode.flat) <= {JointMode.PASSIVE, JointMode.POSITION}


def test_controller_without_declared_needs_is_named_at_first_command() -> None:
    class Pushes(HoldPose):
        def update(self, observation):  # pyright: ignore
            command = super().update(observation)
            command.setpoints.mode[1] = JointMode.TORQUE
            return command

    config = load_scenario("triplet", [parse_set_option(text) for text in POSITION_SERVOS]).config
    robot = describe_robot(
        config.robot, backend="sim", period_ns=10**7, lease_ns=10**8, config_hash="0"
    )
    observation = Observation(
        tick=0,
        time_s=0.0,
        period_s=0.01,
        joints=make_joint_state(robot),
        world=None,
        trajectory=None,
    )
    with raises_error(ControllerError, code="controller/failed", field="joint_2"):
        GuardedController("pushes", Pushes, robot, NoParameters()).update(observation)  # pyright: ignore[reportArgumentType]
