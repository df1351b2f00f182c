"""Demonstrations by teleoperation are recorded as episodes, and exported as a dataset that `lerobot` loads."""

import json
import subprocess
import threading
from pathlib import Path

import pytest

from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.command import (
    SNAKESIM_COMMAND,
    RunningCommand,
    make_environment,
    run_program,
    running_armed_snakesim,
)
from snakesim_testing.runs.documents import REPOSITORY, UV, needs_uv
from snakesim_testing.runs.in_process_command import snakesim
from snakesim_testing.runs.teleop_terminal import UP, running_teleop

pytestmark = pytest.mark.e2e
RUN = ("clutter", "--clock-mode", "realtime", "--duration", "600", "--stay", "--set", "rate_hz=50")
LEROBOT_VENV = REPOSITORY / "build" / "lerobot"  # a separate environment: PyTorch takes 6 GB
MIN_EPISODE_BYTES = 150_000
TASK = "through the field"
EPISODES_FOLDER = "demos"
LEROBOT = "lerobot==0.4.4"
LOAD_DATASET_CODE = """
import json, torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

frames = LeRobotDataset("local/snake", root="set")
last, camera = frames[len(frames) - 1], "observation.images.head_depth"
around = LeRobotDataset("local/snake", root="set", delta_timestamps={"action": [0, 0.1], camera: [-0.1, 0]})
batch = next(iter(torch.utils.data.DataLoader(frames, batch_size=4, shuffle=True)))
print(json.dumps({
    "frames": len(frames), "episodes": frames.num_episodes, "fps": frames.fps, "task": frames[0]["task"],
    "image": list(frames[0][camera].shape), "brightest": float(frames[0][camera].max()),
    "mean": list(frames.meta.stats[camera]["mean"].shape),
    "done": bool(last["next.done"]), "success": [bool(last["next.success"]), bool(frames[0]["next.success"])],
    "around": [list(around[5]["action"].shape), list(around[5][camera].shape)],
    "batch": list(batch[camera].shape),
}))
"""


