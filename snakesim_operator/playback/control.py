"""Replays the sensors of a recording into guidance, navigation and control, and compares what they command.

The services are those of a run, on a network within this process; the recording stands in for the host. They get the
recorded bytes, tick by tick, and a lease of the recorded number. From a run in lockstep the commands come out the same
to the bit. With a changed setting they differ, but the robot moves as it did: it shows what another gain would have
commanded in the situations of the recording, not where that would have led. Settings that somebody changed during the
run are changed in the same tick again.
"""

from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
from threadpoolctl import threadpool_limits

from snakesim_hal.base.errors import ConfigError, SnakesimError, short
from snakesim_hal.base.terminal import Say
from snakesim_hal.model.plugins import in_file
from snakesim_hal.model.scenario import CHOSEN, Override, RunConfig, load, write, written
from snakesim_hal.network.local_network import LocalNetwork, LocalQuery
from snakesim_hal.network.session import Arrival, Publisher, Question
from snakesim_hal.programs.preflight import find_service
from snakesim_hal.service import ServiceLoop
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder, encode, encoding_of
from snakesim_hal.wire.messages import (
    Answer,
    AppliedCommand,
    Clock,
    Configuration,
    ControlSettings,
    Description,
    JointCommand,
    SettingsRequest,
)
from snakesim_operator.playback.play import in_robot_order
from snakesim_operator.recording.message import RECORDING, RecordedMessage
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.recording.recording import Recording
from snakesim_operator.results.missing_data import exit_code
from snakesim_operator.results.record import CONFIG
from snakesim_operator.results.recording_contents import Contents, read_recording

MADE_BY = {
    "guidance": (keys.WORLD,),
    "navigation": (keys.TRAJECTORY,),
    "control": (keys.JOINT_COMMAND, keys.CONTROL_STATE, keys.SETTINGS_IN_FORCE),
}
"""What the replayed services publish: these messages are made again."""


@dataclass
class Comparison:
    """The commands of the recording and those of the replay, by the tick that they answer."""

    recorded: dict[int, JointCommand] = field(default_factory=dict[int, JointCommand])
    replayed: dict[int, JointCommand] = field(default_factory=dict[int, JointCommand])

    @property
    def common(self) -> list[int]:
        """Ticks that both answer."""
        return sorted(self.recorded.keys() & self.replayed.keys())

    @property
    def different(self) -> list[int]:
        """Ticks that they answer differently, or that only one answers."""
        unlike = {tick for tick in self.common if not same(self.recorded[tick], self.replayed[tick])}
        return sorted(unlike | (self.recorded.keys() ^ self.replayed.keys()))

    def forgive(self, last_tick: int) -> None:
        """A run ends without waiting for the answer to its last tick, so that a recording may lack it."""
        if last_tick not in self.recorded:
            self.replayed.pop(last_tick, None)

    def largest(self) -> tuple[int, int, float] | None:
        """Tick, joint and size of the largest difference of a target; None when there is none."""
        sizes = [
            (abs(a - b), tick, joint)
            for tick in self.common
            for joint, (a, b) in enumerate(zip(self.recorded[tick].target, self.replayed[tick].target, strict=True))
        ]
        size, tick, joint = max(sizes, default=(0.0, 0, 0))
        return (tick, joint, size) if size else None


def same(a: JointCommand, b: JointCommand) -> bool:
    """Whether two commands drive the motors alike, to the bit. How often a service was asked at tick 0 is no matter."""
    return (a.arm_session, a.mode, a.target, a.torque_limit_nm) == (b.arm_session, b.mode, b.target, b.torque_limit_nm)


def config_of(contents: Contents, overrides: list[Override], *, run_recorded_code: bool = False) -> RunConfig:
    """The configuration of a recording, with changes. Raises ConfigError.

    run_recorded_code: otherwise a controller or service in a Python file is refused, unless `overrides` name it.
    """
    if contents.config is None:
        raise ConfigError(f"{contents.path}: holds no hal/config, so it is not known which controller was at work")
    with TemporaryDirectory(prefix="snakesim-") as folder:
        path = Path(folder) / "config.json"
        path.write_text(contents.config.content)
        config = load(str(path), overrides).config
    if not run_recorded_code:
        _refuse_its_files(contents.path, config, {override.key for override in overrides})
    return config


