"""A recorded run is rendered as a video, and the console shows it at any time."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image, ImageSequence

from snakesim_operator.features.console.robot_data.run_playback import RunPlayback
from snakesim_operator.features.console.scene.drawing import TrueSurroundings, draw
from snakesim_testing.runs.in_process_command import run_to_summary, snakesim

RUN_DURATION_S = 1.0
Pixels = NDArray[np.int64]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run a scenario for RUN_DURATION_S, and return its folder."""
    out = tmp_path_factory.mktemp("filmed") / "run"
    completed, _ = run_to_summary(out, "triplet", "--duration", f"{RUN_DURATION_S:g}")
    assert completed.code == 0, completed.printed
    return out


def render_video(
    run: Path,
    video: Path,
    *,
    width_px: int = 96,
    height_px: int = 64,
    frames_per_s: int = 10,
    speed: int = 1,
) -> str:
    """Render a video of a run, and return what the command printed as errors.

    Args:
        run: Folder of the run.
        video: File to write.
        width_px: Width of the picture.
        height_px: Height of the picture.
        frames_per_s: Frames in one second of the video.
        speed: Seconds of the run in one second of the video.
    """
    options = {
        "--width": width_px,
        "--height": height_px,
        "--fps": frames_per_s,
        "--speed": speed,
    }
    arguments = [argument for name, value in options.items() for argument in (name, str(value))]
    completed = snakesim(
        "recording", "video", str(run), "--out", str(video), *arguments, cwd=run.parent
    )
    if "OpenGL" in completed.err:
        pytest.skip(f"no OpenGL here: {completed.err}")
    return completed.err


def read_gif_frames(gif_path: Path) -> list[Pixels]:
    """Return the frames of a GIF, each (height, width, 3): red, green and blue, 0 to 255."""
    with Image.open(gif_path) as gif:
        return [
            np.asarray(frame.convert("RGB")).astype(int) for frame in ImageSequence.Iterator(gif)
        ]


@pytest.mark.heavy
def test_video_gif_has_requested_size_and_frame_count(run: Path) -> None:
    gif_path = run.parent / "sized.gif"
    width_px, height_px = 96, 64
    frames_per_s = 10
    speed = 2  # times as fast as the run
    printed_errors = render_video(
        run,
        gif_path,
        width_px=width_px,
        height_px=height_px,
        frames_per_s=frames_per_s,
        speed=speed,
    )
    assert printed_errors == ""
    frames = read_gif_frames(gif_path)
    assert {frame.shape for frame in frames} == {(height_px, width_px, 3)}
    expected_count = round(RUN_DURATION_S / speed * frames_per_s)
    assert expected_count - 1 <= len(frames) <= expected_count + 1


@pytest.mark.heavy
def test_video_gif_shows_the_snake_in_every_frame(run: Path) -> None:
    """The links of the snake are blue; the ground is nearly white, and the obstacles are brown."""
    gif_path = run.parent / "film.gif"
    printed_errors = render_video(run, gif_path, width_px=96, height_px=64, speed=2)
    assert printed_errors == ""
    min_snake_pixels = 100  # of 96 x 64
    for number, frame in enumerate(read_gif_frames(gif_path)):
        red = frame[:, :, 0]
        blue = frame[:, :, 2]
        is_snake = blue > red + 40
        assert is_snake.sum() > min_snake_pixels, f"no blue snake in frame {number}"


@pytest.mark.slow
def test_video_mp4_has_the_mp4_format(run: Path) -> None:
    out = run.parent / "film.mp4"
    assert render_video(run, out) == ""
    assert out.read_bytes()[4:8] == b"ftyp"


@pytest.mark.parametrize(
    ("options", "expected_text"),
    [
        (["--out", "film.avi"], "ends in .mp4 or .gif"),
        (["--out", "film.gif", "--from", "5"], "the run has poses for"),
        (["--out", "film.gif", "--width", "65"], "give even numbers of pixels"),
    ],
)
def test_video_with_invalid_option_is_refused(
    run: Path, options: list[str], expected_text: str
) -> None:
    completed = snakesim("recording", "video", str(run), *options, cwd=run.parent)
    assert completed.code == 2
    assert expected_text in completed.err


def test_playback_snapshot_draws_the_recorded_pose(run: Path) -> None:
    playback = RunPlayback(run)
    record = playback.record
    begin_s, end_s = playback.span_s
    assert end_s - begin_s == pytest.approx(0.99, abs=0.03)
    snapshot = playback.make_snapshot(begin_s + 0.5)
    row = record.find_nearest_row(begin_s + 0.5)
    drawing = draw(snapshot, TrueSurroundings(record.config))
    body_points_w = record.find_body_points_w(row)
    assert drawing is not None
    assert body_points_w is not None
    assert drawing.hinges_w == pytest.approx(body_points_w[1:-1])
    assert snapshot.control is not None
    assert abs(snapshot.control.timestamp_ns * 1e-9 - begin_s - 0.5) < 0.1
