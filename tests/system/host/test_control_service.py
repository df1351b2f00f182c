"""The control service on a real host passes only fresh data to its controller, and stops safely without it."""

import math
import re
import time
from collections.abc import Iterator

import pytest

from snakesim_hal.base.errors import ControllerError
from snakesim_hal.controller import (
    ControllerCommand,
    Observation,
    Telemetry,
    make_position_setpoints,
)
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Clock,
    FaultRequest,
    JointCommand,
    JointState,
    LocomotionIntent,
)
from snakesim_testing.gnc.services import ObservationRecorder, RunningServices, running_services
from snakesim_testing.gnc.stage import require_value
from snakesim_testing.hal.local_network import fast_thread_switching
from snakesim_testing.harness.wait import wait_until

# A busy computer lets the command lease expire, and then nothing is observed.
pytestmark = pytest.mark.quiet
PERIOD_NS = 20_000_000  # of one control cycle
REQUIRED_OBSERVATIONS = 3  # consecutive observations that must agree
MAX_POSE_AGE_S = 0.3
MAX_TRAJECTORY_AGE_S = 0.5
MISSION_SPEED_M_S = 0.2


@pytest.fixture(autouse=True)
def quick_threads() -> Iterator[None]:
    """Switch often between the threads of host and services, for every test of this file."""
    with fast_thread_switching():
        yield


def has_complete_observations(running: RunningServices, since: int = 0) -> bool:
    """Return whether the newest observations have both a world and a trajectory.

    Args:
        running: The running services, whose controller records its observations.
        since: Index of the first observation that counts.
    """
    observations = running.observations[since:][-REQUIRED_OBSERVATIONS:]
    return len(observations) == REQUIRED_OBSERVATIONS and all(
        observation.world is not None and observation.trajectory is not None
        for observation in observations
    )


def has_observations_without(running: RunningServices, field: str) -> bool:
    """Return whether the newest observations are all without the world or the trajectory."""
    observations = running.observations[-REQUIRED_OBSERVATIONS:]
    return len(observations) == REQUIRED_OBSERVATIONS and all(
        getattr(observation, field) is None for observation in observations
    )


def read_newest_speed_m_s(running: RunningServices) -> float | None:
    """Return the speed of the newest observed trajectory; None without a trajectory."""
    trajectory = running.observations[-1].trajectory
    return None if trajectory is None else trajectory.speed_m_s


def test_control_without_joint_states_sends_nothing_and_loses_lease() -> None:
    with running_services(faults=["drop:sensor/joints@1"]) as running:
        commands = running.run.session.declare_reader(keys.JOINT_COMMAND, JointCommand)
        joints = running.run.session.declare_reader(keys.JOINTS, JointState)
        running.run.arm()
        running.run.wait_for_lifecycle("fault")
        assert [fault.what for fault in running.run.status.faults] == ["lease_expired"]
        reported = running.wait_for_reason("sensor/joints is ")
        # The state is Idle if a busy machine delays it until the stop.
        assert reported.state in ("NotLocomoting", "Idle")
        assert "at most 0.06 s" in reported.reason
        last_joint_tick = joints.drain()[-1].tick
        last_command_tick = commands.drain()[-1].tick
        assert last_command_tick == last_joint_tick  # The last command answers a published state.
        assert len(running.observations) < 80


def test_control_command_names_joint_state_that_it_answers() -> None:
    """The command does not name the clock, which arrives even if its joint state is lost."""
    with running_services(max_age={"joints_s": 0.5}) as running:
        session = running.run.session
        clocks = session.declare_reader(keys.CLOCK, Clock)
        joints = session.declare_reader(keys.JOINTS, JointState)
        commands = session.declare_reader(keys.JOINT_COMMAND, JointCommand)
        wait_until(commands.drain, "commands")
        drop_half = FaultRequest(kind="drop", target=keys.JOINTS, amount=0.5)
        assert running.run.request(keys.fault_key("hal"), drop_half).ok
        for reader in (clocks, joints, commands):
            reader.drain()
        command_ticks: set[int] = set()
        wait_until(
            lambda: (
                command_ticks.update(command.tick for command in commands.drain())
                or len(command_ticks) > 20
            ),
            "twenty commands",
        )
        clock_ticks = {clock.tick for clock in clocks.drain()}
        joint_ticks = {state.tick for state in joints.drain()}
        assert len(clock_ticks) > len(joint_ticks) + 5
        # The readers begin and end at slightly different ticks.
        assert len(command_ticks - joint_ticks) <= 2


