"""`snakesim recording info`: prints the content of a recording, and what is missing in it."""

import contextlib
import json
from array import array
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from snakesim_hal.base.arithmetic import find_differing_parts, format_digest
from snakesim_hal.base.errors import WireError
from snakesim_hal.base.terminal import PrintLine
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MessageDecoder
from snakesim_hal.wire.messages import ControlParameters, RobotStatus
from snakesim_operator.recording.losses import LossGap
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.results.missing_data import (
    describe_undecodable_messages,
    report_missing_data,
)
from snakesim_operator.results.recording_contents import RUN_KEYS, RecordingContents
from snakesim_operator.results.run_reader import find_recording_path
from snakesim_operator.robot_commands.parameters import PREFIX, find_changed_parameters

# Keys that are also published on a change, so that irregular times there do not mean missing messages.
IRREGULAR_KEYS = (keys.CONTROL_STATE, keys.STATUS, keys.INTENT)


@dataclass
class KeyInfo:
    """Times and sizes of the messages at one key."""

    time_ns: "array[int]" = field(default_factory=lambda: array("q"))  # robot time
    bytes: int = 0

    @property
    def gaps(self) -> int:
        """Number of messages that are missing between the first and the last, by the median time between messages."""
        steps = np.diff(np.unique(np.array(self.time_ns)))
        if len(steps) < 2:
            return 0
        return int((np.round(steps / np.median(steps)) - 1).clip(0).sum())


class ParameterChange(msgspec.Struct, kw_only=True):
    """A change of parameters by an operator while the controller ran."""

    time_s: float
    requester: str
    changed: dict[str, tuple[Any, Any]]  # name -> before, then


class RecordingInfo(msgspec.Struct, kw_only=True):
    """The content of a recording, as `--json` prints it."""

    file: str
    size_bytes: int
    finished: bool
    missing: list[str]
    gaps: list[LossGap]  # messages that were lost in between, by time and key
    robot: str | None
    backend: str | None
    scenario: str | None
    controller: str | None
    seed: int | None
    clock_mode: str | None
    duration_s: float
    ticks: int
    command_digest: str | None
    own_arithmetic: list[str]  # what rounds otherwise than on most computers with the lock's NumPy
    lifecycle: str | None
    parameter_changes: list[ParameterChange]
    dropped: dict[str, int]
    keys: dict[str, dict[str, float]]


def inspect_recording(path: Path) -> RecordingInfo:
    """Read a recording once, and return its content. Raises ConfigError if the file is not a recording."""
    reader = RecordingReader(path)
    contents = RecordingContents(path)
    by_key: dict[str, KeyInfo] = {}
    parameters_in_force: list[ControlParameters] = []
    parameters_decoder = MessageDecoder(ControlParameters)
    for recorded in reader.read_messages():
        key_info = by_key.setdefault(recorded.key, KeyInfo())
        key_info.time_ns.append(recorded.robot_time_ns)
        key_info.bytes += len(recorded.payload)
        if recorded.key in RUN_KEYS:
            contents.add_message(recorded)
        if recorded.key == keys.PARAMETERS_IN_FORCE:
            with contextlib.suppress(WireError):
                parameters_in_force.append(
                    parameters_decoder.decode(recorded.payload, recorded.encoding)
                )

    robot = contents.description
    status = contents.status
    config: dict[str, Any] = (
        json.loads(contents.config.content) if contents.config is not None else {}
    )
    duration_s = _measure_duration_s(by_key)
    irregular: list[str] = [*IRREGULAR_KEYS]
    # Joint modules on a bus send their IMUs by turns.
    if robot is not None and robot.backend == "can":
        irregular.append(keys.IMU)
    host = None
    if robot is not None and status is not None:
        host = contents.make_host_record(contents.make_tick_columns(robot))
    missing = [
        *reader.missing,
        *_describe_skipped(by_key, reader.losses.lost_by_key, irregular),
        *describe_undecodable_messages(contents.undecodable_counts),
    ]
    metrics_by_key: dict[str, dict[str, float]] = {}
    for key, key_info in sorted(by_key.items()):
        metrics_by_key[key] = _compute_key_metrics(key_info, is_regular=key not in irregular)
    return RecordingInfo(
        file=str(path),
        size_bytes=path.stat().st_size,
        finished=reader.is_complete,
        missing=missing,
        gaps=[gap for gap in reader.losses.gaps if gap.lost],
        robot=None if robot is None else robot.robot,
        backend=None if robot is None else robot.backend,
        scenario=config.get("name"),
        controller=config.get("controller"),
        seed=config.get("seed"),
        clock_mode=None if status is None else status.clock_mode,
        duration_s=duration_s,
        ticks=0 if host is None else host.ticks,
        command_digest=None if host is None or not host.ticks else host.command_digest,
        own_arithmetic=[] if robot is None else find_differing_parts(robot.arithmetic),
        lifecycle=None if status is None else f"{status.lifecycle}: {_lifecycle_reason(status)}",
        parameter_changes=_find_parameter_changes(parameters_in_force),
        dropped=reader.losses.dropped_count_by_key,
        keys=metrics_by_key,
    )


