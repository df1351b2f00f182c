"""A recorded run, looked at: as a film, and as the console shows it."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from snakesim_operator.features.console.robot_data.run_playback import RunPlayback
from snakesim_operator.features.console.scene.drawing import TrueSurroundings, draw
from snakesim_testing.runs.in_process_command import run_to_summary, snakesim


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("filmed") / "run"
    ended, _ = run_to_summary(out, "triplet", "--duration", "1")
    assert ended.code == 0, ended.printed
    return out


def film(run: Path, out: Path, *more: str) -> str:
    size = ("--width", "96", "--height", "64", "--fps", "10")
    ended = snakesim(
        "recording", "video", str(run), "--out", str(out), *size, *more, cwd=run.parent
    )
    if "OpenGL" in ended.err:
        pytest.skip(f"no OpenGL here: {ended.err}")
    return ended.err


def test_a_gif_shows_the_snake_in_every_picture(run: Path) -> None:
    out = run.parent / "film.gif"
    assert film(run, out, "--speed", "2") == ""
    with Image.open(out) as gif:
        assert gif.size == (96, 64)
        assert 4 <= gif.n_frames <= 6  # pyright: ignore[reportAttributeAccessIssue]
        for frame in range(gif.n_frames):  # pyright: ignore[reportAttributeAccessIssue]
            gif.seek(frame)
            red, _, blue = np.moveaxis(np.asarray(gif.convert("RGB")).astype(int), 2, 0)
            assert (blue > red + 40).sum() > 100, f"no blue snake in picture {frame}"


@pytest.mark.slow
def test_an_mp4_is_one(run: Path) -> None:
    out = run.parent / "film.mp4"
    assert film(run, out) == ""
    assert out.read_bytes()[4:8] == b"ftyp"


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--out", "film.avi"], "ends in .mp4 or .gif"),
        (["--out", "film.gif", "--from", "5"], "the run has poses for"),
        (["--out", "film.gif", "--width", "65"], "give even numbers of pixels"),
    ],
)
def test_what_cannot_be_filmed_is_said(run: Path, more: list[str], said: str) -> None:
    ended = snakesim("recording", "video", str(run), *more, cwd=run.parent)
    assert ended.code == 2
    assert said in ended.err


def test_the_console_shows_a_recorded_instant_as_it_was(run: Path) -> None:
    recorded = RunPlayback(run)
    record = recorded.record
    begin_s, end_s = recorded.span_s
    assert end_s - begin_s == pytest.approx(0.99, abs=0.03)
    moment = recorded.make_snapshot(begin_s + 0.5)
    row = record.find_nearest_row(begin_s + 0.5)
    drawing, nodes = draw(moment, TrueSurroundings(record.config)), record.find_body_points_w(row)
    assert drawing is not None
    assert nodes is not None
    assert drawing.hinges_w == pytest.approx(nodes[1:-1])
    assert moment.control is not None
    assert abs(moment.control.timestamp_ns * 1e-9 - begin_s - 0.5) < 0.1