def test_control_without_streams_withholds_them_until_they_return() -> None:
    limits = {"pose_s": MAX_POSE_AGE_S, "trajectory_s": MAX_TRAJECTORY_AGE_S}
    with running_services(max_age=limits) as running:
        running.run.arm()
        wait_until(lambda: has_complete_observations(running), "complete observations")
        for sender, key, field in (
            ("hal", keys.POSE, "world"),
            ("navigation", keys.TRAJECTORY, "trajectory"),
        ):
            assert running.run.request(
                keys.fault_key(sender), FaultRequest(kind="drop", target=key)
            ).ok
            wait_until(
                lambda field=field: has_observations_without(running, field),
                f"observations without a {field}",
            )
            reported = running.wait_for_reason(f"{key} is ")
            expected_limit = f"at most {limits[key.partition('/')[2] + '_s']:.3g} s"
            assert reported.state == "NotLocomoting"
            assert expected_limit in reported.reason
            since = len(running.observations)
            assert running.run.request(
                keys.fault_key(sender), FaultRequest(kind="drop", target=key, end=True)
            ).ok
            wait_until(
                lambda since=since: has_complete_observations(running, since),
                "complete observations again",
            )
            wait_until(
                lambda key=key: (
                    f"{key} is " not in require_value(running.read_newest_state()).reason
                ),
                "another reason",
            )
        # No observation ever contained a pose that was too old.
        for observation in running.observations:
            if observation.world is not None:
                pose_timestamp_ns = observation.world.pose_timestamp_ns or 0
                assert observation.tick * PERIOD_NS - pose_timestamp_ns <= MAX_POSE_AGE_S * 1e9
        assert not running.run.status.faults
        running.reported.clear()
        running.services["guidance"].stop()
        running.wait_for_reason("guidance/world is ")
        # Navigation still plans, but from an old world model.
        running.wait_for_reason("navigation/trajectory is ")
        wait_until(
            lambda: (
                has_observations_without(running, "world")
                and has_observations_without(running, "trajectory")
            ),
            "observations without either",
        )
        assert running.run.status.lifecycle == "armed"


def test_control_after_intent_expired_stops_and_reports_reason() -> None:
    with running_services() as running:
        operator = running.run.session
        clocks = operator.declare_reader(keys.CLOCK, Clock)
        intents = operator.declare_publisher(keys.INTENT, LocomotionIntent)
        running.run.arm()
        wait_until(lambda: has_complete_observations(running), "complete observations")
        assert read_newest_speed_m_s(running) == MISSION_SPEED_M_S
        now_ns = clocks.drain()[-1].timestamp_ns
        intents.put(
            LocomotionIntent(
                timestamp_ns=now_ns, requester="ann", speed_m_s=0.1, valid_for_ns=500_000_000
            )
        )
        wait_until(lambda: read_newest_speed_m_s(running) == 0.1, "the operator's speed")
        wait_until(lambda: read_newest_speed_m_s(running) == 0.0, "no speed")
        stopped = next(
            observation
            for observation in running.observations
            if observation.trajectory is not None and observation.trajectory.speed_m_s == 0.0
        )
        stopped_after_s = (stopped.tick * PERIOD_NS - now_ns) * 1e-9
        assert stopped_after_s == pytest.approx(0.6, abs=0.25)
        reported = running.wait_for_reason("the intent of ann has expired")
        assert reported.state == "Idle"
        assert "send a new one to go on" in reported.reason
        intents.put(LocomotionIntent(timestamp_ns=clocks.drain()[-1].timestamp_ns, requester="ann"))
        wait_until(lambda: read_newest_speed_m_s(running) == MISSION_SPEED_M_S, "a new intent")


def test_control_update_longer_than_lease_is_reported_after_stop() -> None:
    def update_slowly(self: ObservationRecorder, observation: Observation) -> ControllerCommand:
        time.sleep(0.3)
        return ControllerCommand(make_position_setpoints(self.robot, observation.joints.angle_rad))

    with running_services() as running:
        ObservationRecorder.answers.append(update_slowly)
        running.run.arm()
        running.run.wait_for_lifecycle("fault")
        wait_until(
            lambda: require_value(running.read_newest_state()).too_slow,
            "a state that names the slow update",
        )
        assert re.match(
            r"update\(\) took 3\d\d ms of 20 ms$",
            require_value(running.read_newest_state()).too_slow,
        )


@pytest.mark.parametrize(
    ("answer", "expected_text"),
    [
        (
            lambda self, observation: 1 / 0,
            "update() raised ZeroDivisionError: division by zero (test_control_service.py",
        ),
        (
            lambda self, observation: ControllerCommand(
                make_position_setpoints(self.robot, [0.0] * 3), Telemetry(path_s_m=math.nan)
            ),
            "Telemetry.path_s_m is nan",
        ),
    ],
    ids=["raises", "report"],
)
def test_control_with_invalid_answer_ends_and_names_controller(answer, expected_text: str) -> None:
    with running_services() as running:
        ObservationRecorder.answers.append(answer)
        running.run.arm()
        control = running.services["control"]
        wait_until(lambda: not control.thread.is_alive(), "the end of control")
        assert isinstance(control.error, ControllerError)
        reported = running.wait_for_reason(expected_text).reason
        for text in (str(control.error), reported):
            assert "controller showing (class ObservationRecorder): " in text
            assert expected_text in text
        running.run.wait_for_lifecycle("fault")