def _refuse_its_files(path: Path, config: RunConfig, named_here: set[str]) -> None:
    """named_here: what the command line says itself. The backend and other services are not replayed."""
    named = [("controller", "--controller ", "its controller", config.controller)]
    for name in MADE_BY:
        key = f"services.{name}.code"
        code = config.services[name].code if name in config.own_services else ""
        named.append((key, f"--set {key}=", f"its service {name}", code))
    for key, flag, what, code in named:
        if in_file(code) and key not in named_here:
            raise ConfigError(
                f"{path}: the recording names {short(code)!r} as {what}, and would have that Python file run on this "
                f"computer. If you trust the file, name it yourself, with {flag}{short(code)}, or run what the "
                f"recording names with --run-recorded-code; else choose an installed one with {flag}NAME"
            )


class Replay:
    """Services that believe to be in the run of a recording."""

    def __init__(
        self, path: Path, overrides: list[Override], out: Path | None = None, *, run_recorded_code: bool = False
    ) -> None:
        """out: a recording of the replay. Raises ConfigError."""
        contents = read_recording(path, (keys.DESCRIPTION, keys.CONFIG, keys.CLOCK))
        self.lacks = contents.lacks
        self.config = config_of(contents, overrides, run_recorded_code=run_recorded_code)
        self.changed = bool(overrides) and self.config != config_of(contents, [], run_recorded_code=True)
        if contents.description is None:
            raise ConfigError(f"{path}: holds no hal/description")
        self.robot: Description = contents.description
        self.clock_mode = self.config.clock_mode
        self.stopped = ""  # why it could not go on to the end of a recording that lacks something
        self.comparison = Comparison()
        self._path, self._network = path, LocalNetwork()
        self._session = self._network.session()
        self._names = [name for name in MADE_BY if name in self.config.own_services]
        self._made = {key for name in self._names for key in MADE_BY[name]} | {keys.done(name) for name in self._names}
        clocks: list[tuple[int, Clock]] = sorted(contents.at[keys.CLOCK].items())
        self._last_tick = clocks[-1][0] if clocks else -1
        self._epochs = [(tick, clock.lease_epoch) for tick, clock in clocks if clock.lease_epoch]
        self._now_ns = 0
        self._publishers: dict[str, Publisher[Any]] = {}
        self._loops: list[ServiceLoop] = []
        self._joined = False
        self._by_sequence: dict[int, JointCommand] = {}  # of the recording
        self._commands, self._applied = Decoder(JointCommand), Decoder(AppliedCommand)
        self._settings = Decoder(ControlSettings)
        self._kept = {o.key.removeprefix(CHOSEN[0]): o.value for o in overrides if o.key.startswith(CHOSEN[0])}
        self._asked: list[tuple[ControlSettings, LocalQuery]] = []  # changes of settings without an answer yet
        self._recording = Recording(out, self.config.robot.name) if out is not None else None

    def run(self) -> Comparison:
        """Replay it all. Raises SnakesimError when a service fails."""
        with ExitStack() as opened:
            opened.enter_context(threadpool_limits(1))  # as in the run
            if self._recording is not None:
                opened.callback(self._recording.close, {"replay_of": str(self._path)})
                for row in keys.SPACE:
                    self._session.on_latched_arrival(row.key, self._recording.take)
            self._session.on_question(keys.LEASE, self._lend)
            self._session.on_arrival(keys.JOINT_COMMAND, self._keep)
            effective = Configuration(config_hash=self.robot.config_hash, content=written(self.config).decode())
            self._session.latched_publisher(keys.CONFIG, Configuration).put(effective)
            self._session.latched_publisher(keys.DESCRIPTION, Description).put(self.robot)
            for name in self._names:
                loop = ServiceLoop(find_service(self.config, name), self.config, self._network.session())
                opened.callback(loop.close)
                self._loops.append(loop)
            try:
                self._play()
                self.comparison.forgive(self._last_tick)
            except SnakesimError as error:
                if not self.lacks:
                    raise
                self.stopped = str(error)  # it waits for what is lost
                found, last = self.comparison, max(self.comparison.replayed, default=-1)
                found.recorded = {tick: command for tick, command in found.recorded.items() if tick <= last}
        return self.comparison

    def _play(self) -> None:
        for turn, recorded in enumerate(in_robot_order(RecordingReader(self._path))):
            self._take(recorded)
            if self._recording is not None and turn % 1000 == 0:
                self._recording.flush_when_due()

    def _take(self, recorded: RecordedMessage) -> None:
        message = keys.message_at(recorded.key)
        if message is None or recorded.encoding != encoding_of(message):
            return  # of a stranger
        self._now_ns = recorded.time_ns
        if recorded.key == keys.JOINT_COMMAND:
            command = self._commands.decode(recorded.payload, recorded.encoding)
            self._by_sequence[command.sequence] = self.comparison.recorded[command.tick] = command
        if recorded.key == keys.SETTINGS_IN_FORCE and recorded.key in self._made:
            self._change_settings(self._settings.decode(recorded.payload, recorded.encoding))
        if recorded.key in self._made or recorded.key in (keys.CONFIG, keys.DESCRIPTION):
            return
        payload = recorded.payload
        if recorded.key == keys.APPLIED and "control" in self._names:
            payload = self._as_applied(recorded)
        publisher = self._publishers.get(recorded.key)
        if publisher is None:
            publisher = self._publishers[recorded.key] = self._session.publisher(recorded.key, message)
        publisher.send(payload)
        if recorded.key == keys.CLOCK:
            self._act()

    def _act(self) -> None:
        if not self._joined:
            for loop in self._loops:
                loop.join()
            self._joined = True
        for loop in self._loops:
            loop.act()
        for changed, query in [*self._asked]:
            if (answer := query.answered()) is None:
                continue
            self._asked.remove((changed, query))
            if not answer.ok:
                raise ConfigError(f"{self._path}: what {changed.who} set at tick {changed.tick}: {answer.reason}")

    def _change_settings(self, recorded: ControlSettings) -> None:
        """As in the recording; it comes before its tick's clock. What is set for the replay stays."""
        if recorded.who is None or recorded.controller != self.config.controller[-64:]:
            return
        values = msgspec.json.decode(recorded.settings, type=dict[str, Any])
        request = SettingsRequest(
            who=recorded.who,
            controller=recorded.controller,
            settings=msgspec.json.encode({**values, **self._kept}).decode(),
        )
        self._asked.append((recorded, self._session.put_question(keys.SETTINGS, request)))

    def _as_applied(self, recorded: RecordedMessage) -> bytes:
        """As in the recording where the command is the same; else the replayed command, without limits."""
        applied = self._applied.decode(recorded.payload, recorded.encoding)
        before = self._by_sequence.get(applied.sequence or -1)
        now = self.comparison.replayed.get(before.tick) if before is not None else None
        if before is None or now is None or same(before, now):
            return recorded.payload
        limits = now.torque_limit_nm or [joint.torque_limit_nm for joint in self.robot.joints]
        changed = msgspec.structs.replace(applied, mode=now.mode, target=now.target, torque_limit_nm=limits, limited={})
        return encode(changed)

    def _keep(self, arrival: Arrival) -> None:
        command = self._commands.decode(arrival.payload, arrival.encoding)
        self.comparison.replayed[command.tick] = command

    def _lend(self, question: Question) -> None:
        """The lease that the recording has next."""
        now = self._now_ns // self.robot.period_ns
        epoch = next((epoch for tick, epoch in self._epochs if tick >= now), 1)
        question.reply(Answer(ok=True, reason="replayed", epoch=epoch, host=self.robot.host))