class EpisodeRecorder:
    """A process `snakesim record --episodes` whose keyboard the test controls."""

    def __init__(self, run: RunningCommand, cwd: Path) -> None:
        command = (
            "record",
            "--endpoint",
            run.endpoint,
            "--episodes",
            EPISODES_FOLDER,
            "--task",
            TASK,
        )
        self.process = subprocess.Popen(
            [*SNAKESIM_COMMAND, *command],
            cwd=cwd,
            env=make_environment(cwd),
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        self.printed = ""
        threading.Thread(target=self._collect_output, daemon=True).start()

    def _collect_output(self) -> None:
        for line in self.process.stdout or ():
            self.printed += line

    def type(self, line: str, answer: str) -> None:
        """Type a line and wait until the process prints the answer."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{line}\n")
        self.process.stdin.flush()
        wait_until(lambda: answer in self.printed, f"{answer!r}, not {self.printed!r}", 20.0)


@pytest.fixture(scope="module")
def episodes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record four episodes, and return the folder with those that are kept.

    The first is labelled as a success, the second as a failure, the third is dropped, and the fourth is not labelled
    before the recorder ends.
    """
    home = tmp_path_factory.mktemp("demos")
    with running_armed_snakesim(home / "run", *RUN) as run:
        record_demonstrations(run, home)
    return home / EPISODES_FOLDER


def record_demonstrations(run: RunningCommand, home: Path) -> None:
    """Steer the robot forward and record three labelled episodes and an unlabelled one."""
    recorder = EpisodeRecorder(run, home)
    with running_teleop(run, home) as terminal:
        wait_until(
            lambda: "Enter begins an episode" in recorder.printed, "the recorder connects", 20.0
        )
        terminal.type(UP + UP)
        for number, letter, outcome in (
            (0, "s", "succeeded"),
            (1, "f", "failed"),
            (2, "d", "dropped"),
        ):
            name = f"episode-{number:03d}.mcap"
            recorder.type("", f"{name}: recording")
            file = home / EPISODES_FOLDER / name
            wait_until(
                lambda file=file: file.is_file() and file.stat().st_size > MIN_EPISODE_BYTES,
                "the episode contains messages",
                20.0,
            )
            printed_before = recorder.printed
            recorder.type("", f"{printed_before}{name}: ")
            if number == 0:
                recorder.type("x", "'x': s if it succeeded")
            recorder.type(letter, f"{name}: {outcome}")
        printed_before = recorder.printed
        recorder.type("", f"{printed_before}episode-002.mcap: recording")
        recorder.type("q", "2 episodes;")
        assert recorder.process.wait(10) == 0


@pytest.mark.slow
def test_episodes_are_listed_with_label_and_task(episodes: Path) -> None:
    """The operator labelled the first episode as a success, and the second as a failure."""
    lines = (episodes / "episodes.jsonl").read_text().splitlines()
    labels = [json.loads(line) for line in lines]
    listed = [(label["file"], label["success"], label["task"]) for label in labels]
    assert listed == [
        ("episode-000.mcap", True, TASK),
        ("episode-001.mcap", False, TASK),
    ]


@pytest.mark.slow
def test_episodes_dropped_or_without_label_are_deleted(episodes: Path) -> None:
    """The operator dropped the third episode, and ended the recorder during the fourth."""
    labelled_files = {"episode-000.mcap", "episode-001.mcap"}
    assert {path.name for path in episodes.iterdir()} == {"episodes.jsonl", *labelled_files}


@pytest.mark.slow
def test_episode_contains_intents_and_depth_images(episodes: Path) -> None:
    info = snakesim("recording", "info", "episode-000.mcap", cwd=episodes)
    assert "operator/intent" in info.out, info.printed
    assert "sensor/depth/head" in info.out, info.printed


@pytest.mark.slow
def test_demonstrations_exported_with_images_form_a_dataset(episodes: Path, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra `report`")
    export_command = (
        "recording",
        "export",
        str(episodes),
        "--format",
        "lerobot",
        "--images",
    )
    refused = snakesim(*export_command, "--fps", "7", "--out", "no", cwd=tmp_path)
    assert refused.code == 2
    assert "--fps 7: of a robot at 50 Hz give one of 1, 2, 5, 10" in refused.err
    exported = snakesim(*export_command, "--fps", "10", "--out", "set", cwd=tmp_path)
    assert "2 episodes" in exported.out, exported.printed
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert info["fps"] == 10
    assert info["total_episodes"] == 2
    assert info["total_tasks"] == 1
    assert info["features"]["observation.images.head_depth"]["shape"] == [120, 160, 3]
    first, second = (
        parquet.read_table(
            tmp_path / "set" / info["data_path"].format(chunk_index=0, file_index=i)
        ).to_pydict()
        for i in (0, 1)
    )
    assert first["next.success"][-1]
    assert not any(first["next.success"][:-1] + second["next.success"])
    assert first["next.done"] == [False] * (len(first["index"]) - 1) + [True]
    assert first["observation.images.head_depth"][0]["bytes"].startswith(b"\x89PNG")
    assert len(first["next.reward"]) == len(first["index"])
    assert min(first["next.reward"]) >= 0.0


@pytest.mark.slow
@pytest.mark.timeout(1800)
@needs_uv
def test_exported_dataset_is_loaded_by_lerobot(episodes: Path, tmp_path: Path) -> None:
    """The test installs lerobot into build/lerobot if it is not there."""
    python = LEROBOT_VENV / "bin" / "python"
    for command in (
        ["venv", "--allow-existing", str(LEROBOT_VENV)],
        ["pip", "install", "--python", str(python), LEROBOT],
    ):
        installation = subprocess.run([UV, *command], capture_output=True, text=True, check=False)
        if installation.returncode:
            pytest.skip(f"{LEROBOT} cannot be installed here: {installation.stderr[-300:]}")
    export_command = (
        "recording",
        "export",
        str(episodes),
        "--format",
        "lerobot",
        "--images",
        "--fps",
        "10",
        "--out",
        "set",
    )
    assert "2 episodes" in snakesim(*export_command, cwd=tmp_path).out
    offline = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "hf"), "PATH": "/usr/bin:/bin"}
    program = run_program([python, "-c", LOAD_DATASET_CODE], tmp_path, offline, 600.0)
    assert program.code == 0, program.err[-3000:]
    dataset = json.loads(program.out.splitlines()[-1])
    assert dataset["episodes"] == 2
    assert dataset["fps"] == 10
    assert dataset["task"] == TASK
    assert dataset["image"] == [3, 120, 160]
    assert 0 < dataset["brightest"] <= 1
    assert dataset["mean"] == [3, 1, 1]
    assert dataset["done"]
    assert dataset["success"] == [False, False]
    assert dataset["around"] == [[2, 26], [2, 3, 120, 160]]
    assert dataset["batch"] == [4, 3, 120, 160]
