"""The record of a run is read from its recording alone, described by `recording info`, and exported."""

import csv
import json
from pathlib import Path

import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoder

from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.wire import keys
from snakesim_operator.recording.mcap_format.decoder import DecoderFactory
from snakesim_operator.recording.message import RECORDING_FILENAME
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.recording.writer import RecordingWriter
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.run.in_process import simulate
from snakesim_testing.runs.in_process_command import snakesim


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("recorded") / "run"
    simulate(load_scenario("clutter", [parse_set_option("duration_s=2")]).config, out)
    return out


@pytest.mark.heavy
def test_recordings_alone_contain_the_record_of_the_black_box(run: Path) -> None:
    with_black_box = RunRecord.load(run)
    recording_alone = RunRecord.load(run / RECORDING_FILENAME)
    arrays = {
        name: value for name, value in vars(with_black_box).items() if isinstance(value, np.ndarray)
    }
    assert len(arrays) > 8
    assert len(with_black_box.time_s) == 200
    for name, value in arrays.items():
        assert np.array_equal(value, getattr(recording_alone, name), equal_nan=True), name
    assert recording_alone.host.command_digest == with_black_box.host.command_digest
    assert recording_alone.config == with_black_box.config
    assert recording_alone.control_states == with_black_box.control_states
    assert recording_alone.worlds == with_black_box.worlds
    assert recording_alone.trajectories == with_black_box.trajectories
    assert recording_alone.missing == []
    assert with_black_box.missing == []


