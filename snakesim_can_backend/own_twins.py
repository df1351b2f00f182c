"""The module twins that a driver starts for itself: in its own process on a virtual bus, or as a child on vcan."""

import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from snakesim_can_backend.settings import Settings
from snakesim_can_backend.wire import OtherEnd
from snakesim_hal.errors import BackendError, ConfigError
from snakesim_hal.scenario import RunConfig, write

READY = "modules ready"
START_LIMIT_S = 120.0  # MuJoCo on a slow machine
STOP_LIMIT_S = 5.0


def check_twins(config: RunConfig, settings: Settings) -> None:
    """Raise ConfigError for twins that cannot be."""
    from snakesim_can_backend.twin.faults import parse

    if settings.twins_run == "here" and settings.channels:
        raise ConfigError(
            f'`backends.can.twins` = "here" is a virtual bus inside the driver, and `channels` = {settings.channels} '
            f'names real ones: leave `channels` empty, or let twins = "process"'
        )
    if settings.twins_run != "here" and not settings.channels:
        raise ConfigError(
            f'`backends.can.twins` = "{settings.twins_run}" needs a bus: name it in `backends.can.channels`, such as '
            f'["vcan0"]'
        )
    if settings.faults and settings.twins_run == "none":
        raise ConfigError("`backends.can.faults` are for twins; give them to `snakesim modules --fault` instead")
    for text in settings.faults:
        parse(text, config.robot.chain.modules)


def twins_here(config: RunConfig, settings: Settings, channel: str, pose: str | None, *, stepped: bool) -> OtherEnd:
    """Twins at the other end of a virtual bus; the returned function lets them run."""
    from snakesim_can_backend.twin.server import here

    return here(config, settings, channel, pose, stepped=stepped)


class TwinProcess:
    """`snakesim modules` as a child that dies with this process."""

    def __init__(self, config: RunConfig, settings: Settings, pose: str | None, *, stepped: bool) -> None:
        """Start it, and wait until its modules are on the bus. Raises BackendError."""
        self._folder = tempfile.TemporaryDirectory(prefix="snakesim-twins-")
        run = Path(self._folder.name, "config.json")
        write(config, run)
        arguments = [str(run), "--parent", str(os.getpid())]
        for channel in settings.channels:
            arguments += ["--channel", channel]
        arguments += ["--stepped"] if stepped else []
        arguments += ["--pose", pose or "none"]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "snakesim_can_backend.twin.command", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        self._await_ready()

    def stop(self) -> None:
        """Ask it to end, then insist."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(STOP_LIMIT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        if self._process.stdout is not None:
            sys.stderr.write(self._process.stdout.read())
            self._process.stdout.close()
        self._folder.cleanup()

    def _await_ready(self) -> None:
        said: list[str] = []
        end = time.monotonic() + START_LIMIT_S
        output = self._process.stdout
        assert output is not None
        while (left_s := end - time.monotonic()) > 0 and select.select([output], [], [], left_s)[0]:
            line = output.readline()
            if line.startswith(READY):
                return
            if not line:
                break
            said.append(line.rstrip())
        self._process.kill()
        raise BackendError("the module twins did not start: " + ("\n".join(said[-15:]) or "they said nothing"))
