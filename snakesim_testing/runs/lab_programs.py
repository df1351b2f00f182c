"""Host, services and router as programs of their own."""

import contextlib
import subprocess
from pathlib import Path

from snakesim_hal.model.files import ROUTER_CONFIG_PATH
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs import in_process_command as command
from snakesim_testing.runs.command import SNAKESIM_COMMAND, CompletedRun, make_environment

SCENARIO = ("triplet", "--duration", "1")


class LabPrograms:
    """Programs that share a router, and a session file each."""

    def __init__(self, folder: Path, stack: contextlib.ExitStack) -> None:
        self.folder, self._stack = folder, stack
        endpoint = find_free_endpoint()
        quiet = "scouting: {multicast: {enabled: false}, gossip: {enabled: false}}"
        self.router_file, self.session = folder / "router.json5", folder / "session.json5"
        self.router_file.write_text(
            ROUTER_CONFIG_PATH.read_text().replace("tcp/127.0.0.1:7447", endpoint)
        )
        self.session.write_text(
            f'{{mode: "client", connect: {{endpoints: ["{endpoint}"]}}, {quiet}}}'
        )

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        """One of them."""
        log = self._stack.enter_context(
            (self.folder / f"{arguments[1]}-{Path(arguments[2]).stem}.log").open("a")
        )
        process = subprocess.Popen(
            [*SNAKESIM_COMMAND, *arguments],
            cwd=self.folder,
            env=make_environment(self.folder),
            stdout=log,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._stack.callback(process.wait, 10)
        self._stack.callback(process.kill)
        return process

    def host(self, out: str, *arguments: str) -> subprocess.Popen[str]:
        """A HAL host."""
        return self.start(
            "start",
            "host",
            *SCENARIO,
            "--end-after-duration",
            *arguments,
            "--session",
            str(self.session),
            "--out",
            out,
        )

    def service(self, name: str, *arguments: str) -> subprocess.Popen[str]:
        """A service."""
        return self.start(
            "start", "service", name, *SCENARIO, *arguments, "--session", str(self.session)
        )

    def run_operator_command(self, *arguments: str) -> CompletedRun:
        """An operator's command, on another machine."""
        return command.snakesim(*arguments, "--session", str(self.session), cwd=self.folder)

    def until_armed(self) -> None:
        """As a person does it: until the answer is yes."""
        wait_until(
            lambda: self.run_operator_command("robot", "arm", "planar13", "sim").code == 0,
            "armed",
            60.0,
        )
