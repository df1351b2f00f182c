"""Depth images from a file, again and again: lines as `snakesim echo sensor/depth/head > head.jsonl` prints them."""

import bisect
from itertools import pairwise
from typing import Annotated

import msgspec
from msgspec import Meta

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import FileStruct, expanded
from snakesim_hal.model.sensors import DepthCamera
from snakesim_hal.wire.messages import DepthImage
from snakesim_sim_backend.sensors.scope import Scope

MAX_BYTES = 500_000_000  # of a recording: it is kept in memory


class Line(msgspec.Struct, frozen=True):
    """A line of the file."""

    message: DepthImage


class RecordedDepth:
    """The image that was measured as long after the first one as the robot's time is; from the start at the end."""

    class Settings(FileStruct, frozen=True):
        """Which file."""

        file: Annotated[str, Meta(min_length=1)]

    message = DepthImage

    def __init__(self, camera: DepthCamera, scope: Scope, settings: Settings) -> None:
        """Raises ConfigError."""
        self._images = _read(settings.file, camera)
        self._link = scope.config.robot.link_index(camera.link)
        self._after_ns = [image.timestamp_ns - self._images[0].timestamp_ns for image in self._images]
        steps = len(self._after_ns) - 1
        self._lasts_ns = self._after_ns[-1] + (self._after_ns[-1] // steps if steps else 1)

    def read(self, tick: int, timestamp_ns: int) -> DepthImage:
        """An image, as if measured now, on the link of the robot file."""
        i = bisect.bisect_right(self._after_ns, timestamp_ns % self._lasts_ns) - 1
        return msgspec.structs.replace(self._images[i], tick=tick, timestamp_ns=timestamp_ns, link=self._link)


def _read(file: str, camera: DepthCamera) -> list[DepthImage]:
    path, decoder = expanded(file), msgspec.json.Decoder(Line)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ConfigError(f"{file}: {path.stat().st_size} bytes, at most {MAX_BYTES}; record for a shorter time")
        images = [decoder.decode(line).message for line in path.read_bytes().splitlines()]
    except (OSError, msgspec.DecodeError) as error:
        raise ConfigError(
            f"the recording of camera {camera.name!r}, {file}, cannot be read: {error}; "
            f"make one with `snakesim echo sensor/depth/{camera.name} > {file}`"
        ) from error
    flawed = any(2 * image.width * image.height != len(image.depth) for image in images)
    in_order = all(image.timestamp_ns < later.timestamp_ns for image, later in pairwise(images))
    if not images or flawed or not in_order:
        why = "some images are not whole" if flawed else "its stamps do not increase" if images else "it is empty"
        raise ConfigError(f"the recording of camera {camera.name!r}, {file}, cannot be used: {why}")
    return images
