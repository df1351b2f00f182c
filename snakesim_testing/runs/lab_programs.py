"""Starts host, services and router as separate programs, as they run on several machines of a lab."""

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
    """Programs that connect to one router. All but the router use the same session file."""

    def __init__(self, folder: Path, stack: contextlib.ExitStack) -> None:
        """Write the files of router and session.

        Args:
            folder: The folder in which the programs run.
            stack: Ends the programs when it closes.
        """
        self.folder = folder
        self.router_file = folder / "router.json5"
        self.session = folder / "session.json5"
        self._stack = stack
        endpoint = find_free_endpoint()
        router_config = ROUTER_CONFIG_PATH.read_text()
        self.router_file.write_text(router_config.replace("tcp/127.0.0.1:7447", endpoint))
        no_scouting = "scouting: {multicast: {enabled: false}, gossip: {enabled: false}}"
        self.session.write_text(
            f'{{mode: "client", connect: {{endpoints: ["{endpoint}"]}}, {no_scouting}}}'
        )

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        """Start a `snakesim` command, whose output goes to a log with its name."""
        log_name = f"{arguments[1]}-{Path(arguments[2]).stem}.log"
        log = self._stack.enter_context((self.folder / log_name).open("a"))
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

    def start_host(self, out: str, *arguments: str) -> subprocess.Popen[str]:
        """Start a HAL host that ends after the duration of its scenario, and writes into the folder `out`."""
        options = ("--end-after-duration", *arguments, "--session", str(self.session))
        return self.start("start", "host", *SCENARIO, *options, "--out", out)

    def start_service(self, name: str, *arguments: str) -> subprocess.Popen[str]:
        """Start the service with this name."""
        options = (*arguments, "--session", str(self.session))
        return self.start("start", "service", name, *SCENARIO, *options)

    def run_operator_command(self, *arguments: str) -> CompletedRun:
        """Run a command to its end, as an operator does on another machine of the lab."""
        return command.snakesim(*arguments, "--session", str(self.session), cwd=self.folder)

    def wait_until_armed(self) -> None:
        """Repeat the command that arms the robot until it succeeds, as an operator does."""
        wait_until(
            lambda: self.run_operator_command("robot", "arm", "planar13", "sim").code == 0,
            "armed",
            60.0,
        )
