"""`snakesim recording info`: what a recording holds, and what is missing in it."""

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
from snakesim_hal.wire.codec import Decoder
from snakesim_hal.wire.messages import ControlParameters, Status
from snakesim_operator.recording.losses import LossGap
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.results.missing_data import describe_undecodable, exit_code
from snakesim_operator.results.recording_contents import ALL, RecordingContents
from snakesim_operator.results.run_reader import find_recording
from snakesim_operator.robot_commands.parameters import PREFIX, find_changed_parameters

# Published on a change too, so that nothing is missing there.
IRREGULAR = (keys.CONTROL_STATE, keys.STATUS, keys.INTENT)


@dataclass
class KeyInfo:
    """The messages at one key."""

    time_ns: "array[int]" = field(default_factory=lambda: array("q"))  # robot time
    bytes: int = 0

    @property
    def gaps(self) -> int:
        """The number of messages that are missing between the first and the last, by the usual step between them."""
        steps = np.diff(np.unique(np.array(self.time_ns)))
        if len(steps) < 2:
            return 0
        return int((np.round(steps / np.median(steps)) - 1).clip(0).sum())


class ParameterChange(msgspec.Struct, kw_only=True):
    """Parameters that an operator changed while the controller ran."""

    time_s: float
    requester: str
    changed: dict[str, tuple[Any, Any]]  # name -> before, then


class RecordingInfo(msgspec.Struct, kw_only=True):
    """The content of a recording, as `--json` prints it."""

    file: str
    size_bytes: int
    finished: bool
    missing: list[str]
    gaps: list[LossGap]  # what of it is lost in between, by time and key
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
    """Read a recording once, and describe it. Raises ConfigError for a file that is no recording."""
    reader = RecordingReader(path)
    contents = RecordingContents(path)
    by_key: dict[str, KeyInfo] = {}
    parameters_in_force: list[ControlParameters] = []
    parameters_decoder = Decoder(ControlParameters)
    for recorded in reader.read_messages():
        key_info = by_key.setdefault(recorded.key, KeyInfo())
        key_info.time_ns.append(recorded.time_ns)
        key_info.bytes += len(recorded.payload)
        if recorded.key in ALL:
            contents.add(recorded)
        if recorded.key == keys.PARAMETERS_IN_FORCE:
            with contextlib.suppress(WireError):
                parameters_in_force.append(parameters_decoder.decode(recorded.payload, recorded.encoding))

    robot = contents.description
    status = contents.status
    config: dict[str, Any] = json.loads(contents.config.content) if contents.config is not None else {}
    duration_s = _duration_s(by_key)
    irregular: list[str] = [*IRREGULAR]
    if robot is not None and robot.backend == "can":  # joint modules on a bus send their IMUs by turns
        irregular.append(keys.IMU)
    host = None
    if robot is not None and status is not None:
        host = contents.make_host_record(contents.make_columns(robot))
    missing = [
        *reader.missing,
        *_describe_skipped(by_key, reader.losses.lost_by_key, irregular),
        *describe_undecodable(contents.refused),
    ]
    numbers_by_key: dict[str, dict[str, float]] = {}
    for key, key_info in sorted(by_key.items()):
        numbers_by_key[key] = _key_numbers(key_info, is_regular=key not in irregular)
    return RecordingInfo(
        file=str(path),
        size_bytes=path.stat().st_size,
        finished=reader.finished,
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
        dropped=reader.losses.dropped,
        keys=numbers_by_key,
    )


def _duration_s(by_key: dict[str, KeyInfo]) -> float:
    """Return the robot time from the first clock message to the newest message.

    Latched values, such as the description, may be older than a recording that began late, so they do not count as
    its beginning.
    """
    dated = [by_key[keys.CLOCK]] if keys.CLOCK in by_key else list(by_key.values())
    began_ns = min((min(key_info.time_ns) for key_info in dated), default=0)
    ended_ns = max((max(key_info.time_ns) for key_info in by_key.values()), default=began_ns)
    return (ended_ns - began_ns) * 1e-9