def replay_control(
    path: Path, overrides: list[Override], out: Path | None, say: Say, *, run_recorded_code: bool = False
) -> int:
    """`snakesim replay --control`. out: a folder for a run that `compare` reads. Exit code 1: the commands differ.

    That is no failure where a setting was changed. 3: the recording lacks something.
    """
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    try:
        recording = None if out is None else out / RECORDING
        replay = Replay(path, overrides, recording, run_recorded_code=run_recorded_code)
    except FileExistsError:
        raise ConfigError(f"--out {out}: holds a recording already; choose another folder") from None
    found = replay.run()
    if out is not None:
        write(replay.config, out / CONFIG)
        say(f"replayed: {out}; `snakesim compare {path} {out}` shows the difference")
    if replay.stopped:
        say(f"replayed up to tick {max(found.replayed, default=0)} only: {replay.stopped}")
    elif not found.recorded:
        raise ConfigError(f"{path}: holds no commands, on {keys.JOINT_COMMAND}")
    different, count = found.different, len(found.recorded.keys() | found.replayed.keys())
    if not different:
        say(f"{count} commands, the same to the bit")
        return exit_code(path, replay.lacks)
    say(f"{len(different)} of {count} commands differ, the first answers tick {different[0]}")
    if (largest := found.largest()) is not None:
        tick, joint, size = largest
        say(f"largest difference of a target: {size:.4g} at {replay.robot.joints[joint].name}, tick {tick}")
    if replay.clock_mode != "lockstep":
        say(f"the run was {replay.clock_mode}: there a service acts on what has arrived, which only lockstep repeats")
    return exit_code(path, replay.lacks, 0 if replay.changed or replay.lacks else 1)
