"""`snakesim recording video`: films a recorded run as MP4 or GIF, rendered by MuJoCo without a screen."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import PrintLine, print_line
from snakesim_hal.model.plugins import FILMS, load_plugin
from snakesim_hal.model.textfiles import export_atomically
from snakesim_operator.base import extras
from snakesim_operator.results.missing_data import report_missing_data
from snakesim_operator.results.run_log import RunRecord

Picture = NDArray[np.uint8]
WriteFrame = Callable[[Picture], None]

FOLLOW_TIME_CONSTANT_S = 0.8  # with which the camera follows the robot
ARROW_M_PER_N = 0.008  # length of a force arrow per newton
MIN_FORCE_N = 0.3  # a smaller force is not drawn
MAX_WORLD_AGE_S = 0.3  # older contacts are not drawn
GIF_COLORS = 48
PROGRESS_STEP = 0.25  # progress is printed after each such fraction of the pictures
MAX_COMMENT_BYTES = 250  # of the comment in a GIF


class FilmCamera(Protocol):
    """A camera that renders a robot, from a plugin in the group `snakesim.films`."""

    def render_picture(
        self,
        position_w: Floats,
        wxyz: Floats,
        angles_rad: Floats,
        look_at_w: Floats,
        arrows_w: list[Floats],
    ) -> Picture:
        """Render the robot at a pose, with arrows (2, 3) from tail to tip. Returns pixels (height, width, 3)."""
        ...

    def close(self) -> None:
        """Free the renderer."""
        ...


Span = tuple[float, float]  # from and to in seconds, since the first tick


def film_run(
    run: Path, out: Path, *, size: tuple[int, int], fps: float, speed: float, span_s: Span
) -> int:
    """Film a run from its folder or recording, and return the exit code. Arguments are as of `film_record`."""
    record = RunRecord.load(run)
    film_record(record, out, size=size, fps=fps, speed=speed, span_s=span_s, print_text=print_line)
    return report_missing_data(run, record.missing)


def film_record(
    record: RunRecord,
    out: Path,
    *,
    size: tuple[int, int],
    fps: float,
    speed: float,
    span_s: Span,
    print_text: PrintLine,
) -> None:
    """Film the record of a run.

    Args:
        record: The recorded run.
        out: Path of the film, an .mp4 or .gif file.
        size: Width and height in pixels.
        fps: Frames per second of the film.
        speed: Robot time divided by film time.
        span_s: Start and end of the filmed part, in s since the first tick.
        print_text: Prints a line.

    Raises:
        ConfigError: The record has no pose, `out` is not a film, or a package for films is not installed.
    """
    if out.suffix not in (".mp4", ".gif"):
        raise ConfigError(
            f"--out {out}: give a file that ends in .mp4 or .gif", code="command/invalid-option"
        )
    extras.require_extra("report", "a film")
    times_s = choose_frame_times_s(record, fps, speed, span_s)
    frame_period_s = speed / fps
    for sentence in describe_frozen_spans(times_s, frame_period_s, record.config.period_ns * 1e-9):
        print_text(sentence)
    camera: FilmCamera = load_plugin(FILMS, "mujoco")(record.config, *size)
    progress_step = max(round(PROGRESS_STEP * len(times_s)), 1)
    with (
        contextlib.closing(camera),
        export_atomically(out) as partial,
        _open_film_writer(partial, size, fps, record.missing) as write,
    ):
        look_at_w = _find_body_center_w(record, record.find_nearest_row(times_s[0]))
        for i, time_s in enumerate(times_s):
            row = record.find_nearest_row(time_s)
            look_at_w = look_at_w + (_find_body_center_w(record, row) - look_at_w) * min(
                frame_period_s / FOLLOW_TIME_CONSTANT_S, 1.0
            )
            picture = camera.render_picture(
                record.position_w_m[row],
                record.orientation_wxyz[row],
                record.angle_rad[row],
                look_at_w,
                _make_force_arrows(record, time_s),
            )
            write(picture)
            count = i + 1
            if count % progress_step == 0:
                print_text(f"{100 * count // len(times_s)} %: {count} of {len(times_s)} pictures")
    print_text(f"{out}: {len(times_s) / fps:.1f} s, {out.stat().st_size / 1e6:.2f} MB")


def _find_body_center_w(record: RunRecord, row: int) -> Floats:
    nodes = record.find_body_points_w(row)
    assert nodes is not None
    return nodes.mean(axis=0)


def choose_frame_times_s(record: RunRecord, fps: float, speed: float, span_s: Span) -> Floats:
    """Choose the robot time of the pose that each frame of a film shows.

    A frame shows the newest known pose. During a gap in the record the last pose before the gap is repeated.

    Args:
        record: The recorded run.
        fps: Frames per second of the film.
        speed: Robot time divided by film time; 2 plays twice as fast.
        span_s: Start and end of the part to film, in s since the first tick.

    Returns:
        (frames,) times in s.

    Raises:
        ConfigError: The record has no pose, or none within the span.
    """
    pose_times_s = record.time_s[record.has_pose]
    if not len(pose_times_s):
        raise ConfigError(
            f"{record.path}: the pose of the robot is not in this record, so there is nothing to film",
            code="recording/missing-data",
        )
    first_tick_s = float(record.time_s[0])
    from_s, to_s = span_s
    start_s = max(float(pose_times_s[0]), first_tick_s + from_s)
    end_s = min(float(pose_times_s[-1]), first_tick_s + to_s)
    if end_s <= start_s:
        duration_s = pose_times_s[-1] - pose_times_s[0]
        raise ConfigError(
            f"--from {from_s:g} --to {to_s:g}: the run has poses for {duration_s:.2f} s",
            code="command/invalid-option",
        )
    frame_times_s = np.arange(start_s, end_s, speed / fps)
    # Keeps rounding from selecting the tick before.
    half_tick_s = 0.5 * record.config.period_ns * 1e-9
    newest = np.searchsorted(pose_times_s, frame_times_s + half_tick_s, side="right") - 1
    return pose_times_s[newest]


def describe_frozen_spans(times_s: Floats, frame_period_s: float, period_s: float) -> list[str]:
    """Describe by a sentence each interval in which the film is frozen because no pose is recorded.

    Args:
        times_s: (frames,) robot time of the pose in each frame, in s.
        frame_period_s: Robot time between frames, in s.
        period_s: Robot time between ticks, in s.
    """
    sentences: list[str] = []
    for before_s, after_s in pairwise(np.unique(times_s).tolist()):
        if after_s - before_s > frame_period_s + 1.5 * period_s:
            sentences.append(
                f"no pose is recorded between {before_s:.2f} and {after_s:.2f} s of robot time; the film is frozen"
            )
    return sentences


def _make_force_arrows(record: RunRecord, time_s: float) -> list[Floats]:
    """Make an arrow for each contact force at a robot time: tail and tip in the world, (2, 3)."""
    recent = [
        world
        for world in record.worlds
        if 0 <= time_s - world.timestamp_ns * 1e-9 < MAX_WORLD_AGE_S
    ]
    if not recent:
        return []
    arrows: list[Floats] = []
    for contact in recent[-1].contacts:
        tail_w = np.array(contact.position_w)
        force_w = np.array(contact.force_w)
        if np.linalg.norm(force_w) > MIN_FORCE_N:
            arrows.append(np.stack([tail_w, tail_w + ARROW_M_PER_N * force_w]))
    return arrows


def _check_frame_count(path: Path, pictures: int) -> None:
    """Raise OSError if a film does not have all its frames.

    The encoder is another process, whose failure is not reported otherwise.
    """
    import imageio_ffmpeg

    try:
        written, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
    except RuntimeError:
        written = 0
    if written != pictures:
        raise OSError(
            f"the encoder has failed, after {written} of {pictures} pictures; the disk may be full"
        )


@contextlib.contextmanager
def _open_film_writer(
    out: Path, size: tuple[int, int], fps: float, missing: Sequence[str]
) -> Iterator[WriteFrame]:
    """Open a film for writing: yield a function that appends a frame. The comment of the film lists missing data."""
    comment = f"incomplete: {'; '.join(missing)}" if missing else ""
    if out.suffix == ".mp4":
        with _open_mp4(out, size, fps, comment) as write:
            yield write
    else:
        with _open_gif(out, fps, comment) as write:
            yield write


@contextlib.contextmanager
def _open_mp4(out: Path, size: tuple[int, int], fps: float, comment: str) -> Iterator[WriteFrame]:
    """Open an MP4 film for writing: yield a function that appends a frame, and finish the film at the end.

    Args:
        out: Path of the film.
        size: Width and height in pixels.
        fps: Frames per second.
        comment: Comment in the metadata of the film; empty for none.

    Raises:
        OSError: The encoder failed, which shows only at the end.
    """
    import imageio_ffmpeg

    rate: Any = fps  # imageio_ffmpeg annotates an int, but accepts any number
    output_options = None
    if comment:
        output_options = ["-metadata", f"comment={comment}"]
    encoder: Any = imageio_ffmpeg.write_frames(
        str(out), size, fps=rate, macro_block_size=2, quality=7, output_params=output_options
    )
    encoder.send(None)  # starts the generator
    frame_count = 0

    def append_frame(picture: Picture) -> None:
        nonlocal frame_count
        encoder.send(np.ascontiguousarray(picture))
        frame_count += 1

    try:
        yield append_frame
    finally:
        encoder.close()
    _check_frame_count(out, frame_count)


@contextlib.contextmanager
def _open_gif(out: Path, fps: float, comment: str) -> Iterator[WriteFrame]:
    """Open a GIF for writing: yield a function that appends a frame, and write the file at the end.

    All frames share the palette of the first one, so that the file is smaller and colors do not flicker.

    Args:
        out: Path of the film.
        fps: Frames per second.
        comment: Comment in the file, truncated to MAX_COMMENT_BYTES.
    """
    from PIL import Image

    pictures: list[Image.Image] = []
    palette: Image.Image | None = None

    def append_frame(picture: Picture) -> None:
        nonlocal palette
        image = Image.fromarray(picture)
        if palette is None:
            palette = image.quantize(
                GIF_COLORS, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE
            )
        pictures.append(image.quantize(palette=palette, dither=Image.Dither.NONE))

    yield append_frame
    frame_duration_ms = 1000 / fps
    pictures[0].save(
        out,
        save_all=True,
        append_images=pictures[1:],
        duration=frame_duration_ms,
        loop=0,
        optimize=True,
        comment=comment.encode()[:MAX_COMMENT_BYTES],
    )
