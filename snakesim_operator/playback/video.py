"""`snakesim recording video`: a film of a recorded run, as MP4 or GIF, rendered by MuJoCo without a screen."""

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
from snakesim_hal.model.plugins import FILMS, find_plugin
from snakesim_hal.model.textfiles import exported
from snakesim_operator.base import extras
from snakesim_operator.results.missing_data import exit_code
from snakesim_operator.results.run_log import RunRecord

Picture = NDArray[np.uint8]
Write = Callable[[Picture], None]

FOLLOW_S = 0.8  # time constant with which the view follows the snake
M_PER_N = 0.008  # length of an arrow
MIN_FORCE_N = 0.3  # a smaller force is not drawn
MAX_WORLD_AGE_S = 0.3  # older contacts are not drawn
GIF_COLORS = 48
PROGRESS_STEP = 0.25  # progress is printed after each such fraction of the pictures
MAX_COMMENT_BYTES = 250  # of a GIF


class Film(Protocol):
    """A camera that a plugin in the group `snakesim.films` provides."""

    def picture(
        self, position_w: Floats, wxyz: Floats, angles_rad: Floats, look_at_w: Floats, arrows_w: list[Floats]
    ) -> Picture:
        """Render the snake at a pose, (height, width, 3)."""
        ...

    def close(self) -> None:
        """Free the renderer."""
        ...


Span = tuple[float, float]  # from and to in seconds, since the first tick


def video(run: Path, out: Path, *, size: tuple[int, int], fps: float, speed: float, span_s: Span) -> int:
    """Film a run from its folder or recording, and return the exit code. Takes and raises what `film` does."""
    record = RunRecord.load(run)
    film(record, out, size=size, fps=fps, speed=speed, span_s=span_s, print_text=print_line)
    return exit_code(run, record.missing)


def film(
    record: RunRecord,
    out: Path,
    *,
    size: tuple[int, int],
    fps: float,
    speed: float,
    span_s: Span,
    print_text: PrintLine,
) -> None:
    """Film a record.

    Args:
        record: What was recorded of the run.
        out: The film, an .mp4 or .gif file.
        size: Width and height in pixels.
        fps: Pictures a second.
        speed: Robot time over the film's time.
        span_s: The part of the run that is filmed, from and to, since the first tick.
        print_text: Prints a line.

    Raises:
        ConfigError: The record has no pose, `out` is no film, or something that a film needs is not installed.
    """
    if out.suffix not in (".mp4", ".gif"):
        raise ConfigError(f"--out {out}: give a file that ends in .mp4 or .gif", code="command/invalid-option")
    extras.require("report", "a film")
    times = times_of_pictures(record, fps, speed, span_s)
    picture_s = speed / fps
    for sentence in standstills_in_words(times, picture_s, record.config.period_ns * 1e-9):
        print_text(sentence)
    camera: Film = find_plugin(FILMS, "mujoco")(record.config, *size)
    progress_step = max(round(PROGRESS_STEP * len(times)), 1)
    with (
        contextlib.closing(camera),
        exported(out) as partial,
        _open_writer(partial, size, fps, record.missing) as write,
    ):
        look_at = _center(record, record.row_at(times[0]))
        for i, time_s in enumerate(times):
            row = record.row_at(time_s)
            look_at = look_at + (_center(record, row) - look_at) * min(picture_s / FOLLOW_S, 1.0)
            picture = camera.picture(
                record.position_w_m[row],
                record.orientation_wxyz[row],
                record.angle_rad[row],
                look_at,
                _force_arrows(record, time_s),
            )
            write(picture)
            count = i + 1
            if count % progress_step == 0:
                print_text(f"{100 * count // len(times)} %: {count} of {len(times)} pictures")
    print_text(f"{out}: {len(times) / fps:.1f} s, {out.stat().st_size / 1e6:.2f} MB")


def _center(record: RunRecord, row: int) -> Floats:
    nodes = record.nodes_w(row)
    assert nodes is not None
    return nodes.mean(axis=0)


