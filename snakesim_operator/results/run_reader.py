"""Reads a run through one interface from either store: the folder that `snakesim run` left, or a recording alone.

A robot's host writes the run log: its black box, which has a row for each tick, and its statistics. A recorder process
writes the recording: all messages, those of guidance, navigation and control too. A run's folder has both. Where only
a recording is left, all of it is made of the messages.

    reader = open_run(Path("runs/demo"))
    ticks = reader.read_ticks()
"""

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import msgspec
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.scenario import RunConfig, read_config
from snakesim_hal.run_log.black_box import RowLayout, compute_digest, read_black_box
from snakesim_hal.run_log.host_record import BLACK_BOX, DESCRIPTION, HOST_RECORD, HostRecord
from snakesim_hal.wire.codec import UNDECODABLE
from snakesim_hal.wire.messages import RobotDescription, RunConfiguration
from snakesim_operator.recording.message import RECORDING_FILENAME, RecordedMessage
from snakesim_operator.results.recording_contents import (
    OUTPUT_KEYS,
    RecordingContents,
    RunOutputs,
    read_recording,
)
from snakesim_operator.results.run_ending import COMPLETE, describe_early_end, describe_recorded_end

# Names of files in the folder of a run, besides those of the host.
CONFIG_FILENAME = "config.json"
SUMMARY_FILENAME = "summary.json"
REPORT_FILENAME = "report.html"

PATH_HINT = "give the folder that `snakesim run` left, such as runs/demo, or a recording"
UNRECORDED = "without a recording, what control, navigation and guidance reported is unknown"

Columns = dict[str, NDArray[Any]]
MessageHandler = Callable[[RecordedMessage], None]


class RunReader(Protocol):
    """Reads one stored run, from a folder or from a recording.

    Every method may raise ConfigError for a damaged store, and OSError. The store is read only once, even if a method
    is called again.
    """

    path: Path  # folder of the run, or the recording
    config_path: Path | None  # file with the configuration; None if there is no such file
    recording_path: Path  # the recording; a folder may have none

    def read_config(self) -> RunConfig:
        """Return the effective configuration of the run."""
        ...

    def read_description(self) -> RobotDescription:
        """Return the robot's description."""
        ...

    def read_host_record(self) -> HostRecord:
        """Return the host's statistics."""
        ...

    def read_ticks(self) -> Columns:
        """Return the ticks since the first arming, one row each, in columns with the names of the black box.

        `tick`, `time_s` (robot time), `contact_peak_n` and `contact_count` are (n,). `angle_rad`, `velocity_rad_s`,
        `torque_nm`, `mode`, `target` and `torque_limit_nm` are (n, joints). `position_w_m` is (n, 3), and
        `orientation_wxyz` is (n, 4). Numbers may be NaN or invalid.
        """
        ...

    def read_outputs(self, time_s: Floats) -> RunOutputs:
        """Return what guidance, navigation, control and custom sensors published.

        Args:
            time_s: (n,) robot time of each row, for the columns of custom sensors.
        """
        ...

    def describe_ending(self) -> str:
        """Return COMPLETE, or a sentence on how the run ended, as far as the store shows it."""
        ...


def open_run(
    path: Path, host: HostRecord | None = None, on_message: MessageHandler | None = None
) -> RunReader:
    """Open a stored run: return the reader for the folder of a run, or for a recording.

    Args:
        path: Path of the run folder, or of the recording.
        host: Statistics of the host, if they are known already; None to read them from the store.
        on_message: Called with every message of the recording while it is read.

    Raises:
        ConfigError: The path is neither a run folder nor a recording, or a file of the folder is missing.
    """
    if path.is_file():
        return RecordingOnlyReader(path, host, on_message)
    if not (path / BLACK_BOX).exists() and (path / RECORDING_FILENAME).is_file():
        return RecordingOnlyReader(path / RECORDING_FILENAME, host, on_message)
    if not path.exists():
        raise ConfigError(f"{path}: no such folder; {PATH_HINT}", code="recording/not-a-run")
    required_files = [CONFIG_FILENAME, BLACK_BOX, DESCRIPTION]
    if host is None:
        required_files.append(HOST_RECORD)
    for name in required_files:
        if not (path / name).is_file():
            raise ConfigError(
                f"{path} is not the folder of a run: {name} is missing; {PATH_HINT}",
                code="recording/not-a-run",
            )
    return RunFolderReader(path, host, on_message)


def find_recording_path(path: Path) -> Path:
    """Return the path of the recording in a run folder, or the path itself if it is a recording.

    Raises:
        ConfigError: There is no recording.
    """
    recording_path = path / RECORDING_FILENAME if path.is_dir() else path
    if not recording_path.is_file():
        raise ConfigError(
            f"{recording_path}: there is no such recording; {PATH_HINT}", code="file/not-found"
        )
    return recording_path


