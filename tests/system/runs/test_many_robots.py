"""Two robots and two controllers on one router: each gets its own messages and commands, and nothing of the other's."""

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
SECONDS = {"quick": 2, "a million messages": 1000}
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


class Listener:
    """Counts all messages, and those with the joints of another robot."""

    def __init__(self) -> None:
        self.heard: Counter[str] = Counter()
        self.foreign: Counter[str] = Counter()
        self._decoders = {
            keys.JOINTS: (MessageDecoder(JointState), lambda message: len(message.angle_rad)),
            keys.JOINT_COMMAND: (MessageDecoder(JointCommand), lambda message: len(message.target)),
            keys.APPLIED: (MessageDecoder(AppliedCommand), lambda message: len(message.target)),
        }

    def take(self, arrival: ReceivedSample) -> None:
        """In Zenoh's threads."""
        split = keys.split_namespace(arrival.key)
        namespace, key = split or ("", arrival.key)
        self.heard[namespace] += 1
        if key in self._decoders:
            decoder, joints = self._decoders[key]
            message = decoder.decode(arrival.payload, arrival.encoding)
            self.foreign[namespace] += joints(message) != ROBOTS[namespace][2]


@pytest.mark.slow  # tests/system/lab keeps robots apart
@pytest.mark.parametrize(
    "form",
    [
        "quick",
        pytest.param("a million messages", marks=[pytest.mark.slow, pytest.mark.timeout(3000)]),
    ],
)
def test_two_robots_on_one_router_run_as_if_alone(form: str, lab: LabPrograms) -> None:
    lab.start("start", "router", str(lab.router_file))
    (lab.folder / "plain.toml").write_text(SCENE)
    hosts = {}
    for namespace, (robot, controller, _) in ROBOTS.items():
        path = lab.folder / f"{robot}.toml"
        path.write_text(SCENARIO.format(robot=robot, controller=controller, seconds=SECONDS[form]))
        network = ("--session", str(lab.session), "--namespace", namespace)
        hosts[namespace] = lab.start(
            "start", "host", str(path), "--end-after-duration", "--out", robot, *network
        )
        lab.start("start", "service", "control", str(path), *network)
    wait_until(
        lambda: lab.run_operator_command("status").out.count("next: `snakesim robot arm") == 2,
        "both ready",
    )
    listener = Listener()
    with open_session(ConnectionSettings.from_session_file(read_session(lab.session))) as session:
        session.on_arrival("**", listener.take)
        only_one_is_armed_when_one_is_named(lab)
        for namespace, (robot, _, _) in ROBOTS.items():
            if namespace != "lab":
                assert (
                    lab.run_operator_command(
                        "robot", "arm", robot, "sim", "--namespace", namespace
                    ).code
                    == 0
                )
        began = time.monotonic()
        for namespace, host in hosts.items():
            assert host.wait(2500) == 0, namespace
        took_s = time.monotonic() - began
    assert not any(listener.foreign.values()), listener.foreign
    for robot, _, _ in ROBOTS.values():
        record = RunRecord.load(lab.folder / robot).host
        assert record.rejected_commands == {}
        _, alone = command.run_to_summary(
            lab.folder / f"{robot}-alone", str(lab.folder / f"{robot}.toml")
        )
        assert record.command_digest == alone.command_digest
    least = 1000 if form == "quick" else 1_000_000
    assert sum(listener.heard.values()) > least
    print(f"{dict(listener.heard)} messages in {took_s:.0f} s, 0 foreign", file=sys.stderr)


def only_one_is_armed_when_one_is_named(lab: LabPrograms) -> None:
    """A command that names no robot goes to none of two; one that names the wrong robot is refused by the right one."""
    for arguments in (("robot", "arm", "planar13", "sim"), ("robot", "disarm")):
        ended = lab.run_operator_command(*arguments)
        assert ended.code == 1
        assert "several robots found" in ended.err
        assert "--namespace lab/second" in ended.err
    wrong = lab.run_operator_command("robot", "arm", "planar13", "sim", "--namespace", "lab/second")
    assert wrong.code == 1
    assert "the robot here is 'mamba', not 'planar13'" in wrong.err
    assert lab.run_operator_command("robot", "disarm", "--namespace", "la").code == 1
    assert lab.run_operator_command("robot", "disarm", "--namespace", "lab*").code == 2
    assert (
        lab.run_operator_command("robot", "arm", "planar13", "sim", "--namespace", "lab").code == 0
    )
    assert (
        "lab/second: disarmed"
        in lab.run_operator_command("status", "--namespace", "lab/second").out
    )