def _find_parameter_changes(in_force: Sequence[ControlParameters]) -> list[ParameterChange]:
    """Return the changes that an operator made, in order of time."""
    changes: list[ParameterChange] = []
    for before, now in pairwise(in_force):
        if now.requester is None or now.changes == before.changes:
            continue
        changed = {PREFIX + new.name: (old.value, new.value) for old, new in find_changed_parameters(before, now)}
        changes.append(ParameterChange(time_s=now.timestamp_ns * 1e-9, requester=now.requester, changed=changed))
    return changes


def _lifecycle_reason(status: Status) -> str:
    """Return the reason of the last lifecycle state.

    While disarmed, the status appends what prevents arming; that part is left out.
    """
    if status.lifecycle == "disarmed":
        return status.reason.partition("; ")[0]
    return status.reason


def _key_numbers(key_info: KeyInfo, *, is_regular: bool) -> dict[str, float]:
    spanned_s = (max(key_info.time_ns) - min(key_info.time_ns)) * 1e-9
    distinct_times = len(set(key_info.time_ns))
    return {
        "count": len(key_info.time_ns),
        "rate_hz": (distinct_times - 1) / spanned_s if spanned_s > 0 else 0.0,
        "bytes": key_info.bytes,
        "gaps": key_info.gaps if is_regular else 0,
    }


def show_recording(path: Path, print_text: PrintLine, *, as_json: bool = False) -> int:
    """Print what a recording holds: the run, changes of parameters, messages by key, and missing data.

    Args:
        path: The recording, or the folder of a run that has one.
        print_text: Prints a line.
        as_json: Print one JSON object instead of lines for people.

    Returns:
        The exit code: 3 if the recording is incomplete, otherwise 0.
    """
    info = inspect_recording(find_recording(path))
    if as_json:
        print_text(msgspec.json.encode(info).decode())
        return exit_code(path, info.missing)

    print_text(f"{info.file}: {info.size_bytes / 1e6:.2f} MB, {info.duration_s:.2f} s of robot time")
    robot = info.robot or "unknown"
    backend = info.backend or "unknown"
    print_text(f"  robot     {robot}, backend {backend}, {info.clock_mode or 'unknown'}")
    print_text(f"  scenario  {info.scenario or 'unknown'}, controller {info.controller or 'none'}, seed {info.seed}")
    print_text(f"  ended     {info.lifecycle or 'unknown'}")
    digest = "none"
    if info.command_digest:
        digest = format_digest(info.command_digest, info.own_arithmetic)
    digest_note = " of these ticks alone" if info.missing else ""
    print_text(f"  commands  {info.ticks} ticks applied, digest {digest}{digest_note}")

    for change in info.parameter_changes:
        changed = [f"{name}: {before} -> {after}" for name, (before, after) in change.changed.items()]
        print_text(f"  set       at {change.time_s:.2f} s by {change.requester}: {', '.join(changed)}")

    print_text(f"  {'key':<26}{'messages':>9}{'rate':>11}{'mean size':>12}{'gaps':>7}")
    for key, numbers in info.keys.items():
        mean_bytes = numbers["bytes"] / numbers["count"]
        count_and_rate = f"{numbers['count']:>9.0f}{numbers['rate_hz']:>8.1f} Hz"
        print_text(f"  {key:<26}{count_and_rate}{mean_bytes:>10.0f} B{numbers['gaps']:>7.0f}")
    for sentence in info.missing:
        print_text(f"  missing: {sentence}")
    return exit_code(path, info.missing)


def _describe_skipped(by_key: dict[str, KeyInfo], lost: Counter[str], irregular: Sequence[str]) -> list[str]:
    """Describe the messages that did not reach the recorder."""
    sentences: list[str] = []
    for key, key_info in sorted(by_key.items()):
        if key in irregular:
            continue
        missing = key_info.gaps - lost[key]
        if missing > 0:
            sentences.append(f"{missing} messages on {key}, between the first and the last")
    return sentences
