"""Demonstrations by teleoperation, recorded episode by episode, as a data set that `lerobot` itself loads."""

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
THEIRS = REPOSITORY / "build" / "lerobot"  # an environment of its own: lerobot brings PyTorch, 6 GB
LEROBOT = "lerobot==0.4.4"
LOADED = """
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


class Recording:
    """`snakesim record --episodes`, at its keyboard."""

    def __init__(self, run: RunningCommand, cwd: Path) -> None:
        command = (
            "record",
            "--endpoint",
            run.endpoint,
            "--episodes",
            "demos",
            "--task",
            "through the field",
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
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        for line in self.process.stdout or ():
            self.printed += line

    def type(self, line: str, answer: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{line}\n")
        self.process.stdin.flush()
        wait_until(lambda: answer in self.printed, f"{answer!r}, not {self.printed!r}", 20.0)


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes of four: one was dropped, and of one nobody said what became of it."""
    home = tmp_path_factory.mktemp("demos")
    with running_armed_snakesim(home / "run", *RUN) as run:
        _demonstrate(run, home)
    return home


def _demonstrate(run: RunningCommand, home: Path) -> None:
    at = Recording(run, home)
    with running_teleop(run, home) as terminal:
        wait_until(
            lambda: "Enter begins an episode" in at.printed, "the recorder at the robot", 20.0
        )
        terminal.type(UP + UP)
        for number, word, became in (
            (0, "s", "succeeded"),
            (1, "f", "failed"),
            (2, "d", "dropped"),
        ):
            name = f"episode-{number:03d}.mcap"
            at.type("", f"{name}: recording")
            file = home / "demos" / name
            wait_until(
                lambda file=file: file.is_file() and file.stat().st_size > 150_000,
                "something in it",
                20.0,
            )
            before = at.printed
            at.type("", f"{before}{name}: ")
            if number == 0:
                at.type("x", "'x': s if it succeeded")
            at.type(word, f"{name}: {became}")
        before = at.printed
        at.type("", f"{before}episode-002.mcap: recording")
        at.type("q", "2 episodes;")
        assert at.process.wait(10) == 0


@pytest.mark.slow
def test_episodes_keep_what_was_said_of_them(demos: Path) -> None:
    labels = [
        json.loads(line) for line in (demos / "demos" / "episodes.jsonl").read_text().splitlines()
    ]
    assert [(one["file"], one["success"]) for one in labels] == [
        ("episode-000.mcap", True),
        ("episode-001.mcap", False),
    ]
    assert {one["task"] for one in labels} == {"through the field"}
    assert {path.name for path in (demos / "demos").iterdir()} == {
        "episodes.jsonl",
        *(one["file"] for one in labels),
    }
    info = snakesim("recording", "info", "demos/episode-000.mcap", cwd=demos)
    assert "operator/intent" in info.out and "sensor/depth/head" in info.out, info.printed


@pytest.mark.slow
def test_demonstrations_make_a_dataset_with_pictures(demos: Path, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra `report`")
    given = ("recording", "export", str(demos / "demos"), "--format", "lerobot", "--images")
    refused = snakesim(*given, "--fps", "7", "--out", "no", cwd=tmp_path)
    assert refused.code == 2
    assert "--fps 7: of a robot at 50 Hz give one of 1, 2, 5, 10" in refused.err
    ended = snakesim(*given, "--fps", "10", "--out", "set", cwd=tmp_path)
    assert "2 episodes" in ended.out, ended.printed
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
def test_lerobot_itself_loads_the_dataset(demos: Path, tmp_path: Path) -> None:
    """Installs it, once, into build/lerobot."""
    python = THEIRS / "bin" / "python"
    for command in (
        ["venv", "--allow-existing", str(THEIRS)],
        ["pip", "install", "--python", str(python), LEROBOT],
    ):
        made = subprocess.run([UV, *command], capture_output=True, text=True, check=False)
        if made.returncode:
            pytest.skip(f"{LEROBOT} cannot be installed here: {made.stderr[-300:]}")
    given = (
        "recording",
        "export",
        str(demos / "demos"),
        "--format",
        "lerobot",
        "--images",
        "--fps",
        "10",
        "--out",
        "set",
    )
    assert "2 episodes" in snakesim(*given, cwd=tmp_path).out
    offline = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "hf"), "PATH": "/usr/bin:/bin"}
    loaded = run_program([python, "-c", LOADED], tmp_path, offline, 600.0)
    assert loaded.code == 0, loaded.err[-3000:]
    seen = json.loads(loaded.out.splitlines()[-1])
    assert seen["episodes"] == 2
    assert seen["fps"] == 10
    assert seen["task"] == "through the field"
    assert seen["image"] == [3, 120, 160]
    assert 0 < seen["brightest"] <= 1
    assert seen["mean"] == [3, 1, 1]
    assert seen["done"]
    assert seen["success"] == [False, False]
    assert seen["around"] == [[2, 26], [2, 3, 120, 160]]
    assert seen["batch"] == [4, 3, 120, 160]
