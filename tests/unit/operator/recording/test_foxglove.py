"""What Foxglove shows of a recording, read with the library that reads its schemas: the snake is where it was."""

import json
import math
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from foxglove_schemas_protobuf.JointState_pb2 import JointState as NamedJoint
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Log_pb2 import Log
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader
from mcap_protobuf.decoder import DecoderFactory

from snakesim_hal.model.geometry.kinematics import rotation_from_quaternion
from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import encode
from snakesim_hal.wire.messages import Contacts, ControlState, DepthImage
from snakesim_operator.recording.foxglove_messages import shapes
from snakesim_operator.recording.foxglove_messages.body_frames import BodyMessageEncoder
from snakesim_operator.recording.foxglove_messages.converter import FoxgloveConverter
from snakesim_operator.recording.foxglove_messages.state_messages import StateMessages
from snakesim_operator.recording.message import RECORDING_FILENAME
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.recording.recover import recover_recording
from snakesim_operator.recording.writer import RecordingWriter
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.run.in_process import simulate
from snakesim_testing.hal.small_robots import make_description
from snakesim_testing.hal.small_robots import make_joint_state as joint_state
from snakesim_testing.runs.in_process_command import run_to_summary

ROBOT = "/planar13_camera"
LAYOUT = Path(__file__).parents[4] / "docs" / "how-to" / "foxglove-layout.json"


class Json:
    """Decodes JSON for the stock reader."""

    def decoder_for(self, message_encoding: str, _schema: Any) -> Any:
        return (
            json.loads
            if message_encoding == "json"
            else (lambda data: data)
            if message_encoding == "msgpack"
            else None
        )


CONTACTS = msgspec.msgpack.Decoder(Contacts)
FACTORIES = [DecoderFactory(), Json()]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("shown") / "run"
    simulate(
        load_scenario(
            "triplet",
            [parse_set_option("robot=planar13_camera"), parse_set_option("duration_s=0.8")],
        ).config,
        out,
    )
    return out


