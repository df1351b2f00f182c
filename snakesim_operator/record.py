"""What a run leaves in its folder, read back: configuration, description, black box, host's record, telemetry."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from snakesim_hal import keys
from snakesim_hal.errors import ConfigError
from snakesim_hal.host_process import BLACK_BOX, DESCRIPTION, HOST_RECORD, HostRecord
from snakesim_hal.kinematics import link_frames, rotation_from_quaternion
from snakesim_hal.messages import ControlState, Description, World
from snakesim_hal.route import Route
from snakesim_hal.scenario import RunConfig, read
from snakesim_hal.scene import route_of

CONFIG = "config.json"
TELEMETRY = "telemetry.jsonl"
SUMMARY = "summary.json"
REPORT = "report.html"

Floats = NDArray[np.float64]


class TelemetryLine(msgspec.Struct, frozen=True):
    """One line of the telemetry file."""

    key: str
    message: msgspec.Raw


@dataclass(frozen=True)
class RunRecord:
    """A run, as its folder tells it. Every array has one row a tick."""

    folder: Path
    config: RunConfig
    description: Description
    host: HostRecord
    control: list[ControlState]  # in time order, a few a second and at every change
    worlds: list[World]  # in time order, a few a second
    time_s: Floats  # (n,) robot time
    angle_rad: Floats  # (n, joints)
    velocity_rad_s: Floats
    torque_nm: Floats
    mode: NDArray[np.int8]  # (n, joints), values of messages.Mode
    target: Floats  # (n, joints), in the unit of the mode
    torque_limit_nm: Floats
    position_w: Floats  # (n, 3) of the base; NaN when the robot has no pose sensor
    orientation_wxyz: Floats  # (n, 4)
    contact_peak_n: Floats  # (n,) strongest contact
    contact_count: Floats  # (n,) obstacles touched

    @staticmethod
    def load(folder: Path) -> "RunRecord":
        """Read a run's folder. Raises ConfigError when it is none."""
        for name in (CONFIG, BLACK_BOX, HOST_RECORD, DESCRIPTION):
            if not (folder / name).is_file():
                raise ConfigError(f"{folder} is not the folder of a run: {name} is missing")
        with np.load(folder / BLACK_BOX, allow_pickle=False) as archive:
            columns: dict[str, Any] = {name: archive[name] for name in archive.files}
        control: list[ControlState] = []
        worlds: list[World] = []
        for line in _lines(folder / TELEMETRY):
            if line.key == keys.CONTROL_STATE:
                control.append(msgspec.json.decode(line.message, type=ControlState))
            elif line.key == keys.WORLD:
                worlds.append(msgspec.json.decode(line.message, type=World))
        return RunRecord(
            folder=folder,
            config=read(folder / CONFIG),
            description=msgspec.json.decode((folder / DESCRIPTION).read_bytes(), type=Description),
            host=msgspec.json.decode((folder / HOST_RECORD).read_bytes(), type=HostRecord),
            control=control,
            worlds=worlds,
            **columns,
        )

    @cached_property
    def route(self) -> Route | None:
        """The route through the scene."""
        return route_of(self.config.scene)

    def row_at(self, time_s: float) -> int:
        """The row whose time is nearest."""
        return int(np.argmin(np.abs(self.time_s - time_s)))

    def nodes_w(self, row: int) -> Floats | None:
        """Tail end, joints and head end in the world, (joints + 2, 3); None when the pose is unknown."""
        if len(self.time_s) == 0 or np.isnan(self.position_w[row]).any():
            return None
        lengths = [link.length_m for link in self.description.links]
        rotation = rotation_from_quaternion(self.orientation_wxyz[row])
        axes = [joint.axis for joint in self.description.joints]
        origins, rotations = link_frames(self.position_w[row], rotation, self.angle_rad[row], axes, lengths)
        return np.vstack([origins, origins[-1] + lengths[-1] * rotations[-1][:, 0]])


def _lines(path: Path) -> list[TelemetryLine]:
    if not path.is_file():
        return []
    decoder = msgspec.json.Decoder(TelemetryLine)
    return [decoder.decode(line) for line in path.read_bytes().splitlines() if line.strip()]
