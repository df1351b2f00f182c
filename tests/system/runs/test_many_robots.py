"""Two robots and two controllers share one router: each receives its own messages, and none of the other robot."""

import sys
import time
from collections import Counter

import pytest

from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.network.session_file import read_session
from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MessageDecoder
from snakesim_hal.wire.messages import AppliedCommand, JointCommand, JointState
from snakesim_operator.results.run_log import RunRecord
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs import in_process_command as command
from snakesim_testing.runs.lab_programs import LabPrograms

pytestmark = pytest.mark.e2e

# One namespace is a prefix of the other, and the other robot has another number of joints.
ROBOTS = {"lab": ("planar13", "lateral_undulation", 13), "lab/second": ("mamba", "hold", 18)}
DURATIONS_S = {"quick": 2, "a million messages": 1000}
SCENE = 'name = "plain"\n[ground]\nfriction = 0.5\n'
SCENARIO = """
robot = "{robot}"
scene = "plain.toml"
controller = "{controller}"
clock_mode = "lockstep"
duration_s = {seconds}
[start]
on_route = false
[services.control]
latency_ticks = 2
"""


class MessageCounter:
    """Counts all messages by namespace, and those that have the joint count of another robot."""

    def __init__(self) -> None:
        self.received: Counter[str] = Counter()
        self.foreign: Counter[str] = Counter()
        self._decoders = {
            keys.JOINTS: (MessageDecoder(JointState), lambda message: len(message.angle_rad)),
            keys.JOINT_COMMAND: (MessageDecoder(JointCommand), lambda message: len(message.target)),
            keys.APPLIED: (MessageDecoder(AppliedCommand), lambda message: len(message.target)),
        }

    def count(self, arrival: ReceivedSample) -> None:
        """Count a message. Zenoh's threads call this."""
        namespace, key = keys.split_namespace(arrival.key) or ("", arrival.key)
        self.received[namespace] += 1
        if key in self._decoders:
            decoder, count_joints = self._decoders[key]
            message = decoder.decode(arrival.payload, arrival.encoding)
            _, _, joint_count = ROBOTS[namespace]
            self.foreign[namespace] += count_joints(message) != joint_count


@pytest.mark.slow  # tests/system/lab also checks that robots are separate
@pytest.mark.parametrize(
    "variant",
    [
        "quick",
        pytest.param("a million messages", marks=[pytest.mark.slow, pytest.mark.timeout(3000)]),
    ],
)
def test_two_robots_on_one_router_run_as_if_alone(variant: str, lab: LabPrograms) -> None:
    lab.start("start", "router", str(lab.router_file))
    (lab.folder / "plain.toml").write_text(SCENE)
    hosts = {}
    for namespace, (robot, controller, _) in ROBOTS.items():
        path = lab.folder / f"{robot}.toml"
        path.write_text(
            SCENARIO.format(robot=robot, controller=controller, seconds=DURATIONS_S[variant])
        )
        network = ("--session", str(lab.session), "--namespace", namespace)
        hosts[namespace] = lab.start(
            "start", "host", str(path), "--end-after-duration", "--out", robot, *network
        )
        lab.start("start", "service", "control", str(path), *network)
    wait_until(
        lambda: lab.run_operator_command("status").out.count("next: `snakesim robot arm") == 2,
        "both robots are ready to arm",
    )
    counter = MessageCounter()
    with open_session(ConnectionSettings.from_session_file(read_session(lab.session))) as session:
        session.on_arrival("**", counter.count)
        arm_first_robot_and_check_refusals(lab)
        armed = lab.run_operator_command(
            "robot", "arm", "mamba", "sim", "--namespace", "lab/second"
        )
        assert armed.code == 0
        start_s = time.monotonic()
        for namespace, host in hosts.items():
            assert host.wait(2500) == 0, namespace
        duration_s = time.monotonic() - start_s
    assert not any(counter.foreign.values()), counter.foreign
    for robot, _, _ in ROBOTS.values():
        record = RunRecord.load(lab.folder / robot).host
        assert record.rejected_commands == {}
        _, summary_alone = command.run_to_summary(
            lab.folder / f"{robot}-alone", str(lab.folder / f"{robot}.toml")
        )
        assert record.command_digest == summary_alone.command_digest
    min_messages = 1000 if variant == "quick" else 1_000_000
    assert sum(counter.received.values()) > min_messages
    print(f"{dict(counter.received)} messages in {duration_s:.0f} s, 0 foreign", file=sys.stderr)


def arm_first_robot_and_check_refusals(lab: LabPrograms) -> None:
    """Check that commands without a robot or with the wrong robot are refused, and arm the robot in `lab`."""
    for arguments in (("robot", "arm", "planar13", "sim"), ("robot", "disarm")):
        ambiguous = lab.run_operator_command(*arguments)
        assert ambiguous.code == 1
        assert "several robots found" in ambiguous.err
        assert "--namespace lab/second" in ambiguous.err
    arm_planar13 = ("robot", "arm", "planar13", "sim")
    wrong_robot = lab.run_operator_command(*arm_planar13, "--namespace", "lab/second")
    assert wrong_robot.code == 1
    assert "the robot here is 'mamba', not 'planar13'" in wrong_robot.err
    assert lab.run_operator_command("robot", "disarm", "--namespace", "la").code == 1
    assert lab.run_operator_command("robot", "disarm", "--namespace", "lab*").code == 2
    assert lab.run_operator_command(*arm_planar13, "--namespace", "lab").code == 0
    second_status = lab.run_operator_command("status", "--namespace", "lab/second")
    assert "lab/second: disarmed" in second_status.out
