"""Reads the Foxglove messages of a recording with Foxglove's own library, and compares them with the run."""

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
LINK_COUNT = 14  # of this robot
LAYOUT = Path(__file__).parents[4] / "docs" / "how-to" / "foxglove-layout.json"


class JsonDecoderFactory:
    """Gives the MCAP reader a decoder for JSON, and leaves msgpack as it is."""

    def decoder_for(self, message_encoding: str, _schema: Any) -> Any:
        """Return the decoder for an encoding, as the MCAP reader requires it."""
        match message_encoding:
            case "json":
                return json.loads
            case "msgpack":
                return lambda data: data
            case _:
                return None


CONTACTS_DECODER = msgspec.msgpack.Decoder(Contacts)
DECODER_FACTORIES = [DecoderFactory(), JsonDecoderFactory()]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a simulated run with a depth camera."""
    out = tmp_path_factory.mktemp("foxglove") / "run"
    simulate(
        load_scenario(
            "triplet",
            [parse_set_option("robot=planar13_camera"), parse_set_option("duration_s=0.8")],
        ).config,
        out,
    )
    return out


def read_protobuf_messages(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Return the protobuf messages of each topic, each with its robot time in ns."""
    messages: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        camera_names = ("head/depth/image_raw", "head/depth/camera_info")
        names = ("tf", "joint_states", "joint_references", "pose", "log", *camera_names)
        topics = [f"{ROBOT}/{name}" for name in names]
        topics += [
            f"{ROBOT}/scene/{name}" for name in ("body", "obstacles", "map", "forces", "path")
        ]
        for _, channel, message, decoded in reader.iter_decoded_messages(topics=topics):
            messages.setdefault(channel.topic, []).append((message.log_time, decoded))
    assert sorted(messages) == sorted(topics)
    return messages


def compute_world_frames(transforms: Any) -> tuple[Any, Any]:
    """Chain transforms, each of which is relative to the frame before it.

    Returns:
        The origins of all frames in the world, (n, 3), and the x axis of the last frame, (3,).
    """
    origin = np.zeros(3)
    rotation = np.eye(3)
    origins: list[Any] = []
    for transform in transforms:
        step = transform.translation
        q = transform.rotation
        origin = origin + rotation @ (step.x, step.y, step.z)
        rotation = rotation @ rotation_from_quaternion((q.w, q.x, q.y, q.z))
        origins.append(origin)
    return np.array(origins), rotation[:, 0]


def test_foxglove_transforms_and_joints_equal_those_of_the_run(run: Path) -> None:
    messages = read_protobuf_messages(run / RECORDING_FILENAME)
    record = RunRecord.load(run)
    body_updates = [
        (time_ns, update)
        for time_ns, update in messages[f"{ROBOT}/tf"]
        if len(update.transforms) > 1
    ]
    time_ns, update = body_updates[-1]
    row = record.find_nearest_row(time_ns * 1e-9)
    nodes = record.find_body_points_w(row)
    assert nodes is not None
    assert len(update.transforms) == len(record.description.links)
    parents = ["world", *(link.name for link in record.description.links[:-1])]
    assert [transform.parent_frame_id for transform in update.transforms] == parents
    origins, head_direction = compute_world_frames(update.transforms)
    assert np.allclose(origins, nodes[:-1], atol=1e-9)
    expected_direction = (nodes[-1] - nodes[-2]) / record.description.links[-1].length_m
    assert np.allclose(head_direction, expected_direction, atol=1e-6)
    states = dict(messages[f"{ROBOT}/joint_states"])[time_ns]
    assert [joint.position for joint in states.joints] == record.angle_rad[row].tolist()
    assert [joint.name for joint in states.joints] == [
        joint.name for joint in record.description.joints
    ]


