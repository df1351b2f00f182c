"""A damaged recording: every command goes on behind the damage, tells what is lost, and ends with exit code 3."""

import csv
import dataclasses
import json
import struct
from collections import Counter
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
    flip_bit,
    list_chunks,
    list_records,
    make_chunk_record,
    record_short_run,
    write_file,
)
from snakesim_testing.runs.in_process_command import snakesim

INCOMPLETE = 3


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_short_run(tmp_path_factory.mktemp("recorded") / "run", 1.5, 100_000)


@pytest.fixture(scope="module")
def whole(run: Path) -> bytes:
    content = (run / RECORDING_FILENAME).read_bytes()
    assert len(list_chunks(content)) >= 5
    return content


def lost(whole_path: Path, path: Path) -> Counter[str]:
    """By key, by comparison with the file as it was."""
    before, after = (
        Counter(one.key for one in RecordingReader(of).read_messages()) for of in (whole_path, path)
    )
    return before - after


def test_damaged_bit_costs_one_chunk_counted_by_time_and_key(
    run: Path, whole: bytes, tmp_path: Path
) -> None:
    damaged, following = list_chunks(whole)[2:4]
    path = write_file(tmp_path / "a.mcap", flip_bit(whole, (damaged.begin + damaged.end) // 2))
    reader = RecordingReader(path)
    kept = list(reader.read_messages())
    truth = lost(run / RECORDING_FILENAME, path)
    assert truth[keys.JOINTS] >= 2
    assert len(kept) > 500
    assert {
        key: count for key, count in reader.losses.lost_by_key.items() if not key.startswith("/")
    } == truth
    (gap,) = [gap for gap in reader.losses.gaps if gap.lost]
    clocks = [one.robot_time_ns for one in kept if one.key == keys.CLOCK]
    hole = next((a, b) for a, b in pairwise(clocks) if b - a > 20_000_000)
    assert gap.end_ns is not None
    assert hole[0] <= gap.begin_ns < gap.end_ns <= hole[1]
    assert reader.is_complete
    assert following.begin  # what follows was read


@pytest.mark.slow  # one flipped bit in one of them below
def test_each_chunk_may_be_the_damaged_one(run: Path, whole: bytes, tmp_path: Path) -> None:
    for chunk in list_chunks(whole):
        for at in (
            chunk.begin,
            chunk.begin + 2,
            chunk.begin + 45,
            chunk.end - 5,
        ):  # kind, length, name, data
            path = write_file(tmp_path / "a.mcap", flip_bit(whole, at))
            reader = RecordingReader(path)
            kept = list(reader.read_messages())
            ours = {
                key: n for key, n in reader.losses.lost_by_key.items() if not key.startswith("/")
            }
            assert kept and reader.is_complete and ours == lost(run / RECORDING_FILENAME, path), (
                chunk,
                at,
                reader.missing,
            )


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
        *((command, "flipped") for command in COMMANDS),
        (COMMANDS[0], "halved"),
        (COMMANDS[0], "taken out"),
    ],
)
def test_every_command_tells_of_the_damage_and_ends_with_3(
    whole: bytes, tmp_path: Path, command: list[str], damage: str
) -> None:
    second = list_chunks(whole)[1]
    damaged = {
        "flipped": flip_bit(whole, (second.begin + second.end) // 2),
        "halved": whole[: len(whole) // 2],
        "taken out": whole[: second.begin] + whole[second.end :],
    }[damage]
    write_file(tmp_path / "whole.mcap", whole)
    write_file(tmp_path / "a.mcap", damaged)
    ended = snakesim(*command, cwd=tmp_path)
    assert ended.code == INCOMPLETE, ended
    # A busy computer.
    said = [line for line in ended.err.splitlines() if "update() took" not in line]
    assert len(said) == 1
    assert said[0].startswith("snakesim: a.mcap is incomplete: ")
    assert ("breaks off at" if damage == "halved" else "actuator/joints") in ended.err
    if "--json" in command:
        assert json.loads(ended.out)["missing"]["a"]
        assert not json.loads(ended.out)["missing"]["b"]


@pytest.mark.slow
def test_undamaged_recording_is_not_reported_and_names_its_command(
    whole: bytes, tmp_path: Path
) -> None:
    for name in ("whole.mcap", "a.mcap"):
        write_file(tmp_path / name, whole)
    for command in COMMANDS:
        ended = snakesim(*command, cwd=tmp_path)
        # By a busy computer.
        errors = [line for line in ended.err.splitlines() if "update() took" not in line]
        assert ended.code == 0 and not errors, ended
    page = (tmp_path / "a.html").read_text()
    assert "The run ended early" not in page
    assert "The record is incomplete" not in page
    # What repeats the run names a file that can be.
    assert "snakesim run config.json --backend sim" in page
    assert "a.mcap/config.json" not in page
    assert "Save the effective configuration below as <code>config.json</code>" in page


def test_damaged_recording_copy_keeps_intact_parts_and_lists_gaps(
    run: Path, whole: bytes, tmp_path: Path
) -> None:
    first = list_chunks(whole)[0]
    write_file(tmp_path / "a.mcap", flip_bit(whole, (first.begin + first.end) // 2))
    ended = snakesim(
        "recording", "export", "a.mcap", "--format", "mcap", "--out", "copy.mcap", cwd=tmp_path
    )
    count = len(list(RecordingReader(tmp_path / "a.mcap").read_messages()))
    assert ended.code == INCOMPLETE
    assert int(ended.out.split()[0]) > count > 500  # and those for Foxglove
    reader = RecordingReader(tmp_path / "copy.mcap")
    assert len(list(reader.read_messages())) == count
    assert reader.is_complete
    told = snakesim("recording", "info", "copy.mcap", cwd=tmp_path)
    assert told.code == INCOMPLETE
    assert "before it was copied: damaged in 1 place" in told.err
    assert "sensor/joints" in told.err


def test_tables_and_arrays_carry_what_is_lost(whole: bytes, tmp_path: Path) -> None:
    write_file(tmp_path / "a.mcap", whole[: len(whole) // 2])
    for form in ("csv", "npz"):
        snakesim(
            "recording", "export", "a.mcap", "--format", form, "--out", f"a.{form}", cwd=tmp_path
        )
    with (tmp_path / "a.csv").open() as file:
        assert next(file).startswith("# incomplete: recording: its end: it breaks off at ")
        rows = list(csv.DictReader(file))
    with np.load(tmp_path / "a.npz") as arrays:
        assert "its end" in str(arrays["missing"][0])
        assert len(arrays["time_s"]) == len(rows) > 20


def test_who_reads_parquet_and_datasets_finds_it_too(whole: bytes, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra `report`")
    write_file(tmp_path / "a.mcap", whole[: len(whole) // 2])
    for form, out in (("parquet", "a.parquet"), ("lerobot", "set")):
        assert (
            snakesim(
                "recording", "export", "a.mcap", "--format", form, "--out", out, cwd=tmp_path
            ).code
            == INCOMPLETE
        )
    assert (
        b"its end"
        in parquet.read_table(tmp_path / "a.parquet").schema.metadata[b"snakesim.missing"]
    )
    assert "its end" in json.loads((tmp_path / "set" / "meta" / "missing.json").read_text())["0"][0]


@pytest.mark.parametrize("fps", [None, 50.0])
def test_a_gap_ends_an_episode_of_a_dataset(
    run: Path, whole: bytes, tmp_path: Path, fps: float | None
) -> None:
    """No frame gets a time that it did not have, and no reward is earned while nothing was recorded."""
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra `report`")
    damaged = list_chunks(whole)[len(list_chunks(whole)) // 2]
    path = write_file(tmp_path / "a.mcap", flip_bit(whole, (damaged.begin + damaged.end) // 2))
    (intact,), parts = (
        read_episodes([run], None, images=False),
        read_episodes([path], None, images=False),
    )
    write_lerobot(parts, tmp_path / "set", write_parquet, fps)
    files = sorted((tmp_path / "set" / "data").rglob("*.parquet"))
    assert len(files) == 2
    record = RunRecord.load(path)
    gap_s = float(np.diff(record.time_s).max())
    assert gap_s > 0.1
    begins_s = [record.time_s[0], record.time_s[int(np.argmax(np.diff(record.time_s))) + 1]]
    assert intact.reward_m is not None
    for file, begin_s in zip(files, begins_s, strict=True):
        frames = parquet.read_table(file).to_pydict()
        rows = [
            intact.record.find_nearest_row(begin_s + timestamp) for timestamp in frames["timestamp"]
        ]
        angles = np.array(frames["observation.state"])[:, : intact.record.angle_rad.shape[1]]
        # They were measured at that time.
        assert np.allclose(angles, intact.record.angle_rad[rows], atol=1e-6)
        earned_m = float(intact.reward_m[rows[0] : rows[-1] + 1].sum())
        assert sum(frames["next.reward"]) == pytest.approx(earned_m, abs=0.002)
        assert max(frames["next.reward"]) < 4 * intact.reward_m.max()
        assert frames["next.done"] == [False] * (len(rows) - 1) + [True]
    summary = summarize_run(record, "complete")
    assert summary.mean_speed_m_s == pytest.approx(
        summarize_run(intact.record, "complete").mean_speed_m_s, rel=1e-6
    )


def test_damaged_episode_after_a_gap_starts_with_an_image(whole: bytes, tmp_path: Path) -> None:
    """What a camera showed before the gap is not what the robot saw behind it."""
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra `report`")
    damaged = list_chunks(whole)[len(list_chunks(whole)) // 2]
    path = write_file(tmp_path / "a.mcap", flip_bit(whole, (damaged.begin + damaged.end) // 2))
    before, after = read_episodes([path], None, images=False)
    record = before.record
    first_tick, first_tick_after = int(record.ticks[0]), int(record.ticks[after.rows[0]])
    pictures = CameraImages(2, 1)
    for shade, tick in enumerate((first_tick, first_tick_after + 3)):
        pictures.add(tick, np.full((1, 2, 3), shade, np.uint8))
    parts = [dataclasses.replace(part, pictures={"head": pictures}) for part in (before, after)]
    write_lerobot(parts, tmp_path / "set", write_parquet)
    lengths = parquet.read_table(
        tmp_path / "set/meta/episodes/chunk-000/file-000.parquet"
    ).to_pydict()["length"]
    assert lengths == [len(before.rows), len(after.rows) - 3]


def test_a_film_stands_still_in_a_gap(whole: bytes, tmp_path: Path) -> None:
    damaged = list_chunks(whole)[len(list_chunks(whole)) // 2]
    path = write_file(tmp_path / "a.mcap", flip_bit(whole, (damaged.begin + damaged.end) // 2))
    record = RunRecord.load(path)
    before, after = (
        int(rows[end]) for rows, end in zip(record.contiguous_rows, (-1, 0), strict=True)
    )
    times_s = video.choose_frame_times_s(record, 100.0, 1.0, (0.0, np.inf))
    gap_s = record.time_s[after] - record.time_s[before]
    # And never the pose that came later.
    assert (times_s == record.time_s[before]).sum() == round(gap_s * 100)
    (sentence,) = video.describe_frozen_spans(times_s, 0.01, 0.01)
    assert f"between {record.time_s[before]:.2f} and {record.time_s[after]:.2f} s" in sentence


def test_truncated_recording_says_nothing_about_end_of_run(whole: bytes, tmp_path: Path) -> None:
    write_file(tmp_path / "whole.mcap", whole)
    write_file(tmp_path / "a.mcap", whole[: len(whole) // 2])
    snakesim("recording", "report", "a.mcap", cwd=tmp_path)
    page = (tmp_path / "a.html").read_text()
    assert "How the run ended is not known: the recording breaks off after 0." in page
    assert "ended early" not in page
    assert "The record is incomplete. recording: its end" in page
    compared = snakesim("study", "compare", "whole.mcap", "a.mcap", cwd=tmp_path)
    assert (
        "Only a part of the runs is compared, because the record of B is incomplete."
        in compared.out
    )
    assert "in what both records hold: " in compared.out
    assert "for all of their" not in compared.out


def test_an_export_does_not_follow_a_link(whole: bytes, tmp_path: Path) -> None:
    write_file(tmp_path / "a.mcap", whole)
    for form in ("csv", "npz", "mcap"):
        out = tmp_path / ("b.mcap" if form == "mcap" else f"a.{form}")
        out.symlink_to(tmp_path / "elsewhere")
        wanted = ["--out", "b.mcap"] if form == "mcap" else []
        ended = snakesim("recording", "export", "a.mcap", "--format", form, *wanted, cwd=tmp_path)
        assert ended.code == 2
        assert "there is a symbolic link already; choose another one with --out" in ended.err
        assert not (tmp_path / "elsewhere").exists()


def test_without_its_last_metadata_nothing_of_a_robot_is_lost(whole: bytes, tmp_path: Path) -> None:
    end = next(span for span in list_records(whole) if span.opcode == Opcode.METADATA)
    path = write_file(tmp_path / "a.mcap", whole[: end.begin] + whole[end.end :])
    reader = RecordingReader(path)
    assert list(reader.read_messages())
    assert reader.is_complete
    assert not reader.missing


def test_damaged_lz4_chunk_and_impossible_time_are_reported(whole: bytes, tmp_path: Path) -> None:
    first, second = list_chunks(whole)[:2]
    bad = make_chunk_record(b"abc", "lz4", packed_content=b"no lz4 at all")
    reader = RecordingReader(
        write_file(tmp_path / "a.mcap", whole[: first.end] + bad + whole[first.end :])
    )
    assert len(list(reader.read_messages())) > 500
    assert "a chunk that cannot be unpacked" in reader.missing[0]
    (channel,) = struct.unpack("<H", b"\x01\x00")
    late = struct.pack("<BQHIQQ", Opcode.MESSAGE, 22, channel, 10**6, 2**63, 0)
    reader = RecordingReader(
        write_file(
            tmp_path / "a.mcap",
            whole[: second.begin] + make_chunk_record(late) + whole[second.begin :],
        )
    )
    assert max(one.robot_time_ns for one in reader.read_messages()) < 2**62
    assert reader.missing
    assert snakesim("recording", "info", "a.mcap", cwd=tmp_path).code == INCOMPLETE


def test_a_record_of_absurd_length_is_damage(whole: bytes, tmp_path: Path) -> None:
    second = list_chunks(whole)[1]
    for opcode in (Opcode.CHUNK, Opcode.METADATA, Opcode.MESSAGE, Opcode.ATTACHMENT):
        absurd = struct.pack("<BQ", opcode, 2**63) + b"x" * 50
        reader = RecordingReader(
            write_file(tmp_path / "a.mcap", whole[: second.begin] + absurd + whole[second.begin :])
        )
        list(reader.read_messages())
        assert reader.is_complete
        assert not reader.losses.lost_by_key
        assert reader.losses.damage_count == 1


def test_a_bomb_is_refused_in_one_line(tmp_path: Path) -> None:
    bomb = make_chunk_record(bytes(60_000_000))
    assert len(bomb) < 10_000
    write_file(tmp_path / "bomb.mcap", MCAP0_MAGIC + bomb * 20)
    for command in (
        ["recording", "info", "bomb.mcap"],
        ["recording", "export", "bomb.mcap", "--format", "mcap", "--out", "o.mcap"],
    ):
        ended = snakesim(*command, cwd=tmp_path)
        assert ended.code == 2 and len(ended.err.splitlines()) == 1, ended
        assert "bomb.mcap is not a recording" in ended.err
        assert "which no messages of a robot do" in ended.err


NAVIGATION = "services.navigation.plugin="
NAMED = {  # the class that is made another; how a run names that one, how the refusal calls it, and what stands for it
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


@pytest.mark.parametrize("kind", NAMED)
def test_recording_runs_named_files_only_on_request(tmp_path: Path, kind: str) -> None:
    base, own, shipped = NAMED[kind]
    (tmp_path / "mine.py").write_text(
        "from pathlib import Path\n"
        f"from snakesim_gnc.{base} as Base\n"
        "(Path(__file__).parent / 'ran').touch()\n"
        "class Mine(Base):\n    pass\n"
    )
    begun = snakesim(
        "run", "triplet", "--in-process", "--duration", "0.2", "--out", "run", *own, cwd=tmp_path
    )
    assert begun.code == 0 and (tmp_path / "ran").exists(), begun
    (tmp_path / "ran").unlink()
    commands = (
        "recording info run",
        "recording report run",
        "recording export run --format csv",
        "study compare run run",
    )
    for words in commands:
        assert snakesim(*words.split(), cwd=tmp_path).code == 0
    # Which says nothing of a service.
    more = () if kind == "controller" else ("--controller", "hold")
    refused = snakesim("replay", "run", "--control", *more, cwd=tmp_path)
    assert refused.code == 2
    assert f"the recording names './mine.py:Mine' as its {kind}" in refused.err
    assert "--run-recorded-code" in refused.err
    assert " ".join(own) in refused.err
    assert not (tmp_path / "ran").exists()
    for flags, runs in ((shipped, False), (own, True), (("--run-recorded-code",), True)):
        replayed = snakesim("replay", "run", "--control", *flags, cwd=tmp_path)
        assert replayed.code == 0 and "the same to the bit" in replayed.out, replayed
        assert (tmp_path / "ran").exists() == runs
        (tmp_path / "ran").unlink(missing_ok=True)


def test_damaged_recording_is_reported_for_its_run_folder(
    run: Path, whole: bytes, tmp_path: Path
) -> None:
    for path in run.iterdir():
        if path.is_file():
            write_file(tmp_path / path.name, path.read_bytes())
    write_file(tmp_path / RECORDING_FILENAME, whole[: len(whole) // 2])
    ended = snakesim("recording", "report", ".", cwd=tmp_path)
    assert ended.code == INCOMPLETE
    assert "its end: it breaks off" in ended.err
    assert len(RunRecord.load(tmp_path).time_s) == 150  # the rows are the black box's
