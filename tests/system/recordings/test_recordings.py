"""The recording of a run: the record that is made of it alone, and what `snakesim recording info` tells of it."""

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


def test_the_recording_alone_has_the_record_of_the_black_box(run: Path) -> None:
    whole, alone = RunRecord.load(run), RunRecord.load(run / RECORDING_FILENAME)
    arrays = {name: value for name, value in vars(whole).items() if isinstance(value, np.ndarray)}
    assert len(arrays) > 8
    assert len(whole.time_s) == 200
    for name, value in arrays.items():
        assert np.array_equal(value, getattr(alone, name), equal_nan=True), name
    assert alone.host.command_digest == whole.host.command_digest
    assert alone.config == whole.config
    assert alone.control_states == whole.control_states
    assert alone.worlds == whole.worlds
    assert alone.trajectories == whole.trajectories
    assert alone.missing == whole.missing == []


def test_recordings_without_black_box_keep_numbers_of_host(run: Path, tmp_path: Path) -> None:
    content, host = (run / RECORDING_FILENAME).read_bytes(), RunRecord.load(run).host
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
    # Nothing in the file itself tells.
    assert RunRecord.load(tmp_path / RECORDING_FILENAME).missing == []
    ended = snakesim("recording", "report", ".", cwd=tmp_path)
    said = "recording: 99 of 200 ticks did not reach the recorder; the last that came is of "
    assert (
        ended.code == 3 and said in ended.err and said in (tmp_path / "report.html").read_text()
    ), ended.err


def test_info_tells_what_is_in_it_and_what_is_missing(run: Path, tmp_path: Path) -> None:
    ended = snakesim("recording", "info", str(run), "--json", cwd=tmp_path)
    info = json.loads(ended.out)
    assert ended.code == 0
    assert info["finished"]
    assert info["duration_s"] == pytest.approx(2.0)
    assert info["robot"] == "planar13_camera"
    assert info["scenario"] == "clutter"
    assert info["ticks"] == 200
    assert info["command_digest"] == RunRecord.load(run).host.command_digest
    assert info["keys"]["sensor/joints"]["rate_hz"] == pytest.approx(100.0)
    assert "sensor/depth/head" in info["keys"]
    content = (run / RECORDING_FILENAME).read_bytes()
    (tmp_path / "torn.mcap").write_bytes(content[: len(content) * 2 // 3])
    result = snakesim("recording", "info", "torn.mcap", cwd=tmp_path)
    assert result.code == 3
    assert "missing: its end: it breaks off at " in result.out


def test_what_is_exported_is_the_record(run: Path, tmp_path: Path) -> None:
    record = RunRecord.load(run)
    for form in ("npz", "csv", "mcap"):
        ended = snakesim(
            "recording", "export", str(run), "--format", form, "--out", f"a.{form}", cwd=tmp_path
        )
        assert ended.code == 0, ended.err
    with np.load(tmp_path / "a.npz") as arrays:
        assert np.array_equal(arrays["angle_rad"], record.angle_rad)
        assert arrays["joints"][0] == "joint_1"
    with (tmp_path / "a.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["target.joint_3"]) for row in rows] == record.target[:, 2].tolist()
    assert [float(row["position_w_m.y"]) for row in rows] == record.position_w_m[:, 1].tolist()
    assert np.array_equal(RunRecord.load(tmp_path / "a.mcap").angle_rad, record.angle_rad)
    again = snakesim(
        "recording", "export", str(run), "--format", "csv", "--out", "a.csv", cwd=tmp_path
    )
    assert again.code == 2
    assert "there is such a file already" in again.err


def test_several_runs_make_a_dataset(run: Path, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra `report`")
    record = RunRecord.load(run)
    ended = snakesim(
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
    assert ended.code == 0 and "2 episodes, 400 frames" in ended.out, ended.err
    info = json.loads((tmp_path / "set" / "meta" / "info.json").read_text())
    wanted = {"codebase_version": "v3.0", "fps": 100, "total_frames": 400, "total_episodes": 2}
    assert info.items() >= wanted.items(), info
    n = 200
    episode, second = parquet.read_table(
        tmp_path / "set/meta/episodes/chunk-000/file-000.parquet"
    ).to_pylist()
    assert [episode[f"dataset_{end}_index"] for end in ("from", "to")] == [0, n]
    assert second["dataset_from_index"] == n
    assert second["tasks"] == ["clutter"]
    assert second["length"] == n
    assert second["stats/index/min"] == [n]
    at = {"chunk_index": second["data/chunk_index"], "file_index": second["data/file_index"]}
    rows = parquet.read_table(tmp_path / "set" / info["data_path"].format(**at)).to_pydict()
    assert sorted(rows) == sorted(info["features"])
    assert rows["index"] == list(range(n, 2 * n))
    state, names = (
        np.array(rows["observation.state"]),
        info["features"]["observation.state"]["names"],
    )
    assert info["features"]["observation.state"]["shape"] == [state.shape[1]]
    assert np.allclose(
        state[:, names.index("angle_rad.joint_5")], record.angle_rad[:, 4], atol=1e-6
    )
    assert rows["timestamp"][1] == pytest.approx(0.01)
    stats = json.loads((tmp_path / "set" / "meta" / "stats.json").read_text())
    assert sorted(stats) == sorted(info["features"])
    assert stats["action"]["count"] == [400]
    assert np.allclose(stats["observation.state"]["q50"], np.median(state, axis=0), atol=1e-5)
    # Pandas reads the names as the index.
    tasks = parquet.read_table(tmp_path / "set/meta/tasks.parquet")
    assert tasks.to_pydict() == {"task_index": [0], "__index_level_0__": ["clutter"]}
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["__index_level_0__"]


@pytest.mark.parametrize("command", ["info", "report"])
def test_what_is_no_recording_is_named(tmp_path: Path, command: str) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    assert (
        "notes.txt is not a recording"
        in snakesim("recording", command, "notes.txt", cwd=tmp_path).err
    )
    assert "gone" in snakesim("recording", command, "gone", cwd=tmp_path).err


def test_a_stock_reader_gets_our_messages_by_their_fields(run: Path) -> None:
    """Beside Foxglove's, each by its own decoder."""
    with (run / RECORDING_FILENAME).open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory(), ProtobufDecoder()])
        decoded = [
            (channel.topic, message) for _, channel, _, message in reader.iter_decoded_messages()
        ]
    angles = {message.tick: message.angle_rad for topic, message in decoded if topic == keys.JOINTS}
    assert np.array_equal([angles[tick] for tick in range(200)], RunRecord.load(run).angle_rad)
    assert {"/planar13_camera/joint_states", keys.CLOCK} <= {topic for topic, _ in decoded}


def test_recordings_with_later_message_version_are_decoded_as_stored() -> None:
    later = DecoderFactory().decoder_for(
        "msgpack", Schema(id=1, name="snakesim.Whisker", encoding="jsonschema", data=b"{}")
    )
    assert later is not None
    assert later(msgspec.msgpack.encode({"bend_rad": 0.1})) == {"bend_rad": 0.1}
    assert DecoderFactory().decoder_for("msgpack", None) is None
