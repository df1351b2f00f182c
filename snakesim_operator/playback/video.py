"""`snakesim video`: a film of a recorded run, as MP4 or GIF, rendered by MuJoCo without a screen."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import Say, say
from snakesim_hal.model.plugins import FILMS, find_plugin
from snakesim_hal.model.textfiles import exported
from snakesim_operator.base import extras
from snakesim_operator.results.missing_data import exit_code
from snakesim_operator.results.record import RunRecord

Picture = NDArray[np.uint8]
Write = Callable[[Picture], None]

FOLLOW_S = 0.8  # how slowly the view follows the snake
M_PER_N, MIN_FORCE_N = 0.008, 0.3
WORLD_LIMIT_S = 0.3  # older contacts are not drawn
COLOURS = 48  # of a GIF
TOLD_SHARE = 0.25
LONGEST_COMMENT = 250  # bytes, in a GIF


class Film(Protocol):
    """What a plugin in the group `snakesim.films` makes."""

    def picture(
        self, position_w: Floats, wxyz: Floats, angles_rad: Floats, look_at_w: Floats, arrows_w: list[Floats]
    ) -> Picture:
        """The snake at a pose, (height, width, 3)."""
        ...

    def close(self) -> None:
        """Free the renderer."""
        ...


Span = tuple[float, float]  # from and to in seconds, since the first tick


def video(run: Path, out: Path, *, size: tuple[int, int], fps: float, speed: float, span_s: Span) -> int:
    """Film a run. Raises ConfigError for one without poses, and when something that it needs is not installed."""
    record = RunRecord.load(run)
    film(record, out, size=size, fps=fps, speed=speed, span_s=span_s, say=say)
    return exit_code(run, record.lacks)


def film(
    record: RunRecord, out: Path, *, size: tuple[int, int], fps: float, speed: float, span_s: Span, say: Say
) -> None:
    """Film a record. Raises ConfigError, as `video` does."""
    if out.suffix not in (".mp4", ".gif"):
        raise ConfigError(f"--out {out}: give a file that ends in .mp4 or .gif")
    extras.check("video", "a film")
    times = times_of_pictures(record, fps, speed, span_s)
    for sentence in standstills_in_words(times, speed / fps, record.config.period_ns * 1e-9):
        say(sentence)
    camera: Film = find_plugin(FILMS, "mujoco")(record.config, *size)
    with contextlib.closing(camera), exported(out) as partial, _written(partial, size, fps, record.lacks) as write:
        middle = _center(record, record.row_at(times[0]))
        for i, time_s in enumerate(times):
            row = record.row_at(time_s)
            pose = record.position_w[row], record.orientation_wxyz[row], record.angle_rad[row]
            middle = middle + (_center(record, row) - middle) * min(speed / fps / FOLLOW_S, 1.0)
            write(camera.picture(*pose, middle, _forces(record, time_s)))
            if (i + 1) % max(round(TOLD_SHARE * len(times)), 1) == 0:
                say(f"{100 * (i + 1) // len(times)} %: {i + 1} of {len(times)} pictures")
    say(f"{out}: {len(times) / fps:.1f} s, {out.stat().st_size / 1e6:.2f} MB")


def _center(record: RunRecord, row: int) -> Floats:
    nodes = record.nodes_w(row)
    assert nodes is not None
    return nodes.mean(axis=0)


def times_of_pictures(record: RunRecord, fps: float, speed: float, span_s: Span) -> Floats:
    """Robot time of the pose in each picture. In a gap the last pose before it stays: the next one came only later."""
    known = record.time_s[record.posed]
    if not len(known):
        raise ConfigError(f"{record.folder}: the pose of the robot is not in this record, so there is nothing to film")
    first = max(float(known[0]), float(record.time_s[0]) + span_s[0])
    last = min(float(known[-1]), float(record.time_s[0]) + span_s[1])
    if last <= first:
        lasts_s = known[-1] - known[0]
        raise ConfigError(f"--from {span_s[0]:g} --to {span_s[1]:g}: the run has poses for {lasts_s:.2f} s")
    wanted = np.arange(first, last, speed / fps)
    rounding_s = 0.5 * record.config.period_ns * 1e-9
    newest = np.searchsorted(known, wanted + rounding_s, side="right") - 1
    return known[newest]


def standstills_in_words(times_s: Floats, picture_s: float, period_s: float) -> list[str]:
    """Returns a sentence for each time in which the film stands still because no pose is recorded.

    times_s: of the pose in each picture; picture_s: robot time from picture to picture.
    """
    sentences: list[str] = []
    for before_s, after_s in pairwise(np.unique(times_s).tolist()):
        if after_s - before_s > picture_s + 1.5 * period_s:
            sentences.append(
                f"no pose is recorded between {before_s:.2f} and {after_s:.2f} s of robot time; the film stands still"
            )
    return sentences


def _forces(record: RunRecord, time_s: float) -> list[Floats]:
    """Arrows of the contact forces then."""
    recent = [world for world in record.worlds if 0 <= time_s - world.timestamp_ns * 1e-9 < WORLD_LIMIT_S]
    if not recent:
        return []
    found: list[Floats] = []
    for contact in recent[-1].contacts:
        at, force = np.array(contact.position_w), np.array(contact.force_w)
        if np.linalg.norm(force) > MIN_FORCE_N:
            found.append(np.stack([at, at + M_PER_N * force]))
    return found


def _check_film(path: Path, pictures: int) -> None:
    """Raise OSError for a film that is not whole: the encoder is another process, whose failure is not reported."""
    import imageio_ffmpeg

    try:
        found, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
    except RuntimeError:
        found = 0
    if found != pictures:
        raise OSError(f"the encoder has failed, after {found} of {pictures} pictures; the disk may be full")


@contextlib.contextmanager
def _written(out: Path, size: tuple[int, int], fps: float, lacks: Sequence[str]) -> Iterator[Write]:
    import imageio_ffmpeg
    from PIL import Image

    comment = f"incomplete: {'; '.join(lacks)}" if lacks else ""
    if out.suffix == ".mp4":
        rate: Any = fps  # annotated as int, but any number will do
        said = ["-metadata", f"comment={comment}"] if comment else None
        writer: Any = imageio_ffmpeg.write_frames(
            str(out), size, fps=rate, macro_block_size=2, quality=7, output_params=said
        )
        writer.send(None)
        sent = 0

        def send(picture: Picture) -> None:
            nonlocal sent
            writer.send(np.ascontiguousarray(picture))
            sent += 1

        try:
            yield send
        finally:
            writer.close()
        _check_film(out, sent)
        return
    pictures: list[Image.Image] = []
    palette: list[Image.Image] = []  # of the first picture, for all: less to store, and no flicker

    def keep(picture: Picture) -> None:
        image = Image.fromarray(picture)
        if not palette:
            palette.append(image.quantize(COLOURS, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE))
        pictures.append(image.quantize(palette=palette[0], dither=Image.Dither.NONE))

    yield keep
    pictures[0].save(
        out,
        save_all=True,
        append_images=pictures[1:],
        duration=1000 / fps,
        loop=0,
        optimize=True,
        comment=comment.encode()[:LONGEST_COMMENT],
    )