def test_foxglove_joint_states_equal_reference_encoder_to_the_byte() -> None:
    robot = make_description()
    time_ns = 1_234_567_890_123
    names = [joint.name for joint in robot.joints]
    encoder = BodyMessageEncoder(robot)
    for angles_rad, speed, torque in (
        ([0.1, -0.2, 3.0], 0.5, -1e-300),
        ([1.0, 2.0, 3.0], 4.0, 0.0),
    ):
        joints = joint_state(robot, angles_rad, speed, torque)
        rows = zip(names, joints.angle_rad, joints.velocity_rad_s, joints.torque_nm, strict=True)
        measured = [
            NamedJoint(name=name, position=angle, velocity=velocity, effort=effort)
            for name, angle, velocity, effort in rows
        ]
        requested = [
            NamedJoint(name=name, position=angle)
            for name, angle in zip(names, angles_rad, strict=True)
        ]
        timestamp = shapes.make_timestamp(time_ns)
        states = JointStates(timestamp=timestamp, joints=measured)
        references = JointStates(timestamp=timestamp, joints=requested)
        assert encoder.encode_joint_states(joints, time_ns) == states.SerializeToString()
        assert encoder.encode_references(angles_rad, time_ns) == references.SerializeToString()


def test_foxglove_joints_forces_and_state_keep_robot_rates(run: Path) -> None:
    raw = list(RecordingReader(run / RECORDING_FILENAME).read_messages())
    raw_counts = Counter(message.key for message in raw)
    with (run / RECORDING_FILENAME).open("rb") as file:
        reader = make_reader(file, decoder_factories=DECODER_FACTORIES)
        decoded_messages = list(reader.iter_decoded_messages())
    topic_counts = Counter(channel.topic for _, channel, *_ in decoded_messages)
    assert topic_counts[f"{ROBOT}/joint_states"] == raw_counts[keys.JOINTS] > 80
    assert topic_counts[f"{ROBOT}/contact_forces"] == raw_counts[keys.CONTACTS] > 80
    assert (
        topic_counts[f"{ROBOT}/joint_references"]
        <= raw_counts[keys.CONTROL_STATE]
        <= topic_counts[f"{ROBOT}/state"]
    )
    forces_by_time_ns = {
        message.log_time: decoded
        for _, channel, message, decoded in decoded_messages
        if channel.topic == f"{ROBOT}/contact_forces"
    }
    last_contact_message = [
        message
        for message in raw
        if message.key == keys.CONTACTS and CONTACTS_DECODER.decode(message.payload).contacts
    ][-1]
    forces = forces_by_time_ns[last_contact_message.robot_time_ns]
    contacts = CONTACTS_DECODER.decode(last_contact_message.payload).contacts
    for axis, name in enumerate(("along_n", "left_n", "up_n")):
        link_forces_n = [
            sum(contact.force_l[axis] for contact in contacts if contact.link == link)
            for link in range(LINK_COUNT)
        ]
        assert forces[name] == pytest.approx(link_forces_n)


def test_recording_with_raw_only_has_no_messages_for_viewers(tmp_path: Path) -> None:
    run_to_summary(tmp_path / "raw", "triplet", "--duration", "0.2", "--raw-only")
    with (tmp_path / "raw" / RECORDING_FILENAME).open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    topics = {channel.topic for channel in summary.channels.values()}
    assert keys.JOINTS in topics
    assert not {topic for topic in topics if topic.startswith("/")}


def test_foxglove_scene_has_body_obstacles_map_forces_and_path(run: Path) -> None:
    messages = read_protobuf_messages(run / RECORDING_FILENAME)
    record = RunRecord.load(run)
    scene: dict[str, Any] = {}
    for topic, updates in messages.items():
        if "/scene/" in topic:
            _, last_update = updates[-1]
            scene[topic.rpartition("/")[2]] = last_update.entities
    assert [entity.frame_id for entity in scene["body"]] == [
        link.name for link in record.description.links
    ]
    obstacles = scene["obstacles"][0]
    assert len(obstacles.cylinders) + len(obstacles.cubes) + len(obstacles.spheres) == len(
        record.placed_obstacles
    )
    assert len(scene["path"][0].lines[0].points) in {
        len(reported.path_w) for reported in record.trajectories
    }
    arrows = [
        arrow
        for _, update in messages[f"{ROBOT}/scene/forces"]
        for arrow in update.entities[0].arrows
    ]
    orientations = [arrow.pose.orientation for arrow in arrows]
    assert arrows
    assert all(math.hypot(q.w, q.x, q.y, q.z) == pytest.approx(1.0) for q in orientations)