def test_recordings_without_black_box_keep_numbers_of_host(run: Path, tmp_path: Path) -> None:
    content = (run / RECORDING_FILENAME).read_bytes()
    host = RunRecord.load(run).host
    (tmp_path / RECORDING_FILENAME).write_bytes(content[: len(content) * 2 // 3])
    record = RunRecord.load(tmp_path, host)
    assert 0 < len(record.time_s) < 200
    assert record.host.command_digest == host.command_digest
    assert f"{200 - len(record.time_s)} of 200 ticks are missing in the black box" in record.missing


def test_recordings_report_ticks_that_never_reached_the_recorder(run: Path, tmp_path: Path) -> None:
    for file in run.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / RECORDING_FILENAME).unlink()
    recording = RecordingWriter(tmp_path / RECORDING_FILENAME)
    for message in RecordingReader(run / RECORDING_FILENAME).read_messages():
        if not 0.5e9 < message.robot_time_ns < 1.5e9:
            recording.write_arrival(
                ReceivedSample(message.key, message.payload, message.encoding, message.wall_time_ns)
            )
    recording.close({})
    # The recording itself does not show that ticks are missing.
    assert RunRecord.load(tmp_path / RECORDING_FILENAME).missing == []
    result = snakesim("recording", "report", ".", cwd=tmp_path)
    sentence = "recording: 99 of 200 ticks did not reach the recorder; the last one that it received is of "
    assert result.code == 3, result.err
    assert sentence in result.err
    assert sentence in (tmp_path / "report.html").read_text()


def test_recordings_info_lists_contents_and_missing_parts(run: Path, tmp_path: Path) -> None:
    result = snakesim("recording", "info", str(run), "--json", cwd=tmp_path)
    info = json.loads(result.out)
    assert result.code == 0
    assert info["finished"]
    assert info["duration_s"] == pytest.approx(2.0)
    assert info["robot"] == "planar13_camera"
    assert info["scenario"] == "clutter"
    assert info["ticks"] == 200
    assert info["command_digest"] == RunRecord.load(run).host.command_digest
    assert info["keys"]["sensor/joints"]["rate_hz"] == pytest.approx(100.0)
    assert "sensor/depth/head" in info["keys"]
    content = (run / RECORDING_FILENAME).read_bytes()
    (tmp_path / "truncated.mcap").write_bytes(content[: len(content) * 2 // 3])
    result = snakesim("recording", "info", "truncated.mcap", cwd=tmp_path)
    assert result.code == 3
    assert "missing: its end: it breaks off at " in result.out


def test_recordings_export_contains_the_record(run: Path, tmp_path: Path) -> None:
    record = RunRecord.load(run)
    for form in ("npz", "csv", "mcap"):
        result = snakesim(
            "recording", "export", str(run), "--format", form, "--out", f"a.{form}", cwd=tmp_path
        )
        assert result.code == 0, result.err
    with np.load(tmp_path / "a.npz") as arrays:
        assert np.array_equal(arrays["angle_rad"], record.angle_rad)
        assert arrays["joints"][0] == "joint_1"
    with (tmp_path / "a.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["target.joint_3"]) for row in rows] == record.target[:, 2].tolist()
    assert [float(row["position_w_m.y"]) for row in rows] == record.position_w_m[:, 1].tolist()
    assert np.array_equal(RunRecord.load(tmp_path / "a.mcap").angle_rad, record.angle_rad)
    repeated = snakesim(
        "recording", "export", str(run), "--format", "csv", "--out", "a.csv", cwd=tmp_path
    )
    assert repeated.code == 2
    assert "there is such a file already" in repeated.err


def test_recordings_of_several_runs_are_exported_as_dataset(run: Path, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra `report`")
    record = RunRecord.load(run)
    result = snakesim(
        "recording",
        "export",
        str(run),
        str(run),
        "--format",
        "lerobot",
        "--out",
        "set",
        cwd=tmp_path,
    )
    assert result.code == 0, result.err
    assert "2 episodes, 400 frames" in result.out
    info = json.loads((tmp_path / "set" / "meta" / "info.json").read_text())
    expected = {"codebase_version": "v3.0", "fps": 100, "total_frames": 400, "total_episodes": 2}
    assert info.items() >= expected.items(), info
    frames_each = 200
    first, second = parquet.read_table(
        tmp_path / "set/meta/episodes/chunk-000/file-000.parquet"
    ).to_pylist()
    assert first["dataset_from_index"] == 0
    assert first["dataset_to_index"] == frames_each
    assert second["dataset_from_index"] == frames_each
    assert second["tasks"] == ["clutter"]
    assert second["length"] == frames_each
    assert second["stats/index/min"] == [frames_each]
    data_path = info["data_path"].format(
        chunk_index=second["data/chunk_index"], file_index=second["data/file_index"]
    )
    frames = parquet.read_table(tmp_path / "set" / data_path).to_pydict()
    assert sorted(frames) == sorted(info["features"])
    assert frames["index"] == list(range(frames_each, 2 * frames_each))
    state = np.array(frames["observation.state"])
    state_feature = info["features"]["observation.state"]
    assert state_feature["shape"] == [state.shape[1]]
    column = state_feature["names"].index("angle_rad.joint_5")
    assert np.allclose(state[:, column], record.angle_rad[:, 4], atol=1e-6)
    assert frames["timestamp"][1] == pytest.approx(0.01)
    stats = json.loads((tmp_path / "set" / "meta" / "stats.json").read_text())
    assert sorted(stats) == sorted(info["features"])
    assert stats["action"]["count"] == [400]
    assert np.allclose(stats["observation.state"]["q50"], np.median(state, axis=0), atol=1e-5)
    # pandas uses the task names as the index of the table.
    tasks = parquet.read_table(tmp_path / "set/meta/tasks.parquet")
    assert tasks.to_pydict() == {"task_index": [0], "__index_level_0__": ["clutter"]}
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["__index_level_0__"]


@pytest.mark.parametrize("command", ["info", "report"])
def test_recordings_command_names_file_that_is_no_recording(tmp_path: Path, command: str) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    assert (
        "notes.txt is not a recording"
        in snakesim("recording", command, "notes.txt", cwd=tmp_path).err
    )
    assert "gone" in snakesim("recording", command, "gone", cwd=tmp_path).err


def test_recordings_are_decoded_by_mcap_library_with_field_names(run: Path) -> None:
    """The recording also contains messages for Foxglove; each type has its own decoder."""
    with (run / RECORDING_FILENAME).open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory(), ProtobufDecoder()])
        decoded = [
            (channel.topic, message) for _, channel, _, message in reader.iter_decoded_messages()
        ]
    angles = {message.tick: message.angle_rad for topic, message in decoded if topic == keys.JOINTS}
    assert np.array_equal([angles[tick] for tick in range(200)], RunRecord.load(run).angle_rad)
    assert {"/planar13_camera/joint_states", keys.CLOCK} <= {topic for topic, _ in decoded}


def test_recordings_with_later_message_version_are_decoded_as_stored() -> None:
    decode = DecoderFactory().decoder_for(
        "msgpack", Schema(id=1, name="snakesim.Whisker", encoding="jsonschema", data=b"{}")
    )
    assert decode is not None
    assert decode(msgspec.msgpack.encode({"bend_rad": 0.1})) == {"bend_rad": 0.1}
    assert DecoderFactory().decoder_for("msgpack", None) is None
