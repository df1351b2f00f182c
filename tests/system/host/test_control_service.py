"""The control service on a real host: what it gives its controller when streams stop; what it does without joints."""

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
PERIOD_NS = 20_000_000
SEEN = 3  # observations in a row


@pytest.fixture(autouse=True)
def quick_threads() -> Iterator[None]:
    with fast_thread_switching():
        yield


def sighted(made: RunningServices, since: int = 0) -> bool:
    observations = made.observations[since:][-SEEN:]
    return len(observations) == SEEN and all(
        observation.world is not None and observation.trajectory is not None
        for observation in observations
    )


def blind(made: RunningServices, what: str) -> bool:
    observations = made.observations[-SEEN:]
    return len(observations) == SEEN and all(
        getattr(observation, what) is None for observation in observations
    )


def speed(made: RunningServices) -> float | None:
    trajectory = made.observations[-1].trajectory
    return None if trajectory is None else trajectory.speed_m_s


def test_without_joints_it_sends_nothing_and_the_lease_ends() -> None:
    with running_services(faults=["drop:sensor/joints@1"]) as made:
        commands = made.run.session.declare_reader(keys.JOINT_COMMAND, JointCommand)
        joints = made.run.session.declare_reader(keys.JOINTS, JointState)
        made.run.arm()
        made.run.wait_for_lifecycle("fault")
        assert [fault.what for fault in made.run.status.faults] == ["lease_expired"]
        reported = made.wait_for_reason("sensor/joints is ")
        # The latter when a busy machine delays it until the stop.
        assert reported.state in ("NotLocomoting", "Idle")
        assert "at most 0.06 s" in reported.reason
        last_joints, last_command = joints.drain()[-1].tick, commands.drain()[-1].tick
        assert last_command == last_joints  # no command ever named a state that was not
        assert len(made.observations) < 80


def test_a_command_names_the_joint_state_that_it_answers() -> None:
    """Not the clock, which comes also when its joint state was lost on the way."""
    with running_services(max_age={"joints_s": 0.5}) as made:
        session = made.run.session
        clocks, joints = (
            session.declare_reader(keys.CLOCK, Clock),
            session.declare_reader(keys.JOINTS, JointState),
        )
        commands = session.declare_reader(keys.JOINT_COMMAND, JointCommand)
        wait_until(commands.drain, "commands")
        lose = FaultRequest(kind="drop", target=keys.JOINTS, amount=0.5)
        assert made.run.request(keys.fault_key("hal"), lose).ok
        for reader in (clocks, joints, commands):
            reader.drain()
        named: set[int] = set()
        wait_until(
            lambda: named.update(c.tick for c in commands.drain()) or len(named) > 20,
            "twenty commands",
        )
        shown, felt = (
            {clock.tick for clock in clocks.drain()},
            {state.tick for state in joints.drain()},
        )
        assert len(shown) > len(felt) + 5
        assert len(named - felt) <= 2  # at the ends of what was heard


def test_control_without_streams_withholds_them_until_they_return() -> None:
    limits = {"pose_s": 0.3, "trajectory_s": 0.5}
    with running_services(max_age=limits) as made:
        made.run.arm()
        wait_until(lambda: sighted(made), "observations with everything in them")
        for sender, key, what in (
            ("hal", keys.POSE, "world"),
            ("navigation", keys.TRAJECTORY, "trajectory"),
        ):
            assert made.run.request(
                keys.fault_key(sender), FaultRequest(kind="drop", target=key)
            ).ok
            wait_until(lambda what=what: blind(made, what), f"observations without a {what}")
            reported = made.wait_for_reason(f"{key} is ")
            words = f"at most {limits[key.partition('/')[2] + '_s']:.3g} s"
            assert reported.state == "NotLocomoting"
            assert words in reported.reason
            since = len(made.observations)
            assert made.run.request(
                keys.fault_key(sender), FaultRequest(kind="drop", target=key, end=True)
            ).ok
            wait_until(
                lambda since=since: sighted(made, since), "observations with everything again"
            )
            wait_until(
                lambda key=key: f"{key} is " not in require_value(made.read_newest_state()).reason,
                "another reason",
            )
        for observation in made.observations:  # nothing too old was ever handed over
            if observation.world is not None:
                assert (
                    observation.tick * PERIOD_NS - (observation.world.pose_timestamp_ns or 0)
                    <= 300_000_000
                )
        assert not made.run.status.faults
        made.reported.clear()
        made.services["guidance"].stop()
        made.wait_for_reason("guidance/world is ")
        # Planned from the last world model over and over.
        made.wait_for_reason("navigation/trajectory is ")
        wait_until(
            lambda: blind(made, "world") and blind(made, "trajectory"),
            "observations without either",
        )
        assert made.run.status.lifecycle == "armed"


def test_control_after_intent_expired_rests_and_says_why() -> None:
    with running_services() as made:
        clocks, operator = made.run.session.declare_reader(keys.CLOCK, Clock), made.run.session
        intents = operator.declare_publisher(keys.INTENT, LocomotionIntent)
        made.run.arm()
        wait_until(lambda: sighted(made), "observations with everything in them")
        assert speed(made) == 0.2  # the mission's
        now_ns = clocks.drain()[-1].timestamp_ns
        intents.put(
            LocomotionIntent(
                timestamp_ns=now_ns, requester="ann", speed_m_s=0.1, valid_for_ns=500_000_000
            )
        )
        wait_until(lambda: speed(made) == 0.1, "the operator's speed")
        wait_until(lambda: speed(made) == 0.0, "no speed")
        stopped = next(
            observation
            for observation in made.observations
            if observation.trajectory is not None and observation.trajectory.speed_m_s == 0.0
        )
        assert (stopped.tick * PERIOD_NS - now_ns) * 1e-9 == pytest.approx(0.6, abs=0.25)
        reported = made.wait_for_reason("the intent of ann has expired")
        assert reported.state == "Idle"
        assert "send a new one to go on" in reported.reason
        intents.put(LocomotionIntent(timestamp_ns=clocks.drain()[-1].timestamp_ns, requester="ann"))
        wait_until(lambda: speed(made) == 0.2, "a new intent")


def test_control_update_longer_than_lease_is_reported_after_stop() -> None:
    def slow(self: ObservationRecorder, observation: Observation) -> ControllerCommand:
        time.sleep(0.3)
        return ControllerCommand(make_position_setpoints(self.robot, observation.joints.angle_rad))

    with running_services() as made:
        ObservationRecorder.answers.append(slow)
        made.run.arm()
        made.run.wait_for_lifecycle("fault")
        wait_until(
            lambda: require_value(made.read_newest_state()).too_slow,
            "a state that names the slow update",
        )
        assert re.match(
            r"update\(\) took 3\d\d ms of 20 ms$", require_value(made.read_newest_state()).too_slow
        )


@pytest.mark.parametrize(
    ("answer", "words"),
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
def test_a_controller_that_answers_wrongly_ends_control_with_its_name(answer, words: str) -> None:
    with running_services() as made:
        ObservationRecorder.answers.append(answer)
        made.run.arm()
        control = made.services["control"]
        wait_until(lambda: not control.thread.is_alive(), "the end of control")
        assert isinstance(control.error, ControllerError)
        for text in (str(control.error), made.wait_for_reason(words).reason):
            assert "controller showing (class Showing): " in text
            assert words in text
        made.run.wait_for_lifecycle("fault")