def test_foxglove_image_has_camera_info_and_camera_frame(run: Path) -> None:
    messages = read_protobuf_messages(run / RECORDING_FILENAME)
    time_ns, image = messages[f"{ROBOT}/head/depth/image_raw"][-1]
    camera_info = dict(messages[f"{ROBOT}/head/depth/camera_info"])[time_ns]
    assert image.encoding == "16UC1"
    assert len(image.data) == image.step * image.height == 2 * image.width * image.height
    assert camera_info.width == image.width
    assert camera_info.height == image.height
    assert camera_info.K[0] == camera_info.P[0] > 0
    camera_mounting = next(
        transform
        for update_time_ns, update in messages[f"{ROBOT}/tf"]
        if update_time_ns == time_ns
        for transform in update.transforms
        if transform.child_frame_id == image.frame_id
    )
    q = camera_mounting.rotation  # the camera's z axis is nearly the link's x axis
    assert 2 * (q.x * q.z + q.w * q.y) > 0.9
    assert camera_mounting.parent_frame_id == "link_13"


def test_foxglove_image_with_missing_pixels_is_not_converted(run: Path) -> None:
    converter = FoxgloveConverter(ROBOT)
    key = "sensor/depth/head"
    reader = RecordingReader(run / RECORDING_FILENAME)
    payloads = {
        message.key: message.payload for message in reader.read_messages((keys.DESCRIPTION, key))
    }
    image = msgspec.msgpack.decode(payloads[key], type=DepthImage)
    short_image = msgspec.structs.replace(image, depth=image.depth[:-1])
    converter.convert(keys.DESCRIPTION, payloads[keys.DESCRIPTION], 0)
    assert not converter.convert(key, msgspec.msgpack.encode(short_image), 0)
    assert converter.convert(key, payloads[key], 10**9)


def test_foxglove_state_and_log_match_host_and_controller(run: Path) -> None:
    record = RunRecord.load(run)
    messages = read_protobuf_messages(run / RECORDING_FILENAME)
    log_entries = [entry for _, entry in messages[f"{ROBOT}/log"]]
    with (run / RECORDING_FILENAME).open("rb") as file:
        state_messages = list(make_reader(file).iter_messages(topics=[f"{ROBOT}/state"]))
    schema, channel, _ = state_messages[0]
    assert schema is not None
    assert schema.encoding == "jsonschema"
    assert channel.message_encoding == "json"
    states = [json.loads(message.data) for *_, message in state_messages]
    json_schema = json.loads(schema.data)
    assert all(
        set(json_schema["required"]) <= set(state) <= set(json_schema["properties"])
        for state in states
    )
    assert [state["lifecycle"] for state in states[-2:]] == ["armed", "disarmed"]
    assert states[-2]["path_s_m"] > 0
    assert {state["locomotion"] for state in states} <= {
        reported.state for reported in record.control_states
    } | {""}
    assert any(
        entry.name == "hal" and entry.message.startswith("armed: armed by") for entry in log_entries
    )
    assert any(
        entry.name == "control" and entry.message.startswith("Locomoting: ")
        for entry in log_entries
    )


def test_foxglove_layout_contains_only_fields_of_recordings(run: Path) -> None:
    layout = json.loads(LAYOUT.read_text())
    newest_by_topic: dict[str, Any] = {}
    with (run / RECORDING_FILENAME).open("rb") as file:
        reader = make_reader(file, decoder_factories=DECODER_FACTORIES)
        for _, channel, _, decoded in reader.iter_decoded_messages():
            if channel.topic.startswith("/"):
                # The layout is for the robot of docs/how-to/foxglove.md.
                newest_by_topic[channel.topic.replace(ROBOT, "/planar13")] = decoded
    panels = layout["configById"]
    arrangement = json.dumps(layout["layout"])
    assert all(f'"{name}"' in arrangement for name in panels)
    assert arrangement.count("!") == len(panels)
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", [])]
    topics = [topic for panel in panels.values() for topic in panel.get("topics", {})]
    image = panels["Image!depth"]["imageMode"]
    topics += [
        image["imageTopic"],
        image["calibrationTopic"],
        panels["RosOut!log"]["topicToRender"],
    ]
    assert not set(topics) - set(newest_by_topic)
    for path in paths:
        topic, _, fields = path.partition(".")
        value = newest_by_topic[topic]
        for field in fields.split("."):
            name, _, index = field.rstrip("]").partition("[")
            value = value[name] if isinstance(value, dict) else getattr(value, name)
            value = value[int(index)] if index else value
        assert isinstance(value, (str, float)), path