class RunFolderReader(RunReader):
    """Reads a run's folder: ticks and statistics from the run log, the services' output from the recording."""

    def __init__(
        self, folder: Path, host: HostRecord | None, on_message: MessageHandler | None
    ) -> None:
        self.path = folder
        self.config_path = folder / CONFIG_FILENAME
        self.recording_path = folder / RECORDING_FILENAME
        self._known_host = host
        self._on_message = on_message

    def read_config(self) -> RunConfig:
        return self._config

    def read_description(self) -> RobotDescription:
        return self._description

    def read_host_record(self) -> HostRecord:
        return self._host

    def read_ticks(self) -> Columns:
        return self._ticks

    def read_outputs(self, time_s: Floats) -> RunOutputs:
        if not self.recording_path.is_file():
            return RunOutputs(missing=[UNRECORDED])
        recorder_losses = self._contents.describe_unrecorded_ticks(len(self._ticks["tick"]))
        return self._contents.collect_outputs(self._description, time_s, recorder_losses)

    def describe_ending(self) -> str:
        return describe_early_end(self._host, self._config) or COMPLETE

    @cached_property
    def _contents(self) -> RecordingContents:
        return read_recording(self.recording_path, OUTPUT_KEYS, self._on_message)

    @cached_property
    def _config(self) -> RunConfig:
        return read_config(self.path / CONFIG_FILENAME)

    @cached_property
    def _description(self) -> RobotDescription:
        return msgspec.json.decode((self.path / DESCRIPTION).read_bytes(), type=RobotDescription)

    @cached_property
    def _ticks(self) -> Columns:
        layout, columns = read_black_box(self.path / BLACK_BOX)
        if layout != RowLayout.for_robot(self._description):
            raise ConfigError(
                f"{self.path / BLACK_BOX} is of another robot than {DESCRIPTION} beside it",
                code="recording/not-comparable",
            )
        return columns

    @cached_property
    def _host(self) -> HostRecord:
        host = self._known_host
        if host is None:
            host = msgspec.json.decode((self.path / HOST_RECORD).read_bytes(), type=HostRecord)
        if host.ended != "running":
            return host
        # The host was killed: its last statistics are older than its last ticks.
        tick_count = len(self._ticks["tick"])
        return msgspec.structs.replace(
            host, ticks=tick_count, command_digest=compute_digest(self._ticks)
        )


class RecordingOnlyReader(RunReader):
    """Reads a recording without the other files of its run: a full disk may have had no room for them."""

    def __init__(
        self, path: Path, host: HostRecord | None, on_message: MessageHandler | None
    ) -> None:
        self.path = path
        self.config_path = None
        self.recording_path = path
        self._known_host = host
        self._on_message = on_message

    def read_config(self) -> RunConfig:
        return self._config

    def read_description(self) -> RobotDescription:
        return self._description

    def read_host_record(self) -> HostRecord:
        return self._host

    def read_ticks(self) -> Columns:
        return self._ticks

    def read_outputs(self, time_s: Floats) -> RunOutputs:
        return self._contents.collect_outputs(self._description, time_s)

    def describe_ending(self) -> str:
        time_s = self._ticks["time_s"]
        recorded_duration_s = 0.0
        if len(time_s):
            recorded_duration_s = float(time_s[-1] - time_s[0]) + 1 / self._config.rate_hz
        return describe_recorded_end(
            self._host, self._config, recorded_duration_s, finished=self._contents.is_finished
        )

    @cached_property
    def _contents(self) -> RecordingContents:
        return read_recording(self.path, on_message=self._on_message)

    @cached_property
    def _description_and_config(self) -> tuple[RobotDescription, RunConfiguration]:
        description = self._contents.description
        config = self._contents.config
        if description is None or config is None:
            reason = "; ".join(self._contents.missing) or "was it recorded beside a HAL host?"
            raise ConfigError(
                f"{self.path}: holds no hal/description and hal/config; {reason}",
                code="recording/missing-data",
            )
        return description, config

    @cached_property
    def _description(self) -> RobotDescription:
        description, _ = self._description_and_config
        return description

    @cached_property
    def _config(self) -> RunConfig:
        _, config = self._description_and_config
        try:
            return msgspec.json.decode(config.content, type=RunConfig)
        except UNDECODABLE as error:
            raise ConfigError(
                f"{self.path}: its hal/config cannot be read: {str(error)[:200]}",
                code="recording/not-readable",
            ) from None

    @cached_property
    def _ticks(self) -> Columns:
        return self._contents.make_tick_columns(self._description)

    @cached_property
    def _host(self) -> HostRecord:
        if self._known_host is not None:
            return self._known_host
        return self._contents.make_host_record(self._ticks)
