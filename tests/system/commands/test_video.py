"""A recorded run is rendered as a video, and the console shows it at any time."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from snakesim_operator.features.console.robot_data.run_playback import RunPlayback
from snakesim_operator.features.console.scene.drawing import TrueSurroundings, draw
from snakesim_testing.runs.in_process_command import run_to_summary, snakesim


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run a scenario of one second, and return its folder."""
    out = tmp_path_factory.mktemp("filmed") / "run"
    completed, _ = run_to_summary(out, "triplet", "--duration", "1")
    assert completed.code == 0, completed.printed
    return out


def render_video(run: Path, out: Path, *options: str) -> str:
    """Render a small video of a run, and return what the command printed as errors."""
    size = ("--width", "96", "--height", "64", "--fps", "10")
    completed = snakesim(
        "recording", "video", str(run), "--out", str(out), *size, *options, cwd=run.parent
    )
    if "OpenGL" in completed.err:
        pytest.skip(f"no OpenGL here: {completed.err}")
    return completed.err


@pytest.mark.heavy
def test_video_gif_shows_the_snake_in_every_frame(run: Path) -> None:
    out = run.parent / "film.gif"
    assert render_video(run, out, "--speed", "2") == ""
    with Image.open(out) as gif:
        assert gif.size == (96, 64)
        assert 4 <= gif.n_frames <= 6  # pyright: ignore[reportAttributeAccessIssue]
        for frame in range(gif.n_frames):  # pyright: ignore[reportAttributeAccessIssue]
            gif.seek(frame)
            red, _, blue = np.moveaxis(np.asarray(gif.convert("RGB")).astype(int), 2, 0)
            assert (blue > red + 40).sum() > 100, f"no blue snake in frame {frame}"


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