def times_of_pictures(record: RunRecord, fps: float, speed: float, span_s: Span) -> Floats:
    """Return the robot time of the pose that each picture of a film shows.

    A picture shows the newest known pose. During a gap in the record the last pose before the gap is repeated.

    Args:
        record: The recorded run.
        fps: Pictures per second of the film.
        speed: Robot time divided by film time; 2 plays twice as fast.
        span_s: Start and end of the part to film, in s since the first tick.

    Returns:
        (pictures,) times in s.

    Raises:
        ConfigError: The record has no pose, or none within the span.
    """
    known_s = record.time_s[record.posed]
    if not len(known_s):
        raise ConfigError(
            f"{record.folder}: the pose of the robot is not in this record, so there is nothing to film",
            code="recording/missing-data",
        )
    first_tick_s = float(record.time_s[0])
    from_s, to_s = span_s
    start_s = max(float(known_s[0]), first_tick_s + from_s)
    end_s = min(float(known_s[-1]), first_tick_s + to_s)
    if end_s <= start_s:
        duration_s = known_s[-1] - known_s[0]
        raise ConfigError(
            f"--from {from_s:g} --to {to_s:g}: the run has poses for {duration_s:.2f} s",
            code="command/invalid-option",
        )
    picture_times_s = np.arange(start_s, end_s, speed / fps)
    half_tick_s = 0.5 * record.config.period_ns * 1e-9  # keeps rounding from selecting the tick before
    newest = np.searchsorted(known_s, picture_times_s + half_tick_s, side="right") - 1
    return known_s[newest]


def standstills_in_words(times_s: Floats, picture_s: float, period_s: float) -> list[str]:
    """Return a sentence for each time in which the film is frozen because no pose is recorded.

    Args:
        times_s: Robot time of the pose in each picture.
        picture_s: Robot time from picture to picture.
        period_s: Robot time from tick to tick.
    """
    sentences: list[str] = []
    for before_s, after_s in pairwise(np.unique(times_s).tolist()):
        if after_s - before_s > picture_s + 1.5 * period_s:
            sentences.append(
                f"no pose is recorded between {before_s:.2f} and {after_s:.2f} s of robot time; the film is frozen"
            )
    return sentences


def _force_arrows(record: RunRecord, time_s: float) -> list[Floats]:
    """Return an arrow for each contact force at a time, (2, 3): from where to where in the world."""
    recent = [world for world in record.worlds if 0 <= time_s - world.timestamp_ns * 1e-9 < MAX_WORLD_AGE_S]
    if not recent:
        return []
    arrows: list[Floats] = []
    for contact in recent[-1].contacts:
        foot = np.array(contact.position_w)
        force = np.array(contact.force_w)
        if np.linalg.norm(force) > MIN_FORCE_N:
            arrows.append(np.stack([foot, foot + M_PER_N * force]))
    return arrows


def _check_film(path: Path, pictures: int) -> None:
    """Raise OSError for a film that is not whole: the encoder is another process, whose failure is not reported."""
    import imageio_ffmpeg

    try:
        written, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
    except RuntimeError:
        written = 0
    if written != pictures:
        raise OSError(f"the encoder has failed, after {written} of {pictures} pictures; the disk may be full")


@contextlib.contextmanager
def _open_writer(out: Path, size: tuple[int, int], fps: float, missing: Sequence[str]) -> Iterator[Write]:
    """Yield a function that appends a picture to a film. The film's comment names what the record does not hold."""
    comment = f"incomplete: {'; '.join(missing)}" if missing else ""
    if out.suffix == ".mp4":
        with _open_mp4(out, size, fps, comment) as write:
            yield write
    else:
        with _open_gif(out, fps, comment) as write:
            yield write


@contextlib.contextmanager
def _open_mp4(out: Path, size: tuple[int, int], fps: float, comment: str) -> Iterator[Write]:
    """Yield a function that appends a picture to an MP4 film, and finish the film at the end.

    Args:
        out: The film's file.
        size: Width and height in pixels.
        fps: Pictures per second.
        comment: Comment in the film's metadata; empty: none.

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
    picture_count = 0

    def append_picture(picture: Picture) -> None:
        nonlocal picture_count
        encoder.send(np.ascontiguousarray(picture))
        picture_count += 1

    try:
        yield append_picture
    finally:
        encoder.close()
    _check_film(out, picture_count)


@contextlib.contextmanager
def _open_gif(out: Path, fps: float, comment: str) -> Iterator[Write]:
    """Yield a function that appends a picture to a GIF, and write the file at the end.

    All pictures share the palette of the first one: the file is smaller, and the colors do not flicker.

    Args:
        out: The film's file.
        fps: Pictures per second.
        comment: Comment in the file, cut to MAX_COMMENT_BYTES.
    """
    from PIL import Image

    pictures: list[Image.Image] = []
    palette: Image.Image | None = None

    def append_picture(picture: Picture) -> None:
        nonlocal palette
        image = Image.fromarray(picture)
        if palette is None:
            palette = image.quantize(GIF_COLORS, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
        pictures.append(image.quantize(palette=palette, dither=Image.Dither.NONE))

    yield append_picture
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
