"""Loads the record of a run as arrays: a row for each tick, and what guidance, navigation and control published."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.geometry.kinematics import compute_body_points_w
from snakesim_hal.model.geometry.route import Route
from snakesim_hal.model.scenario import RunConfig, place_obstacles
from snakesim_hal.model.scene_file.placement import PlacedObstacle
from snakesim_hal.model.scene_file.scene import make_route
from snakesim_hal.run_log.host_record import HostRecord
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import UNDECODABLE
from snakesim_hal.wire.messages import ControlState, RobotDescription, Trajectory, WorldModel
from snakesim_operator.results.contact_log import ContactCollector, ContactLog
from snakesim_operator.results.missing_data import describe_unwritten_data, replace_invalid_numbers
from snakesim_operator.results.run_ending import COMPLETE
from snakesim_operator.results.run_reader import MessageHandler, RunReader, open_run

READ_ERRORS = (*UNDECODABLE, OSError, MemoryError)


@dataclass(frozen=True, eq=False)
class RunRecord:
    """The record of one run. Every array has one row for each tick since the first arming."""

    # What was run.
    path: Path  # the run's folder, or the recording
    config: RunConfig
    description: RobotDescription
    host: HostRecord

    # What the services published.
    control_states: list[ControlState]  # in time order, a few a second and at every change
    worlds: list[WorldModel]  # in time order, a few a second
    trajectories: list[Trajectory]  # in time order, one for each path

    # The ticks. NaN is unknown.
    time_s: Floats  # (n,) robot time
    angle_rad: Floats  # (n, joints)
    velocity_rad_s: Floats  # (n, joints)
    torque_nm: Floats  # (n, joints)
    mode: NDArray[np.int8]  # (n, joints), values of messages.JointMode
    target: Floats  # (n, joints), in the unit of the mode
    torque_limit_nm: Floats  # (n, joints)
    position_w_m: Floats  # (n, 3) of the base
    orientation_wxyz: Floats  # (n, 4)
    contact_peak_n: Floats  # (n,) strongest contact, mean over 50 ms
    contact_count: Floats  # (n,) obstacles touched

    # More of the recording.
    # By tick of a cycle of navigation.
    searched_nodes_by_tick: dict[int, int] = field(default_factory=dict[int, int])
    # (n,) columns of custom sensors and telemetry.
    custom_columns: dict[str, Floats] = field(default_factory=dict[str, Floats])
    # Contact forces in the recording.
    contact_log: ContactLog = field(default_factory=lambda: ContactCollector().make_log())
    replay_of: str = ""  # recording whose sensors the services read; empty if the run is no replay

    # How much of the run is known.
    ending: str = COMPLETE  # COMPLETE, or a sentence on how the run ended
    missing: list[str] = field(default_factory=list[str])  # sentences about missing data
    # Those of them about data that never reached the recorder.
    recorder_losses: list[str] = field(default_factory=list[str])

    # Files.
    config_path: Path | None = None  # None if there is no such file
    recording_path: Path | None = None

    @staticmethod
    def load(
        path: Path, host: HostRecord | None = None, on_message: MessageHandler | None = None
    ) -> "RunRecord":
        """Load the record of a run from its folder or from a recording. The run may have been killed.

        Args:
            path: The folder of the run, or the recording.
            host: Statistics of the host, if they are known already; None to read them from `path`.
            on_message: Called with every message of the recording while it is read.

        Raises:
            ConfigError: The path is neither a folder of a run nor a recording, or the record is damaged.
        """
        reader = open_run(path, host, on_message)
        try:
            return RunRecord.read(reader)
        except ConfigError:
            raise
        except READ_ERRORS as error:
            reason = f"{type(error).__name__}: {error}"[:300]
            raise ConfigError(
                f"{path}: the record of this run is damaged ({reason}); run it again",
                code="recording/not-readable",
            ) from None

    @staticmethod
    def read(reader: RunReader) -> "RunRecord":
        """Read the record of a run, replace invalid numbers by NaN, and collect what is missing.

        Args:
            reader: Reader of the folder of a run, or of a recording.

        Raises:
            ConfigError: A part of the record cannot be read.
        """
        config = reader.read_config()
        description = reader.read_description()
        has_pose_sensor = config.robot.sensors.pose is not None
        columns, invalid_descriptions = replace_invalid_numbers(
            reader.read_ticks(), description, has_pose=has_pose_sensor
        )
        outputs = reader.read_outputs(columns["time_s"])

        # Ticks that the host counted but that are not in the columns are lost, even if no loss was reported.
        host = reader.read_host_record()
        tick_count = len(columns["tick"])
        lost_ticks = max(host.lost_ticks, host.ticks - tick_count)
        host = msgspec.structs.replace(host, lost_ticks=lost_ticks)

        del columns["tick"]  # the other columns are fields of the record, by the same names
        return RunRecord(
            path=reader.path,
            config=config,
            description=description,
            host=host,
            control_states=outputs.control,
            worlds=outputs.worlds,
            trajectories=outputs.trajectories,
            **columns,
            searched_nodes_by_tick=outputs.searched_nodes,
            custom_columns=outputs.custom,
            contact_log=outputs.contact_log,
            replay_of=outputs.replay_of,
            ending=reader.describe_ending(),
            missing=[*invalid_descriptions, *describe_unwritten_data(host), *outputs.missing],
            recorder_losses=outputs.unreached,
            config_path=reader.config_path,
            recording_path=reader.recording_path,
        )

    @cached_property
    def route(self) -> Route | None:
        """Route through the scene; None if the scene has no route."""
        return make_route(self.config.scene)

    @cached_property
    def placed_obstacles(self) -> list[PlacedObstacle]:
        """Obstacles of the scene with their positions."""
        return place_obstacles(self.config)

    @cached_property
    def has_contact_sensors(self) -> bool:
        """Whether the robot had contact sensors. The robot file may list sensors that the drives do not have."""
        return any(sensor.key == keys.CONTACTS for sensor in self.description.sensors)

    @cached_property
    def ticks(self) -> NDArray[np.int64]:
        """Tick of each row, (n,)."""
        return np.rint(self.time_s * 1e9 / self.description.period_ns).astype(np.int64)

    @cached_property
    def contiguous_rows(self) -> list[NDArray[np.int64]]:
        """Row indices of each part of the record without a gap: within a part the ticks are consecutive."""
        rows = np.arange(len(self.ticks))
        if not len(rows):
            return []
        first_rows_after_gaps = np.flatnonzero(np.diff(self.ticks) > 1) + 1
        return np.split(rows, first_rows_after_gaps)

    def find_nearest_row(self, time_s: float) -> int:
        """Return the index of the row whose robot time, in s, is nearest."""
        return int(np.argmin(np.abs(self.time_s - time_s)))

    @cached_property
    def has_pose(self) -> NDArray[np.bool_]:
        """Mask of the rows in which the pose and all joint angles are known, (n,)."""
        signals = (self.position_w_m, self.orientation_wxyz, self.angle_rad)
        return np.logical_and.reduce([np.isfinite(signal).all(axis=1) for signal in signals])

    def find_body_points_w(self, row: int) -> Floats | None:
        """Compute the positions of tail end, joints and head end at one tick.

        Args:
            row: Index of the tick in the record.

        Returns:
            (joints + 2, 3) positions in the world, in m, or None if the pose is unknown.
        """
        if len(self.time_s) == 0 or not self.has_pose[row]:
            return None
        return compute_body_points_w(
            self.description,
            self.position_w_m[row],
            self.orientation_wxyz[row],
            self.angle_rad[row],
        )
