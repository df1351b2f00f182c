"""Reads a run's folder: configuration, description, black box, host's record, recording."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.kinematics import find_nodes_w
from snakesim_hal.model.route import Route
from snakesim_hal.model.scenario import RunConfig, place_obstacles, read_config
from snakesim_hal.model.scene import Placed, make_route
from snakesim_hal.run_log.black_box import Layout, compute_digest, read_black_box
from snakesim_hal.run_log.host_record import BLACK_BOX, DESCRIPTION, HOST_RECORD, HostRecord
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import UNDECODABLE
from snakesim_hal.wire.messages import ControlState, Description, Trajectory, World
from snakesim_operator.recording.message import RECORDING, RecordedMessage
from snakesim_operator.results.missing_data import describe_undecodable, describe_unwritten, replace_invalid_numbers
from snakesim_operator.results.recording_contents import OUTPUTS, Contents, read_recording

CONFIG = "config.json"
SUMMARY = "summary.json"
REPORT = "report.html"
GIVE = "give the folder that `snakesim run` left, such as runs/demo, or a recording"
UNRECORDED = "without a recording, what control, navigation and guidance reported is unknown"

Hear = Callable[[RecordedMessage], None]
DAMAGED = (*UNDECODABLE, OSError, MemoryError)


@dataclass(frozen=True, eq=False)
class RunRecord:
    """The record of a run. Every array has one row a tick."""

    folder: Path
    config: RunConfig
    description: Description
    host: HostRecord
    control: list[ControlState]  # in time order, a few a second and at every change
    worlds: list[World]  # in time order, a few a second
    trajectories: list[Trajectory]  # in time order, one for each path
    time_s: Floats  # (n,) robot time
    angle_rad: Floats  # (n, joints)
    velocity_rad_s: Floats
    torque_nm: Floats
    mode: NDArray[np.int8]  # (n, joints), values of messages.Mode
    target: Floats  # (n, joints), in the unit of the mode
    torque_limit_nm: Floats
    position_w: Floats  # (n, 3) of the base; NaN when unknown, as all values here
    orientation_wxyz: Floats  # (n, 4)
    contact_peak_n: Floats  # (n,) strongest contact, mean over 50 ms
    contact_count: Floats  # (n,) obstacles touched
    searched_nodes: dict[int, int] = field(default_factory=dict[int, int])  # tick of a turn of navigation -> work in it
    own: dict[str, Floats] = field(default_factory=dict[str, Floats])  # of sensors with a message of their own
    lacks: list[str] = field(default_factory=list[str])  # missing data, as text
    unreached: list[str] = field(default_factory=list[str])  # of these: what never came to the recorder
    replay_of: str = ""  # the recording whose sensors its services were given; empty: a run
    alone: bool = False  # `folder` is a recording, without the run's other files
    whole: bool = True  # that recording has an end

    @staticmethod
    def load(folder: Path, host: HostRecord | None = None, hear: Hear | None = None) -> "RunRecord":
        """Read a run's folder, also of a run that was killed, or a recording.

        Args:
            folder: The folder or the recording.
            host: The host's statistics, if known from elsewhere; None: from the folder.
            hear: Called with every message of the recording.

        Raises:
            ConfigError: It is neither of both, or damaged.
        """
        if folder.is_file():
            return RunRecord._load_recording_alone(folder, host, hear)
        if not (folder / BLACK_BOX).exists() and (folder / RECORDING).is_file():
            return RunRecord._load_recording_alone(folder / RECORDING, host, hear)
        if not folder.exists():
            raise ConfigError(f"{folder}: no such folder; {GIVE}")
        needed = [CONFIG, BLACK_BOX, DESCRIPTION]
        if host is None:
            needed.append(HOST_RECORD)
        for name in needed:
            if not (folder / name).is_file():
                raise ConfigError(f"{folder} is not the folder of a run: {name} is missing; {GIVE}")
        try:
            return RunRecord._load_folder(folder, host, hear)
        except ConfigError:
            raise
        except DAMAGED as error:
            why = f"{type(error).__name__}: {error}"[:300]
            raise ConfigError(f"{folder}: the record of this run is damaged ({why}); run it again") from None

    @staticmethod
    def _load_folder(folder: Path, host: HostRecord | None, hear: Hear | None) -> "RunRecord":
        config = read_config(folder / CONFIG)
        description = msgspec.json.decode((folder / DESCRIPTION).read_bytes(), type=Description)
        layout, columns = read_black_box(folder / BLACK_BOX)
        if layout != Layout.for_robot(description):
            raise ConfigError(f"{folder / BLACK_BOX} is of another robot than {DESCRIPTION} beside it")
        if host is None:
            host = msgspec.json.decode((folder / HOST_RECORD).read_bytes(), type=HostRecord)
        if host.ended == "running":
            host = msgspec.structs.replace(host, ticks=len(columns["tick"]), command_digest=compute_digest(columns))
        path = folder / RECORDING
        if path.is_file():
            contents = read_recording(path, OUTPUTS, hear)
            contents.unreached = contents.missing(len(columns["tick"]))
        else:
            contents = Contents(path, lacks=[UNRECORDED])
        return RunRecord._assemble(folder, config, description, host, contents, columns)

    @staticmethod
    def _load_recording_alone(path: Path, host: HostRecord | None, hear: Hear | None) -> "RunRecord":
        """Load a recording without the run's other files: a full disk may have had no room for them."""
        contents = read_recording(path, hear=hear)
        description = contents.description
        if description is None or contents.config is None:
            why = "; ".join(contents.lacks) or "was it recorded beside a HAL host?"
            raise ConfigError(f"{path}: holds no hal/description and hal/config; {why}")
        try:
            config = msgspec.json.decode(contents.config.content, type=RunConfig)
        except UNDECODABLE as error:
            raise ConfigError(f"{path}: its hal/config cannot be read: {str(error)[:200]}") from None
        columns = contents.columns(description)
        if host is None:
            host = contents.host(columns)
        return RunRecord._assemble(path, config, description, host, contents, columns)

    @staticmethod
    def _assemble(
        folder: Path,
        config: RunConfig,
        description: Description,
        host: HostRecord,
        contents: Contents,
        columns: dict[str, NDArray[Any]],
    ) -> "RunRecord":
        """Make a record of its parts: remove invalid numbers, and collect what is missing."""
        lost_ticks = max(host.lost_ticks, host.ticks - len(columns["tick"]))
        host = msgspec.structs.replace(host, lost_ticks=lost_ticks)
        has_pose = config.robot.sensors.pose is not None
        cleaned_columns, lacks = replace_invalid_numbers(columns, description, has_pose=has_pose)
        control = contents.streams[keys.CONTROL_STATE]
        while control and control[-1].state == "PowerOff":  # the host has ended, so its clock is expected to stop
            control.pop()
        refused_before = contents.refused.copy()
        own = contents.own_columns(description, cleaned_columns["time_s"])
        lacks += describe_undecodable(contents.refused - refused_before)
        del cleaned_columns["tick"]
        return RunRecord(
            folder=folder,
            config=config,
            description=description,
            host=host,
            control=control,
            worlds=contents.streams[keys.WORLD],
            trajectories=contents.streams[keys.TRAJECTORY],
            **cleaned_columns,
            own=own,
            searched_nodes=contents.searched_nodes,
            lacks=lacks + describe_unwritten(host) + contents.unreached + contents.lacks,
            unreached=contents.unreached,
            replay_of=contents.replay_of,
            alone=folder == contents.path,
            whole=contents.whole,
        )

    @cached_property
    def route(self) -> Route | None:
        """The route through the scene; None if it has none."""
        return make_route(self.config.scene)

    @cached_property
    def placed(self) -> list[Placed]:
        """The obstacles, each at its place in the scene."""
        return place_obstacles(self.config)

    @cached_property
    def feels_contacts(self) -> bool:
        """Whether the robot had contact sensors; its file may list some that its drives do not have."""
        return any(sensor.key == keys.CONTACTS for sensor in self.description.sensors)

    @cached_property
    def ticks(self) -> NDArray[np.int64]:
        """The tick of each row, (n,)."""
        return np.rint(self.time_s * 1e9 / self.description.period_ns).astype(np.int64)

    @cached_property
    def stretches(self) -> list[NDArray[np.int64]]:
        """The row numbers between the record's gaps: within a stretch every tick follows the one before."""
        rows = np.arange(len(self.ticks))
        if not len(rows):
            return []
        after_a_gap = np.flatnonzero(np.diff(self.ticks) > 1) + 1
        return np.split(rows, after_a_gap)

    def row_at(self, time_s: float) -> int:
        """Return the row whose time is nearest."""
        return int(np.argmin(np.abs(self.time_s - time_s)))

    @cached_property
    def posed(self) -> NDArray[np.bool_]:
        """A mask of the rows in which the pose and all angles are known, (n,)."""
        signals = (self.position_w, self.orientation_wxyz, self.angle_rad)
        return np.logical_and.reduce([np.isfinite(signal).all(axis=1) for signal in signals])

    def nodes_w(self, row: int) -> Floats | None:
        """Return tail end, joints and head end in the world, (joints + 2, 3), or None if the pose is unknown."""
        if len(self.time_s) == 0 or not self.posed[row]:
            return None
        return find_nodes_w(self.description, self.position_w[row], self.orientation_wxyz[row], self.angle_rad[row])
