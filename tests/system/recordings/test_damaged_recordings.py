"""Every command reads a damaged recording behind the damage, reports what is lost, and ends with exit code 3."""

import csv
import dataclasses
import json
import struct
from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from snakesim_hal.wire import keys
from snakesim_operator.playback import video
from snakesim_operator.playback.episodes import read_episodes
from snakesim_operator.playback.export import write_parquet
from snakesim_operator.playback.lerobot import write_lerobot
from snakesim_operator.playback.pictures import CameraImages
from snakesim_operator.recording.message import RECORDING_FILENAME
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.summary import summarize_run
from snakesim_testing.operator.damaged_recordings import (
    RecordSpan,
    flip_bit,
    list_chunks,
    list_records,
    make_chunk_record,
    record_short_run,
    write_file,
)
from snakesim_testing.runs.command import CompletedRun
from snakesim_testing.runs.in_process_command import snakesim

INCOMPLETE = 3  # exit code of a command that has read an incomplete recording
GAP_NS = 20_000_000  # between two clock messages that follow each other in time, which are 10 ms apart without a gap
MIN_MESSAGE_COUNT = 500  # of a recording with one damaged chunk: the others were read

# Bytes of a chunk record, counted from its start: opcode (1), length of the record (8), times of the first and the last
# message (8 each), length (8) and checksum (4) of the unpacked data, name of the compression (4 + "zstd"), length of
# the packed data (8), packed data.
DAMAGED_BYTES: dict[str, Callable[[RecordSpan], int]] = {
    "opcode": lambda chunk: chunk.begin,
    "length of the record": lambda chunk: chunk.begin + 2,
    "name of the compression": lambda chunk: chunk.begin + 41,
    "length of the data": lambda chunk: chunk.begin + 45,
    "data": lambda chunk: chunk.end - 5,
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Provide the folder of a short run."""
    folder = tmp_path_factory.mktemp("recorded") / "run"
    return record_short_run(folder, duration_s=1.5, chunk_bytes=100_000)


@pytest.fixture(scope="module")
def intact(run: Path) -> bytes:
    """Provide the content of the undamaged recording of the run."""
    content = (run / RECORDING_FILENAME).read_bytes()
    assert len(list_chunks(content)) >= 5, "the tests damage chunks in the middle"
    return content


def count_lost_messages(intact_path: Path, damaged_path: Path) -> Counter[str]:
    """Count, for each key, the messages of the intact recording that the damaged one does not contain."""
    intact_counts = Counter(m.key for m in RecordingReader(intact_path).read_messages())
    damaged_counts = Counter(m.key for m in RecordingReader(damaged_path).read_messages())
    return intact_counts - damaged_counts


def get_reported_losses(reader: RecordingReader) -> dict[str, int]:
    """Return, for each key of the robot, how many messages the reader reports as lost."""
    return {
        key: count
        for key, count in reader.losses.lost_by_key.items()
        if not key.startswith("/")  # messages for Foxglove
    }


def write_truncated(path: Path, intact: bytes) -> Path:
    """Write the first half of the recording, as a computer leaves it that lost its supply."""
    return write_file(path, intact[: len(intact) // 2])


def write_with_damaged_chunk(path: Path, intact: bytes, index: int) -> Path:
    """Write the recording with one flipped bit in the middle of this chunk."""
    chunk = list_chunks(intact)[index]
    return write_file(path, flip_bit(intact, (chunk.begin + chunk.end) // 2))


@pytest.mark.heavy
def test_damaged_bit_costs_one_chunk_counted_by_time_and_key(
    run: Path, intact: bytes, tmp_path: Path
) -> None:
    path = write_with_damaged_chunk(tmp_path / "a.mcap", intact, 2)

    reader = RecordingReader(path)
    messages = list(reader.read_messages())

    # The damage costs one chunk: its messages are counted by key, and the reader continues with the next chunk.
    lost_counts = count_lost_messages(run / RECORDING_FILENAME, path)
    assert lost_counts[keys.JOINTS] >= 2
    assert len(messages) > MIN_MESSAGE_COUNT
    assert get_reported_losses(reader) == lost_counts
    assert reader.is_complete
    assert len(list_chunks(intact)) > 3, "there is a chunk behind the damaged one"

    # The reported gap in time is the gap in the messages.
    (gap,) = [gap for gap in reader.losses.gaps if gap.lost]
    clock_times_ns = [m.robot_time_ns for m in messages if m.key == keys.CLOCK]
    last_before_ns, first_after_ns = next(
        (a, b) for a, b in pairwise(clock_times_ns) if b - a > GAP_NS
    )
    assert gap.end_ns is not None
    assert last_before_ns <= gap.begin_ns < gap.end_ns <= first_after_ns


@pytest.mark.slow
@pytest.mark.parametrize("part", DAMAGED_BYTES)
def test_damage_in_any_chunk_costs_only_reported_messages(
    run: Path, intact: bytes, tmp_path: Path, part: str
) -> None:
    """Wherever one bit is flipped, the reader continues behind it, and reports exactly the messages that it lost."""
    find_damaged_byte = DAMAGED_BYTES[part]
    for number, chunk in enumerate(list_chunks(intact)):
        path = write_file(tmp_path / "a.mcap", flip_bit(intact, find_damaged_byte(chunk)))

        reader = RecordingReader(path)
        messages = list(reader.read_messages())

        damage = f"chunk {number}, {part}; the reader reports {reader.missing}"
        assert messages, f"no message was read: {damage}"
        assert reader.is_complete, f"the end of the recording was not found: {damage}"
        lost_counts = count_lost_messages(run / RECORDING_FILENAME, path)
        assert get_reported_losses(reader) == lost_counts, f"wrong counts: {damage}"


def list_error_lines(result: CompletedRun) -> list[str]:
    """Return the printed errors, without the warnings that a busy computer causes."""
    return [line for line in result.err.splitlines() if "update() took" not in line]


COMMANDS = [
    ["recording", "info", "a.mcap"],
    ["recording", "report", "a.mcap"],
    ["study", "compare", "whole.mcap", "a.mcap"],
    ["study", "compare", "a.mcap", "whole.mcap", "--json"],
    ["recording", "export", "a.mcap", "--format", "csv", "--out", "a.csv"],
    ["recording", "export", "a.mcap", "--format", "npz", "--out", "a.npz"],
    ["recording", "export", "a.mcap", "--format", "mcap", "--out", "copy.mcap"],
    ["replay", "a.mcap", "--control"],
]


@pytest.mark.parametrize(
    ("command", "damage"),
    [
        *((command, "bit flipped") for command in COMMANDS),
        (COMMANDS[0], "truncated"),
        (COMMANDS[0], "chunk removed"),
    ],
)
def test_command_reports_damaged_recording_and_ends_with_code_3(
    intact: bytes, tmp_path: Path, command: list[str], damage: str
) -> None:
    second = list_chunks(intact)[1]
    damaged = {
        "bit flipped": flip_bit(intact, (second.begin + second.end) // 2),
        "truncated": intact[: len(intact) // 2],
        "chunk removed": intact[: second.begin] + intact[second.end :],
    }[damage]
    write_file(tmp_path / "whole.mcap", intact)
    write_file(tmp_path / "a.mcap", damaged)

    result = snakesim(*command, cwd=tmp_path)

    assert result.code == INCOMPLETE, result
    errors = list_error_lines(result)
    assert len(errors) == 1, errors
    assert errors[0].startswith("snakesim: a.mcap is incomplete: ")
    assert ("breaks off at" if damage == "truncated" else "actuator/joints") in result.err
    if "--json" in command:
        assert json.loads(result.out)["missing"]["a"]
        assert not json.loads(result.out)["missing"]["b"]


@pytest.mark.slow
def test_undamaged_recording_is_not_reported_and_names_its_command(
    intact: bytes, tmp_path: Path
) -> None:
    for name in ("whole.mcap", "a.mcap"):
        write_file(tmp_path / name, intact)

    for command in COMMANDS:
        result = snakesim(*command, cwd=tmp_path)
        assert result.code == 0, result
        assert not list_error_lines(result), result

    page = (tmp_path / "a.html").read_text()
    assert "The run ended early" not in page
    assert "The record is incomplete" not in page
    # The command that repeats the run names a file that the reader can create.
    assert "snakesim run config.json --backend sim" in page
    assert "a.mcap/config.json" not in page
    assert "Save the effective configuration below as <code>config.json</code>" in page


def test_damaged_recording_copy_keeps_intact_parts_and_lists_gaps(
    run: Path, intact: bytes, tmp_path: Path
) -> None:
    write_with_damaged_chunk(tmp_path / "a.mcap", intact, 0)
    message_count = len(list(RecordingReader(tmp_path / "a.mcap").read_messages()))
    assert message_count > MIN_MESSAGE_COUNT

    result = snakesim(
        "recording", "export", "a.mcap", "--format", "mcap", "--out", "copy.mcap", cwd=tmp_path
    )

    assert result.code == INCOMPLETE
    copied_count = int(result.out.split()[0])
    assert copied_count > message_count, "the copy also contains the messages for Foxglove"
    reader = RecordingReader(tmp_path / "copy.mcap")
    assert len(list(reader.read_messages())) == message_count
    assert reader.is_complete

    info = snakesim("recording", "info", "copy.mcap", cwd=tmp_path)
    assert info.code == INCOMPLETE
    assert "before it was copied: damaged in 1 place" in info.err
    assert "sensor/joints" in info.err


def test_truncated_recording_exported_as_csv_or_npz_names_missing(
    intact: bytes, tmp_path: Path
) -> None:
    write_truncated(tmp_path / "a.mcap", intact)

    for file_format in ("csv", "npz"):
        out = f"a.{file_format}"
        snakesim(
            "recording", "export", "a.mcap", "--format", file_format, "--out", out, cwd=tmp_path
        )

    with (tmp_path / "a.csv").open() as file:
        assert next(file).startswith("# incomplete: recording: its end: it breaks off at ")
        rows = list(csv.DictReader(file))
    with np.load(tmp_path / "a.npz") as arrays:
        assert "its end" in str(arrays["missing"][0])
        assert len(arrays["time_s"]) == len(rows)
    assert len(rows) > 20, "the rows before the end are exported"


def test_truncated_recording_exported_as_parquet_or_dataset_names_missing(
    intact: bytes, tmp_path: Path
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra `report`")
    write_truncated(tmp_path / "a.mcap", intact)

    for file_format, out in (("parquet", "a.parquet"), ("lerobot", "set")):
        exported = snakesim(
            "recording", "export", "a.mcap", "--format", file_format, "--out", out, cwd=tmp_path
        )
        assert exported.code == INCOMPLETE

    metadata = parquet.read_table(tmp_path / "a.parquet").schema.metadata
    assert b"its end" in metadata[b"snakesim.missing"]
    missing = json.loads((tmp_path / "set" / "meta" / "missing.json").read_text())
    assert "its end" in missing["0"][0]


@pytest.mark.parametrize("fps", [None, 50.0])
def test_gap_in_recording_ends_an_episode_of_the_dataset(
    run: Path, intact: bytes, tmp_path: Path, fps: float | None
) -> None:
    """Frames keep their times, and no reward is counted for the time of the gap."""
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra `report`")
    path = write_with_damaged_chunk(tmp_path / "a.mcap", intact, len(list_chunks(intact)) // 2)
    (intact_episode,) = read_episodes([run], None, images=False)
    parts = read_episodes([path], None, images=False)

    write_lerobot(parts, tmp_path / "set", write_parquet, fps)

    files = sorted((tmp_path / "set" / "data").rglob("*.parquet"))
    assert len(files) == 2, "an episode before the gap, and one behind it"
    record = RunRecord.load(path)
    periods_s = np.diff(record.time_s)
    assert float(periods_s.max()) > 0.1, "the recording has no gap of 0.1 s"
    first_row_after_gap = int(np.argmax(periods_s)) + 1
    starts_s = [record.time_s[0], record.time_s[first_row_after_gap]]
    intact_record = intact_episode.record
    reward_m = intact_episode.reward_m
    assert reward_m is not None
    for file, start_s in zip(files, starts_s, strict=True):
        frames = parquet.read_table(file).to_pydict()
        rows = [intact_record.find_nearest_row(start_s + time_s) for time_s in frames["timestamp"]]
        angles_rad = np.array(frames["observation.state"])[:, : intact_record.angle_rad.shape[1]]
        assert np.allclose(angles_rad, intact_record.angle_rad[rows], atol=1e-6), (
            "the robot had other angles at these times"
        )
        expected_reward_m = float(reward_m[rows[0] : rows[-1] + 1].sum())
        assert sum(frames["next.reward"]) == pytest.approx(expected_reward_m, abs=0.002)
        assert max(frames["next.reward"]) < 4 * reward_m.max(), "a frame has the reward of the gap"
        assert frames["next.done"] == [False] * (len(rows) - 1) + [True]

    summary = summarize_run(record, "complete")
    intact_summary = summarize_run(intact_record, "complete")
    assert summary.mean_speed_m_s == pytest.approx(intact_summary.mean_speed_m_s, rel=1e-6)


def test_damaged_episode_after_a_gap_starts_with_an_image(intact: bytes, tmp_path: Path) -> None:
    """An image from before the gap must not be used for the frames behind it."""
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra `report`")
    path = write_with_damaged_chunk(tmp_path / "a.mcap", intact, len(list_chunks(intact)) // 2)
    before, after = read_episodes([path], None, images=False)
    record = before.record
    first_tick = int(record.ticks[0])
    first_tick_after = int(record.ticks[after.rows[0]])
    rows_without_image = 3  # at the start of the part behind the gap
    images = CameraImages(2, 1)
    image_ticks = (first_tick, first_tick_after + rows_without_image)
    for shade, tick in enumerate(image_ticks):
        images.add(tick, np.full((1, 2, 3), shade, np.uint8))
    parts = [dataclasses.replace(part, pictures={"head": images}) for part in (before, after)]

    write_lerobot(parts, tmp_path / "set", write_parquet)

    lengths = parquet.read_table(
        tmp_path / "set/meta/episodes/chunk-000/file-000.parquet"
    ).to_pydict()["length"]
    assert lengths == [len(before.rows), len(after.rows) - rows_without_image]


def test_video_of_recording_with_gap_is_frozen_in_the_gap(intact: bytes, tmp_path: Path) -> None:
    path = write_with_damaged_chunk(tmp_path / "a.mcap", intact, len(list_chunks(intact)) // 2)
    record = RunRecord.load(path)
    rows_before, rows_after = record.contiguous_rows
    gap_start_s = record.time_s[int(rows_before[-1])]
    gap_end_s = record.time_s[int(rows_after[0])]
    gap_s = gap_end_s - gap_start_s
    fps = 100.0
    period_s = 0.01  # of the frames, and of the record

    frame_times_s = video.choose_frame_times_s(record, fps, 1.0, (0.0, np.inf))

    frozen_frame_count = (frame_times_s == gap_start_s).sum()
    assert frozen_frame_count == round(gap_s * 100), (
        "all frames of the gap show the last pose before it, and none the pose behind it"
    )
    (sentence,) = video.describe_frozen_spans(frame_times_s, period_s, period_s)
    assert f"between {gap_start_s:.2f} and {gap_end_s:.2f} s" in sentence


@pytest.mark.heavy
def test_report_of_truncated_recording_leaves_end_of_run_unknown(
    intact: bytes, tmp_path: Path
) -> None:
    write_truncated(tmp_path / "a.mcap", intact)

    snakesim("recording", "report", "a.mcap", cwd=tmp_path)

    page = (tmp_path / "a.html").read_text()
    assert "How the run ended is not known: the recording breaks off after 0." in page
    assert "ended early" not in page
    assert "The record is incomplete. recording: its end" in page


def test_comparison_with_truncated_recording_covers_what_both_contain(
    intact: bytes, tmp_path: Path
) -> None:
    write_file(tmp_path / "whole.mcap", intact)
    write_truncated(tmp_path / "a.mcap", intact)

    compared = snakesim("study", "compare", "whole.mcap", "a.mcap", cwd=tmp_path)

    assert (
        "Only a part of the runs is compared, because the record of B is incomplete."
        in compared.out
    )
    assert "in what both records hold: " in compared.out
    assert "for all of their" not in compared.out


def test_export_to_symbolic_link_is_refused(intact: bytes, tmp_path: Path) -> None:
    write_file(tmp_path / "a.mcap", intact)
    for file_format in ("csv", "npz", "mcap"):
        out = tmp_path / ("b.mcap" if file_format == "mcap" else f"a.{file_format}")
        out.symlink_to(tmp_path / "elsewhere")
        out_option = ["--out", "b.mcap"] if file_format == "mcap" else []
        result = snakesim(
            "recording", "export", "a.mcap", "--format", file_format, *out_option, cwd=tmp_path
        )
        assert result.code == 2
        assert "there is a symbolic link already; choose another one with --out" in result.err
        assert not (tmp_path / "elsewhere").exists()


def test_recording_without_last_metadata_is_complete(intact: bytes, tmp_path: Path) -> None:
    metadata = next(span for span in list_records(intact) if span.opcode == Opcode.METADATA)
    path = write_file(tmp_path / "a.mcap", intact[: metadata.begin] + intact[metadata.end :])

    reader = RecordingReader(path)

    assert list(reader.read_messages())
    assert reader.is_complete
    assert not reader.missing


def test_damaged_lz4_chunk_is_reported(intact: bytes, tmp_path: Path) -> None:
    first = list_chunks(intact)[0]
    invalid_chunk = make_chunk_record(b"abc", "lz4", packed_content=b"no lz4 at all")
    path = write_file(
        tmp_path / "a.mcap", intact[: first.end] + invalid_chunk + intact[first.end :]
    )

    reader = RecordingReader(path)

    assert len(list(reader.read_messages())) > MIN_MESSAGE_COUNT, "the other chunks are read"
    assert "a chunk that cannot be unpacked" in reader.missing[0]


def test_damaged_message_with_impossible_time_is_left_out_and_reported(
    intact: bytes, tmp_path: Path
) -> None:
    second = list_chunks(intact)[1]
    channel = 1
    sequence = 10**6
    log_time_ns = 2**63  # in 292 years
    fields = (channel, sequence, log_time_ns, 0)
    late_message = struct.pack("<BQHIQQ", Opcode.MESSAGE, 22, *fields)  # the fields have 22 bytes
    late_chunk = make_chunk_record(late_message)
    path = write_file(
        tmp_path / "a.mcap", intact[: second.begin] + late_chunk + intact[second.begin :]
    )

    reader = RecordingReader(path)

    assert max(message.robot_time_ns for message in reader.read_messages()) < 2**62
    assert reader.missing
    assert snakesim("recording", "info", "a.mcap", cwd=tmp_path).code == INCOMPLETE


@pytest.mark.parametrize(
    "opcode", [Opcode.CHUNK, Opcode.METADATA, Opcode.MESSAGE, Opcode.ATTACHMENT]
)
def test_recording_with_impossible_record_length_counts_one_damage(
    intact: bytes, tmp_path: Path, opcode: Opcode
) -> None:
    """The reader skips a record that is longer than the file, and finds the next one, so that nothing is lost."""
    second = list_chunks(intact)[1]
    length_bytes = 2**63
    impossible_record = struct.pack("<BQ", opcode, length_bytes) + b"x" * 50
    path = write_file(
        tmp_path / "a.mcap", intact[: second.begin] + impossible_record + intact[second.begin :]
    )

    reader = RecordingReader(path)
    list(reader.read_messages())

    assert reader.is_complete
    assert not reader.losses.lost_by_key
    assert reader.losses.damage_count == 1


def test_recording_that_unpacks_to_gigabytes_is_refused(tmp_path: Path) -> None:
    chunk_bytes = 60_000_000
    chunk_count = 20  # 1.2 GB in all, which fit into a file of 200 kB
    compressed_zeros = make_chunk_record(bytes(chunk_bytes))
    assert len(compressed_zeros) < 10_000
    write_file(tmp_path / "bomb.mcap", MCAP0_MAGIC + compressed_zeros * chunk_count)

    for command in (
        ["recording", "info", "bomb.mcap"],
        ["recording", "export", "bomb.mcap", "--format", "mcap", "--out", "o.mcap"],
    ):
        result = snakesim(*command, cwd=tmp_path)
        assert result.code == 2, result
        assert len(result.err.splitlines()) == 1, result
        assert "bomb.mcap is not a recording" in result.err
        assert "which no messages of a robot do" in result.err


NAVIGATION = "services.navigation.plugin="
# For each kind of plugin: the shipped base class, the options of a run with the user's class, and those with
# the shipped class.
PLUGIN_KINDS = {
    "controller": (
        "control.hold import HoldPose",
        ("--controller", "./mine.py:Mine"),
        ("--controller", "hold"),
    ),
    "service navigation": (
        "navigation.service import NavigationService",
        ("--set", f"{NAVIGATION}./mine.py:Mine"),
        ("--set", f"{NAVIGATION}navigation"),
    ),
}


@pytest.mark.heavy
@pytest.mark.parametrize("kind", PLUGIN_KINDS)
def test_replay_runs_code_of_recording_only_on_request(tmp_path: Path, kind: str) -> None:
    base_class, own_options, shipped_options = PLUGIN_KINDS[kind]
    (tmp_path / "mine.py").write_text(
        "from pathlib import Path\n"
        f"from snakesim_gnc.{base_class} as Base\n"
        "(Path(__file__).parent / 'ran').touch()\n"
        "class Mine(Base):\n    pass\n"
    )
    run_arguments = ("triplet", "--in-process", "--duration", "0.2", "--out", "run")
    run_result = snakesim("run", *run_arguments, *own_options, cwd=tmp_path)
    assert run_result.code == 0, run_result
    assert (tmp_path / "ran").exists(), run_result
    (tmp_path / "ran").unlink()
    commands = (
        "recording info run",
        "recording report run",
        "recording export run --format csv",
        "study compare run run",
    )
    for command in commands:
        assert snakesim(*command.split(), cwd=tmp_path).code == 0
    # Another controller does not replace the service.
    other_options = () if kind == "controller" else ("--controller", "hold")
    refused = snakesim("replay", "run", "--control", *other_options, cwd=tmp_path)
    assert refused.code == 2
    assert f"the recording names './mine.py:Mine' as its {kind}" in refused.err
    assert "--run-recorded-code" in refused.err
    assert " ".join(own_options) in refused.err
    assert not (tmp_path / "ran").exists()
    for options, runs_file in (
        (shipped_options, False),
        (own_options, True),
        (("--run-recorded-code",), True),
    ):
        replayed = snakesim("replay", "run", "--control", *options, cwd=tmp_path)
        assert replayed.code == 0, replayed
        assert "the same to the bit" in replayed.out, replayed
        assert (tmp_path / "ran").exists() == runs_file
        (tmp_path / "ran").unlink(missing_ok=True)


def test_damaged_recording_is_reported_for_its_run_folder(
    run: Path, intact: bytes, tmp_path: Path
) -> None:
    for path in run.iterdir():
        if path.is_file():
            write_file(tmp_path / path.name, path.read_bytes())
    write_truncated(tmp_path / RECORDING_FILENAME, intact)

    result = snakesim("recording", "report", ".", cwd=tmp_path)

    assert result.code == INCOMPLETE
    assert "its end: it breaks off" in result.err
    rows_of_run = 150  # of 1.5 s
    assert len(RunRecord.load(tmp_path).time_s) == rows_of_run, "the black box has all rows"
