"""`snakesim info`: what a recording holds, and what it lacks."""

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

from snakesim_hal.base.arithmetic import digest_text, foreign
from snakesim_hal.base.errors import ConfigError, WireError
from snakesim_hal.base.terminal import Say
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder
from snakesim_hal.wire.messages import ControlSettings, Status
from snakesim_operator.recording.losses import Gap
from snakesim_operator.recording.message import RECORDING
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.results.missing_data import describe_undecodable, exit_code
from snakesim_operator.results.record import GIVE
from snakesim_operator.results.recording_contents import ALL, Contents
from snakesim_operator.robot_commands.parameters import PREFIX, differing

# Published on a change too, so that nothing is missing there.
IRREGULAR = (keys.CONTROL_STATE, keys.STATUS, keys.INTENT)


@dataclass
class KeyInfo:
    """The messages at one key."""

    time_ns: "array[int]" = field(default_factory=lambda: array("q"))  # robot time
    bytes: int = 0

    @property
    def gaps(self) -> int:
        """How many messages are missing between the first and the last, by the usual step between them."""
        steps = np.diff(np.unique(np.array(self.time_ns)))
        if len(steps) < 2:
            return 0
        return int((np.round(steps / np.median(steps)) - 1).clip(0).sum())


class SettingsChange(msgspec.Struct, kw_only=True):
    """What somebody has set while the controller ran."""

    time_s: float
    who: str
    changed: dict[str, tuple[Any, Any]]  # name -> before, then


class RecordingInfo(msgspec.Struct, kw_only=True):
    """What `--json` prints."""

    file: str
    size_bytes: int
    finished: bool
    lacks: list[str]
    gaps: list[Gap]  # what of it is lost in between, by time and key
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
    settings: list[SettingsChange]
    dropped: dict[str, int]
    keys: dict[str, dict[str, float]]


def recording_of(given: Path) -> Path:
    """The recording of a run's folder, or the file itself. Raises ConfigError."""
    path = given / RECORDING if given.is_dir() else given
    if not path.is_file():
        raise ConfigError(f"{path}: there is no such recording; {GIVE}")
    return path


def inspect_recording(path: Path) -> RecordingInfo:
    """Read a recording once. Raises ConfigError for a file that is none."""
    reader, found, contents = RecordingReader(path), dict[str, KeyInfo](), Contents(path)
    decoder, in_force = Decoder(ControlSettings), list[ControlSettings]()
    for recorded in reader.messages():
        one = found.setdefault(recorded.key, KeyInfo())
        one.time_ns.append(recorded.time_ns)
        one.bytes += len(recorded.payload)
        if recorded.key in ALL:
            contents.add(recorded)
        if recorded.key == keys.SETTINGS_IN_FORCE:
            with contextlib.suppress(WireError):
                in_force.append(decoder.decode(recorded.payload, recorded.encoding))
    robot, status = contents.description, contents.status
    config: dict[str, Any] = json.loads(contents.config.content) if contents.config is not None else {}
    # Not since the oldest message: latched values, such as the description, are older than a recording that began late.
    dated = [found[keys.CLOCK]] if keys.CLOCK in found else found.values()
    began_ns = min((min(one.time_ns) for one in dated), default=0)
    duration_s = (max((max(one.time_ns) for one in found.values()), default=began_ns) - began_ns) * 1e-9
    in_turns = robot is not None and robot.backend == "can"  # the IMUs of modules on a bus: at some ticks none
    irregular = (*IRREGULAR, keys.IMU) if in_turns else IRREGULAR
    host = contents.host(contents.columns(robot)) if robot is not None and status is not None else None
    return RecordingInfo(
        file=str(path),
        size_bytes=path.stat().st_size,
        finished=reader.finished,
        lacks=[*reader.lacks, *_skipped(found, reader.losses.lost, irregular), *describe_undecodable(contents.refused)],
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
        own_arithmetic=[] if robot is None else foreign(robot.arithmetic),
        lifecycle=None if status is None else f"{status.lifecycle}: {_why(status)}",
        settings=_changes(in_force),
        dropped=reader.losses.dropped,
        keys={key: _numbers(one, duration_s, regular=key not in irregular) for key, one in sorted(found.items())},
    )


def _changes(in_force: Sequence[ControlSettings]) -> list[SettingsChange]:
    return [
        SettingsChange(
            time_s=now.timestamp_ns * 1e-9,
            who=now.who,
            changed={PREFIX + one.name: (was.value, one.value) for was, one in differing(before, now)},
        )
        for before, now in pairwise(in_force)
        if now.who is not None and now.changes != before.changes
    ]


def _why(status: Status) -> str:
    """Why it was in its state; without what a status says behind that, while disarmed: what prevents arming."""
    return status.why.partition("; ")[0] if status.lifecycle == "disarmed" else status.why


def _numbers(one: KeyInfo, duration_s: float, *, regular: bool) -> dict[str, float]:
    count = len(one.time_ns)
    lasted_s = (max(one.time_ns) - min(one.time_ns)) * 1e-9
    return {
        "count": count,
        "rate_hz": (len(set(one.time_ns)) - 1) / lasted_s if lasted_s > 0 else 0.0,
        "bytes": one.bytes,
        "gaps": one.gaps if regular else 0,
    }


def show(given: Path, say: Say, *, as_json: bool = False) -> int:
    """Print what a recording holds. Exit code 3 when it lacks something."""
    info = inspect_recording(recording_of(given))
    if as_json:
        say(msgspec.json.encode(info).decode())
        return exit_code(given, info.lacks)
    say(f"{info.file}: {info.size_bytes / 1e6:.2f} MB, {info.duration_s:.2f} s of robot time")
    say(f"  robot     {info.robot or 'unknown'}, backend {info.backend or 'unknown'}, {info.clock_mode or 'unknown'}")
    say(f"  scenario  {info.scenario or 'unknown'}, controller {info.controller or 'none'}, seed {info.seed}")
    say(f"  ended     {info.lifecycle or 'unknown'}")
    digest = digest_text(info.command_digest, info.own_arithmetic) if info.command_digest else "none"
    of_what = " of these ticks alone" if info.lacks else ""
    say(f"  commands  {info.ticks} ticks applied, digest {digest}{of_what}")
    for change in info.settings:
        said = ", ".join(f"{name}: {was} -> {value}" for name, (was, value) in change.changed.items())
        say(f"  set       at {change.time_s:.2f} s by {change.who}: {said}")
    say(f"  {'key':<26}{'messages':>9}{'rate':>11}{'mean size':>12}{'gaps':>7}")
    for key, one in info.keys.items():
        mean = one["bytes"] / one["count"]
        say(f"  {key:<26}{one['count']:>9.0f}{one['rate_hz']:>8.1f} Hz{mean:>10.0f} B{one['gaps']:>7.0f}")
    for lack in info.lacks:
        say(f"  lacks: {lack}")
    return exit_code(given, info.lacks)


def _skipped(found: dict[str, KeyInfo], lost: Counter[str], irregular: Sequence[str]) -> list[str]:
    """Messages that the recorder never got, as text."""
    gaps = {key: one.gaps - lost[key] for key, one in sorted(found.items()) if key not in irregular}
    return [f"{gap} messages on {key}, between the first and the last" for key, gap in gaps.items() if gap > 0]