def shown(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Topic -> (robot time, message) of everything in protobuf."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        camera = ("head/depth/image_raw", "head/depth/camera_info")
        names = ("tf", "joint_states", "joint_references", "pose", "log", *camera)
        topics = [f"{ROBOT}/{name}" for name in names]
        scene = [f"{ROBOT}/scene/{name}" for name in ("body", "obstacles", "map", "forces", "path")]
        for _, channel, message, decoded in reader.iter_decoded_messages(topics=topics + scene):
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    assert sorted(found) == sorted(topics + scene)
    return found


def in_the_world(chain: Any) -> tuple[Any, Any]:
    """Origins (n, 3) of frames that are each in the one before, and the last one's x axis."""
    origin, rotation, origins = np.zeros(3), np.eye(3), list[Any]()
    for one in chain:
        at, q = one.translation, one.rotation
        origin = origin + rotation @ (at.x, at.y, at.z)
        rotation = rotation @ rotation_from_quaternion((q.w, q.x, q.y, q.z))
        origins.append(origin)
    return np.array(origins), rotation[:, 0]


def test_transforms_and_joints_are_those_of_the_robot(run: Path) -> None:
    found, record = shown(run / RECORDING_FILENAME), RunRecord.load(run)
    moving = [(at, one) for at, one in found[f"{ROBOT}/tf"] if len(one.transforms) > 1]
    at_ns, update = moving[-1]
    row = record.find_nearest_row(at_ns * 1e-9)
    nodes = record.find_body_points_w(row)
    assert nodes is not None
    assert len(update.transforms) == len(record.description.links)
    behind = ["world", *(link.name for link in record.description.links[:-1])]
    assert [one.parent_frame_id for one in update.transforms] == behind
    reported, forward = in_the_world(update.transforms)
    assert np.allclose(reported, nodes[:-1], atol=1e-9)
    towards = (nodes[-1] - nodes[-2]) / record.description.links[-1].length_m
    assert np.allclose(forward, towards, atol=1e-6)
    states = dict(found[f"{ROBOT}/joint_states"])[at_ns]
    assert [joint.position for joint in states.joints] == record.angle_rad[row].tolist()
    assert [joint.name for joint in states.joints] == [
        joint.name for joint in record.description.joints
    ]


def test_foxglove_joint_states_equal_reference_encoder_to_the_byte() -> None:
    robot, time_ns = make_description(), 1_234_567_890_123
    names, frames = [joint.name for joint in robot.joints], BodyMessageEncoder(robot)
    for angle, speed, torque in (([0.1, -0.2, 3.0], 0.5, -1e-300), ([1.0, 2.0, 3.0], 4.0, 0.0)):
        joints = joint_state(robot, angle, speed, torque)
        rows = zip(names, joints.angle_rad, joints.velocity_rad_s, joints.torque_nm, strict=True)
        whole = [NamedJoint(name=name, position=p, velocity=v, effort=e) for name, p, v, e in rows]
        wanted = [NamedJoint(name=name, position=p) for name, p in zip(names, angle, strict=True)]
        stamp = shapes.make_timestamp(time_ns)
        states = JointStates(timestamp=stamp, joints=whole)
        references = JointStates(timestamp=stamp, joints=wanted)
        assert frames.encode_joint_states(joints, time_ns) == states.SerializeToString()
        assert frames.encode_references(angle, time_ns) == references.SerializeToString()


def test_foxglove_joints_forces_and_state_keep_robot_rates(run: Path) -> None:
    raw = list(RecordingReader(run / RECORDING_FILENAME).read_messages())
    wire = Counter(one.key for one in raw)
    with (run / RECORDING_FILENAME).open("rb") as file:
        read = list(make_reader(file, decoder_factories=FACTORIES).iter_decoded_messages())
    topics = Counter(channel.topic for _, channel, *_ in read)
    assert topics[f"{ROBOT}/joint_states"] == wire[keys.JOINTS] > 80
    assert topics[f"{ROBOT}/contact_forces"] == wire[keys.CONTACTS] > 80
    assert (
        topics[f"{ROBOT}/joint_references"] <= wire[keys.CONTROL_STATE] <= topics[f"{ROBOT}/state"]
    )
    forces = {
        at.log_time: one
        for _, channel, at, one in read
        if channel.topic == f"{ROBOT}/contact_forces"
    }
    touching = [
        one for one in raw if one.key == keys.CONTACTS and CONTACTS.decode(one.payload).contacts
    ][-1]
    felt, contacts = forces[touching.robot_time_ns], CONTACTS.decode(touching.payload).contacts
    for axis, name in enumerate(("along_n", "left_n", "up_n")):
        links = [sum(c.force_l[axis] for c in contacts if c.link == link) for link in range(14)]
        assert felt[name] == pytest.approx(links)


def test_raw_only_leaves_out_what_is_for_viewers(tmp_path: Path) -> None:
    run_to_summary(tmp_path / "raw", "triplet", "--duration", "0.2", "--raw-only")
    with (tmp_path / "raw" / RECORDING_FILENAME).open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    topics = {channel.topic for channel in summary.channels.values()}
    assert keys.JOINTS in topics
    assert not {topic for topic in topics if topic.startswith("/")}


def test_the_scene_has_body_obstacles_map_forces_and_path(run: Path) -> None:
    found, record = shown(run / RECORDING_FILENAME), RunRecord.load(run)
    scene = {topic.rpartition("/")[2]: update.entities for topic, messages in found.items()
             if "/scene/" in topic for _, update in messages[-1:]}  # fmt: skip
    assert [entity.frame_id for entity in scene["body"]] == [
        link.name for link in record.description.links
    ]
    truth = scene["obstacles"][0]
    assert len(truth.cylinders) + len(truth.cubes) + len(truth.spheres) == len(
        record.placed_obstacles
    )
    assert len(scene["path"][0].lines[0].points) in {
        len(reported.path_w) for reported in record.trajectories
    }
    arrows = [
        arrow for _, update in found[f"{ROBOT}/scene/forces"] for arrow in update.entities[0].arrows
    ]
    turns = [arrow.pose.orientation for arrow in arrows]
    assert arrows
    assert all(math.hypot(q.w, q.x, q.y, q.z) == pytest.approx(1.0) for q in turns)


def test_images_come_with_their_camera(run: Path) -> None:
    found = shown(run / RECORDING_FILENAME)
    at_ns, image = found[f"{ROBOT}/head/depth/image_raw"][-1]
    pinhole = dict(found[f"{ROBOT}/head/depth/camera_info"])[at_ns]
    assert image.encoding == "16UC1"
    assert len(image.data) == image.step * image.height == 2 * image.width * image.height
    assert pinhole.width == image.width
    assert pinhole.height == image.height
    assert pinhole.K[0] == pinhole.P[0] > 0
    mount = next(t for at, one in found[f"{ROBOT}/tf"] if at == at_ns for t in one.transforms
                 if t.child_frame_id == image.frame_id)  # fmt: skip
    q = mount.rotation  # the camera looks along its z, which is nearly the link's x
    assert 2 * (q.x * q.z + q.w * q.y) > 0.9
    assert mount.parent_frame_id == "link_13"


def test_an_image_that_lacks_pixels_is_not_shown(run: Path) -> None:
    channels, key = FoxgloveConverter(ROBOT), "sensor/depth/head"
    sent = {
        one.key: one.payload
        for one in RecordingReader(run / RECORDING_FILENAME).read_messages((keys.DESCRIPTION, key))
    }
    whole = msgspec.msgpack.decode(sent[key], type=DepthImage)
    torn = msgspec.msgpack.encode(msgspec.structs.replace(whole, depth=whole.depth[:-1]))
    channels.convert(keys.DESCRIPTION, sent[keys.DESCRIPTION], 0)
    assert not channels.convert(key, torn, 0)
    assert channels.convert(key, sent[key], 10**9)


def test_state_and_log_tell_what_host_and_control_told(run: Path) -> None:
    record, logged = (
        RunRecord.load(run),
        [one for _, one in shown(run / RECORDING_FILENAME)[f"{ROBOT}/log"]],
    )
    with (run / RECORDING_FILENAME).open("rb") as file:
        read = list(make_reader(file).iter_messages(topics=[f"{ROBOT}/state"]))
    schema, channel, _ = read[0]
    assert schema is not None
    assert schema.encoding == "jsonschema"
    assert channel.message_encoding == "json"
    states = [json.loads(message.data) for *_, message in read]
    wanted = json.loads(schema.data)
    assert all(
        set(wanted["required"]) <= set(state) <= set(wanted["properties"]) for state in states
    )
    assert [one["lifecycle"] for one in states[-2:]] == ["armed", "disarmed"]
    assert states[-2]["path_s_m"] > 0
    assert {one["locomotion"] for one in states} <= {
        reported.state for reported in record.control_states
    } | {""}
    assert any(one.name == "hal" and one.message.startswith("armed: armed by") for one in logged)
    assert any(one.name == "control" and one.message.startswith("Locomoting: ") for one in logged)


def test_the_layout_shows_fields_that_a_recording_has(run: Path) -> None:
    layout, newest = json.loads(LAYOUT.read_text()), {}
    with (run / RECORDING_FILENAME).open("rb") as file:
        for _, channel, _, one in make_reader(
            file, decoder_factories=FACTORIES
        ).iter_decoded_messages():
            if channel.topic.startswith("/"):
                # As docs/how-to/foxglove.md shows.
                newest[channel.topic.replace(ROBOT, "/planar13")] = one
    panels, text = layout["configById"], json.dumps(layout["layout"])
    assert all(f'"{name}"' in text for name in panels)
    assert text.count("!") == len(panels)
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", [])]
    topics = [topic for panel in panels.values() for topic in panel.get("topics", {})]
    image = panels["Image!depth"]["imageMode"]
    topics += [
        image["imageTopic"],
        image["calibrationTopic"],
        panels["RosOut!log"]["topicToRender"],
    ]
    assert not set(topics) - set(newest)
    for path in paths:
        topic, _, fields = path.partition(".")
        at = newest[topic]
        for part in fields.split("."):
            name, _, index = part.rstrip("]").partition("[")
            at = at[name] if isinstance(at, dict) else getattr(at, name)
            at = at[int(index)] if index else at
        assert isinstance(at, (str, float)), path


def test_foxglove_unfinished_recording_has_transforms_joints_and_images(
    run: Path, tmp_path: Path
) -> None:
    """As one that was killed: test_recording.py kills one."""
    torn = tmp_path / "torn.mcap"
    recording = RecordingWriter(torn, "planar13_camera")
    for number, one in enumerate(RecordingReader(run / RECORDING_FILENAME).read_messages()):
        recording.write_arrival(
            ReceivedSample(one.key, one.payload, one.encoding, one.wall_time_ns)
        )
        if number % 100 == 0:
            recording.flush()
    found: dict[str, Any] = {}
    with torn.open("rb") as file, suppress(EndOfFile):  # the stock reader, as far as the file goes
        reader = NonSeekingReader(file, validate_crcs=True, decoder_factories=FACTORIES)
        for _, channel, _, one in reader.iter_decoded_messages(log_time_order=False):
            found[channel.topic] = one
    assert len(found[f"{ROBOT}/joint_states"].joints) == 13
    assert found[f"{ROBOT}/tf"].transforms
    assert len(found[f"{ROBOT}/head/depth/image_raw"].data) > 1000
    # For readers that want an index.
    count, lacks = recover_recording(torn, tmp_path / "whole.mcap")
    whole = shown(tmp_path / "whole.mcap")
    assert count > 500
    assert len(whole[f"{ROBOT}/tf"]) > 10
    alone = RunRecord.load(tmp_path / "whole.mcap")
    assert len(alone.time_s) > 20
    assert alone.missing == [f"recording: before it was copied: {lacks[0]}"]


def test_foxglove_reason_with_changing_number_is_logged_once() -> None:
    reported, logged = StateMessages(), []
    for k in range(20):
        control = msgspec.msgpack.encode(
            {"state": "Locomoting", "reason": f"pushes with {k + 0.5} N", "jammed": True}
        )
        logged += reported.update_state(None, control, k).new_logs
    assert [one.message for one in logged] == ["Locomoting: pushes with 0.5 N"]


def test_foxglove_state_of_silent_controller_is_not_shown_current() -> None:
    channels, robot = FoxgloveConverter("snake"), make_description()
    control = ControlState(
        tick=0, timestamp_ns=0, controller="hold", state="Locomoting", reason="pushes"
    )
    seen: list[tuple[str, list[str]]] = []
    channels.convert(keys.DESCRIPTION, encode(robot), 0)
    for time_s in (0, 4, 6, 8):
        made = channels.convert(keys.CONTROL_STATE, encode(control), 0) if time_s == 0 else []
        made += channels.convert(keys.JOINTS, encode(joint_state(robot)), time_s * 10**9)
        made += channels.convert(keys.CLOCK, b"", time_s * 10**9)
        (state,) = (
            json.loads(one.payload)["locomotion"] for one in made if one.topic == "/snake/state"
        )
        seen.append(
            (
                state,
                [Log.FromString(one.payload).message for one in made if one.topic == "/snake/log"],
            )
        )
    silent = "silent: the state of control is no longer published"
    assert seen == [
        ("Locomoting", ["Locomoting: pushes"]),
        ("Locomoting", []),
        ("", [silent]),
        ("", []),
    ]
