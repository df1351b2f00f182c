"""Telemetry of control, guidance and navigation during a run, written as it arrives."""

from pathlib import PurePath

import msgspec

from snakesim_hal.network.session import Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ControlState, Message, Trajectory, World
from snakesim_operator.results.record import TELEMETRY
from snakesim_operator.run.run_files import RunFiles

DEPTH = 8192
MAX_PATHS = 20_000  # more than a planner makes in an hour
WORLDS_PER_S = 20.0  # as often as control publishes its state


class Telemetry:
    """Writes control states, worlds, and each new path, decoded once."""

    def __init__(self, session: Session, files: RunFiles) -> None:
        self.latest: ControlState | None = None
        self._control = session.reader(keys.CONTROL_STATE, ControlState, depth=DEPTH)
        self._world = session.reader(keys.WORLD, World, depth=DEPTH)
        self._trajectory = session.reader(keys.TRAJECTORY, Trajectory, depth=DEPTH)
        self._path: tuple[int, int] | None = None
        self._paths = 0
        self._files = files
        self._next_world_ns = 0
        self._hosts = 0
        self._new_host = False

    def expect_new_host(self) -> None:
        """The host has ended; control's messages with the old host's time still belong to it."""
        self._new_host = True

    def _start_over(self) -> None:
        """Time restarts at 0, with a new host: the telemetry under the old one gets a file of its own."""
        self._new_host = False
        self._hosts += 1
        path = PurePath(TELEMETRY)
        self._files.rename(TELEMETRY, path.with_stem(f"{path.stem}-{self._hosts}").name)
        self._next_world_ns = 0

    def take_in(self) -> None:
        """Write arrived messages."""
        for state in self._control.drain():
            if self._new_host and (self.latest is None or state.stamp_ns < self.latest.stamp_ns):
                self._start_over()
            self.latest = state
            self._write(keys.CONTROL_STATE, state)
        for world in self._world.drain():
            if world.stamp_ns >= self._next_world_ns:
                self._next_world_ns = world.stamp_ns + round(1e9 / WORLDS_PER_S)
                self._write(keys.WORLD, world)
        for trajectory in self._trajectory.drain():
            path = (self._hosts, trajectory.path_id)
            if path != self._path and self._paths < MAX_PATHS:
                self._path, self._paths = path, self._paths + 1
                self._write(keys.TRAJECTORY, trajectory)

    def _write(self, key: str, message: Message) -> None:
        self._files.append(TELEMETRY, msgspec.json.encode({"key": key, "message": message}) + b"\n")
