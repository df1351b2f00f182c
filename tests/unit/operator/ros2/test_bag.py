"""Converts a recording to a ROS 2 bag and reads it with the library rosbags; sums contact forces to wrenches."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_hal.wire import messages as m
from snakesim_operator.features.ros2.bag import convert_recording_to_rosbag
from snakesim_operator.features.ros2.contact_wrenches import sum_wrenches
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.signals import compute_signals
from snakesim_operator.run.in_process import simulate

YEAR_2020_S = 1_577_836_800


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a simulated run of half a second."""
    out = tmp_path_factory.mktemp("bag") / "run"
    simulate(load_scenario("triplet", [parse_set_option("duration_s=0.5")]).config, out)
    return out


def read_bag(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Return the messages of each topic, each with its time in the bag in ns."""
    messages: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([path]) as reader:
        for connection, time_ns, data in reader.messages():
            messages.setdefault(connection.topic, []).append(
                (time_ns, reader.deserialize(data, connection.msgtype))
            )
    return messages


def make_contact(
    link: int, position_l: tuple[float, float, float], force_l: tuple[float, float, float]
) -> m.Contact:
    """Make a contact with this force and a torque of 0.5 Nm about the vertical axis."""
    return m.Contact(
        link=link,
        obstacle="peg",
        position_l=position_l,
        normal_l=(0.0, 1.0, 0.0),
        tangent_1_l=(1.0, 0.0, 0.0),
        tangent_2_l=(0.0, 0.0, 1.0),
        force_l=force_l,
        torque_l=(0.0, 0.0, 0.5),
    )


def test_wrench_of_a_link_is_the_sum_about_its_frame() -> None:
    contacts = [
        make_contact(1, (0.1, 0.0, 0.0), (0.0, 3.0, 0.0)),
        make_contact(1, (0.0, 0.2, 0.0), (4.0, 0.0, 0.0)),
        make_contact(9, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),  # no link of this robot
    ]
    wrenches = sum_wrenches(contacts, 3)
    assert wrenches[1] == pytest.approx([4.0, 3.0, 0.0, 0.0, 0.0, 0.1 * 3.0 - 0.2 * 4.0 + 2 * 0.5])
    assert not wrenches[[0, 2]].any()


def test_bag_contains_joints_and_contact_forces_of_the_run(run: Path, tmp_path: Path) -> None:
    lines: list[str] = []
    assert convert_recording_to_rosbag(run, tmp_path / "bag", lines.append, wall_time=False) == 0
    assert sorted(file.name for file in (tmp_path / "bag").iterdir()) == [
        "bag.mcap",
        "metadata.yaml",
    ]
    messages = read_bag(tmp_path / "bag")
    record = RunRecord.load(run)
    forces_l_n = compute_signals(record)["link_force_l_n"]
    link_names = [link.name for link in record.description.links]
    assert {
        "/joint_states",
        "/tf",
        "/tf_static",
        "/robot_description",
        "/diagnostics",
        "/clock",
    } <= set(messages)

    joint_state_by_stamp_ns = {
        message.header.stamp.sec * 10**9 + message.header.stamp.nanosec: message
        for _, message in messages["/joint_states"]
    }
    row = 30
    joint_state = joint_state_by_stamp_ns[round(record.time_s[row] * 1e9)]
    assert joint_state.position.tolist() == record.angle_rad[row].tolist()
    assert joint_state.name == [joint.name for joint in record.description.joints]

    strongest_link = int(np.nanargmax(np.nanmax(np.linalg.norm(forces_l_n, axis=2), axis=0)))
    for link in (0, strongest_link):
        wrenches = dict(messages[f"/{link_names[link]}/contact"])
        for i, time_s in enumerate(record.time_s):
            message = wrenches[round(time_s * 1e9)]
            force = message.wrench.force
            assert message.header.frame_id == link_names[link]
            assert [force.x, force.y, force.z] == pytest.approx(forces_l_n[i, link].tolist())
    assert str(sum(map(len, messages.values()))) in lines[0]


def test_bag_with_wall_stamps_has_no_clock(run: Path, tmp_path: Path) -> None:
    convert_recording_to_rosbag(run, tmp_path / "bag", lambda _line: None, wall_time=True)
    messages = read_bag(tmp_path / "bag")
    assert "/clock" not in messages
    time_ns, message = messages["/joint_states"][0]
    assert message.header.stamp.sec > YEAR_2020_S
    assert time_ns == message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def test_bag_is_never_overwritten(run: Path, tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    with pytest.raises(ConfigError, match="such a folder already"):
        convert_recording_to_rosbag(run, tmp_path / "bag", lambda _line: None, wall_time=False)