def test_foxglove_unfinished_recording_has_transforms_joints_and_images(
    run: Path, tmp_path: Path
) -> None:
    """A killed recorder leaves such a file; test_recording.py kills a real one."""
    unfinished = tmp_path / "unfinished.mcap"
    writer = RecordingWriter(unfinished, "planar13_camera")
    for number, message in enumerate(RecordingReader(run / RECORDING_FILENAME).read_messages()):
        writer.write_arrival(
            ReceivedSample(message.key, message.payload, message.encoding, message.wall_time_ns)
        )
        if number % 100 == 0:
            writer.flush()
    newest_by_topic: dict[str, Any] = {}
    with unfinished.open("rb") as file, suppress(EndOfFile):  # Foxglove's reader stops at the end
        reader = NonSeekingReader(file, validate_crcs=True, decoder_factories=DECODER_FACTORIES)
        for _, channel, _, decoded in reader.iter_decoded_messages(log_time_order=False):
            newest_by_topic[channel.topic] = decoded
    assert len(newest_by_topic[f"{ROBOT}/joint_states"].joints) == 13
    assert newest_by_topic[f"{ROBOT}/tf"].transforms
    assert len(newest_by_topic[f"{ROBOT}/head/depth/image_raw"].data) > 1000
    # Readers that need an index can read the recovered copy.
    recovered_path = tmp_path / "recovered.mcap"
    count, missing = recover_recording(unfinished, recovered_path)
    recovered = read_protobuf_messages(recovered_path)
    assert count > 500
    assert len(recovered[f"{ROBOT}/tf"]) > 10
    record = RunRecord.load(recovered_path)
    assert len(record.time_s) > 20
    assert record.missing == [f"recording: before it was copied: {missing[0]}"]


def test_foxglove_reason_with_changing_number_is_logged_once() -> None:
    state_messages = StateMessages()
    log_entries: list[Any] = []
    for time_ns in range(20):
        control_state = msgspec.msgpack.encode(
            {"state": "Locomoting", "reason": f"pushes with {time_ns + 0.5} N", "jammed": True}
        )
        log_entries += state_messages.update_state(None, control_state, time_ns).new_logs
    assert [entry.message for entry in log_entries] == ["Locomoting: pushes with 0.5 N"]


def test_foxglove_state_of_silent_controller_is_not_shown_current() -> None:
    converter = FoxgloveConverter("snake")
    robot = make_description()
    control_state = ControlState(
        tick=0, timestamp_ns=0, controller="hold", state="Locomoting", reason="pushes"
    )
    states_and_logs: list[tuple[str, list[str]]] = []
    converter.convert(keys.DESCRIPTION, encode(robot), 0)
    for time_s in (0, 4, 6, 8):
        converted: list[Any] = []
        if time_s == 0:
            converted += converter.convert(keys.CONTROL_STATE, encode(control_state), 0)
        converted += converter.convert(keys.JOINTS, encode(joint_state(robot)), time_s * 10**9)
        converted += converter.convert(keys.CLOCK, b"", time_s * 10**9)
        (state,) = (
            json.loads(message.payload)["locomotion"]
            for message in converted
            if message.topic == "/snake/state"
        )
        log_texts = [
            Log.FromString(message.payload).message
            for message in converted
            if message.topic == "/snake/log"
        ]
        states_and_logs.append((state, log_texts))
    silence_text = "silent: the state of control is no longer published"
    assert states_and_logs == [
        ("Locomoting", ["Locomoting: pushes"]),
        ("Locomoting", []),
        ("", [silence_text]),
        ("", []),
    ]