def _measure_duration_s(by_key: dict[str, KeyInfo]) -> float:
    """Measure the robot time from the first clock message to the newest message, in s.

    Latched messages, such as the description, may be older than the start of the recording, so they do not count.
    """
    key_infos_at_start = [by_key[keys.CLOCK]] if keys.CLOCK in by_key else list(by_key.values())
    start_ns = min((min(key_info.time_ns) for key_info in key_infos_at_start), default=0)
    end_ns = max((max(key_info.time_ns) for key_info in by_key.values()), default=start_ns)
    return (end_ns - start_ns) * 1e-9


def _find_parameter_changes(in_force: Sequence[ControlParameters]) -> list[ParameterChange]:
    """Find the changes of parameters that an operator made, in order of time."""
    changes: list[ParameterChange] = []
    for previous, current in pairwise(in_force):
        if current.requester is None or current.changes == previous.changes:
            continue
        changed = {
            PREFIX + new.name: (old.value, new.value)
            for old, new in find_changed_parameters(previous, current)
        }
        changes.append(
            ParameterChange(
                time_s=current.timestamp_ns * 1e-9, requester=current.requester, changed=changed
            )
        )
    return changes


def _lifecycle_reason(status: RobotStatus) -> str:
    """Return the reason of the last lifecycle state.

    While disarmed, the status appends what prevents arming; that part is left out.
    """
    if status.lifecycle == "disarmed":
        return status.reason.partition("; ")[0]
    return status.reason


def _compute_key_metrics(key_info: KeyInfo, *, is_regular: bool) -> dict[str, float]:
    duration_s = (max(key_info.time_ns) - min(key_info.time_ns)) * 1e-9
    distinct_times = len(set(key_info.time_ns))
    return {
        "count": len(key_info.time_ns),
        "rate_hz": (distinct_times - 1) / duration_s if duration_s > 0 else 0.0,
        "bytes": key_info.bytes,
        "gaps": key_info.gaps if is_regular else 0,
    }


def print_recording_info(path: Path, print_text: PrintLine, *, as_json: bool = False) -> int:
    """Print the content of a recording: the run, changes of parameters, messages by key, and missing data.

    Args:
        path: Path of the recording, or of the folder of a run with a recording.
        print_text: Prints a line.
        as_json: Whether to print one JSON object instead of lines for people.

    Returns:
        The exit code: 3 if the recording is incomplete, otherwise 0.
    """
    info = inspect_recording(find_recording_path(path))
    if as_json:
        print_text(msgspec.json.encode(info).decode())
        return report_missing_data(path, info.missing)

    print_text(
        f"{info.file}: {info.size_bytes / 1e6:.2f} MB, {info.duration_s:.2f} s of robot time"
    )
    robot = info.robot or "unknown"
    backend = info.backend or "unknown"
    print_text(f"  robot     {robot}, backend {backend}, {info.clock_mode or 'unknown'}")
    print_text(
        f"  scenario  {info.scenario or 'unknown'}, controller {info.controller or 'none'}, seed {info.seed}"
    )
    print_text(f"  ended     {info.lifecycle or 'unknown'}")
    digest = "none"
    if info.command_digest:
        digest = format_digest(info.command_digest, info.own_arithmetic)
    digest_note = " of these ticks alone" if info.missing else ""
    print_text(f"  commands  {info.ticks} ticks applied, digest {digest}{digest_note}")

    for change in info.parameter_changes:
        changes = [
            f"{name}: {before} -> {after}" for name, (before, after) in change.changed.items()
        ]
        print_text(
            f"  set       at {change.time_s:.2f} s by {change.requester}: {', '.join(changes)}"
        )

    print_text(f"  {'key':<26}{'messages':>9}{'rate':>11}{'mean size':>12}{'gaps':>7}")
    for key, metrics in info.keys.items():
        mean_bytes = metrics["bytes"] / metrics["count"]
        count_and_rate = f"{metrics['count']:>9.0f}{metrics['rate_hz']:>8.1f} Hz"
        print_text(f"  {key:<26}{count_and_rate}{mean_bytes:>10.0f} B{metrics['gaps']:>7.0f}")
    for sentence in info.missing:
        print_text(f"  missing: {sentence}")
    return report_missing_data(path, info.missing)


def _describe_skipped(
    by_key: dict[str, KeyInfo], lost_by_key: Counter[str], irregular: Sequence[str]
) -> list[str]:
    """Describe by sentences the messages that did not reach the recorder, at keys with regular messages."""
    sentences: list[str] = []
    for key, key_info in sorted(by_key.items()):
        if key in irregular:
            continue
        missing_count = key_info.gaps - lost_by_key[key]
        if missing_count > 0:
            sentences.append(f"{missing_count} messages on {key}, between the first and the last")
    return sentences
