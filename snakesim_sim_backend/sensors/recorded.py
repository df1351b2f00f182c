"""Replays depth images from a file, made by `snakesim topic echo sensor/depth/head > head.jsonl`."""

import bisect
from itertools import pairwise
from typing import Annotated

import msgspec
from msgspec import Meta

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import FileStruct, expand_home
from snakesim_hal.model.robot_file.sensor_model import SensorModel
from snakesim_hal.model.robot_file.sensors import DepthCamera
from snakesim_hal.wire.messages import DepthImage
from snakesim_sim_backend.sensors.scope import SensorScope

MAX_BYTES = 500_000_000  # of a recording: it is kept in memory


class RecordedLine(msgspec.Struct, frozen=True):
    """A line of the file."""

    message: DepthImage


class RecordedDepth(SensorModel):
    """Plays a recording by the robot's time, and begins again at its end."""

    class Settings(FileStruct, frozen=True):
        """The recording."""

        file: Annotated[str, Meta(min_length=1)]
        """File of the recording, with lines as `snakesim topic echo sensor/depth/NAME` prints them."""

    message = DepthImage

    def __init__(self, camera: DepthCamera, scope: SensorScope, settings: Settings) -> None:
        """Read the recording.

        Raises:
            ConfigError: The file cannot be read, or cannot be played.
        """
        self._images = _read_images(settings.file, camera)
        self._link = scope.config.robot.link_index(camera.link)
        first_ns = self._images[0].timestamp_ns
        self._times_ns = [image.timestamp_ns - first_ns for image in self._images]
        # The last image lasts as long as the others do on average.
        steps = len(self._times_ns) - 1
        last_image_ns = self._times_ns[-1] // steps if steps else 1
        self._duration_ns = self._times_ns[-1] + last_image_ns

    def read(self, tick: int, timestamp_ns: int) -> DepthImage:
        """Return the image of this time, as if measured now, on the link of the robot file."""
        i = bisect.bisect_right(self._times_ns, timestamp_ns % self._duration_ns) - 1
        return msgspec.structs.replace(
            self._images[i], tick=tick, timestamp_ns=timestamp_ns, link=self._link
        )


def _read_images(file: str, camera: DepthCamera) -> list[DepthImage]:
    """Read the recorded images of a depth camera, one JSON message for each line.

    Args:
        file: Path of the recording.
        camera: Entry of the camera in the robot file, for messages.

    Returns:
        The images in their order.

    Raises:
        ConfigError: The file cannot be read, is too large, or has images that cannot be used.
    """
    path = expand_home(file)
    decoder = msgspec.json.Decoder(RecordedLine)
    try:
        byte_count = path.stat().st_size
        if byte_count > MAX_BYTES:
            raise ConfigError(
                f"{file}: {byte_count} bytes, at most {MAX_BYTES}; record for a shorter time",
                code="file/too-large",
            )
        images = [decoder.decode(line).message for line in path.read_bytes().splitlines()]
    except (OSError, msgspec.DecodeError) as error:
        raise ConfigError(
            f"the recording of camera {camera.name!r}, {file}, cannot be read: {error}; "
            f"make one with `snakesim topic echo sensor/depth/{camera.name} > {file}`",
            code="recording/not-readable",
        ) from error
    problem = _find_problem(images)
    if problem is not None:
        raise ConfigError(
            f"the recording of camera {camera.name!r}, {file}, cannot be used: {problem}",
            code="recording/not-readable",
        )
    return images


def _find_problem(images: list[DepthImage]) -> str | None:
    """Return a text about why images cannot be played, or None if they can."""
    if any(2 * image.width * image.height != len(image.depth) for image in images):
        return "some images are not whole"
    if not all(image.timestamp_ns < later.timestamp_ns for image, later in pairwise(images)):
        return "its stamps do not increase"
    if not images:
        return "it is empty"
    return None
