"""Test that runs all commands of docs/how-to/lab.md as printed, on four machines that are network namespaces.

Three things differ from the page: each machine has a temporary folder instead of `/etc/snakesim`, the hub has the
address of its namespace, and the clock mode is lockstep, because several robots share one computer here.
"""

import os
import re
import shutil
import sys
import time
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path

import pytest

from snakesim_testing.lab.machines import NET, NamespaceMachine, connect_machines
from snakesim_testing.runs.documents import REPOSITORY, parse_sections

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.slow,  # test_four_machines.py is the quick one
    pytest.mark.timeout(600),
    pytest.mark.skipif(os.geteuid() != 0, reason="network namespaces need root"),
]
BLOCKS = [
    block
    for section in parse_sections(REPOSITORY / "docs" / "how-to" / "lab.md")
    for block in section.blocks
]
COMMAND_TIMEOUT_S = 120.0
RETRY_INTERVAL_S = 0.5
NOT_READY_MESSAGES = ("host: not running", "control: not")
PRINTED_HUB_ADDRESS = "10.0.0.1"


def test_lab_page_commands_succeed_as_printed(tmp_path: Path) -> None:
    with ExitStack() as stack:
        machines = connect_machines(["hub", "robot1", "ws1", "laptop"], stack)
        for number, (info, script) in enumerate(BLOCKS):
            _, _, machine = info.rpartition(" on ")
            if info == "sh by hand":
                copy_configuration(machines, tmp_path)
            elif info.startswith("sh background on"):
                adapted_script = adapt_script(script, tmp_path, machine)
                machines[machine].start(
                    "bash",
                    "-c",
                    f"cd {tmp_path}; exec env {adapted_script}",
                    log=tmp_path / f"{number}.log",
                    env=make_machine_environment(tmp_path, machine),
                )
            elif info.startswith("sh on"):
                run_block(machines[machine], script, tmp_path)


def copy_configuration(machines: Iterable[str], folder: Path) -> None:
    """Copy the rendered configuration to each machine, as the reader does with rsync."""
    for machine in machines:
        shutil.copytree(folder / "lab" / machine, folder / "etc" / machine, dirs_exist_ok=True)


def run_block(machine: NamespaceMachine, script: str, folder: Path) -> None:
    """Run a block line by line. A line is repeated until it succeeds, as a reader does who waits for machines."""
    exports: list[str] = []
    for line in adapt_script(script, folder, machine.name).splitlines():
        if line.startswith("export "):
            exports.append(line)
            continue
        repeat_until_ready(machine, "\n".join([*exports, line]), folder)
        if line.startswith("snakesim lab example"):
            edit_lab_file(folder)


def repeat_until_ready(machine: NamespaceMachine, script: str, folder: Path) -> None:
    """Run commands until they end with the exit code in their last comment, and all processes are running."""
    environment = make_machine_environment(folder, machine.name)
    code_comment = re.search(r"# \(exit code (\d)\)$", script)
    expected_code = code_comment[1] if code_comment else "0"
    deadline_s = time.monotonic() + COMMAND_TIMEOUT_S
    while True:
        output = machine.run("bash", "-c", script, check=False, cwd=folder, env=environment)
        has_expected_code = output.endswith(f"(exit code {expected_code})")
        if has_expected_code and not any(message in output for message in NOT_READY_MESSAGES):
            return
        assert time.monotonic() < deadline_s, f"{script}: {output}\n{read_log_tails(folder)}"
        time.sleep(RETRY_INTERVAL_S)


def adapt_script(script: str, folder: Path, machine: str) -> str:
    """Return a script that uses the machine's temporary folder, and runs robots in lockstep."""
    script = script.replace("/etc/snakesim", f"{folder}/etc/{machine}")
    return script.replace("--backend sim", "--backend sim --clock-mode lockstep")


def edit_lab_file(folder: Path) -> None:
    """Set the folder of each machine and the address of the hub in the lab file, which a reader edits in step 1."""
    path = folder / "lab.toml"
    text = re.sub(
        r"^\[machines\.(\w+)\]$",
        rf'\g<0>\nfolder = "{folder}/etc/\1"',
        path.read_text(),
        flags=re.M,
    )
    path.write_text(text.replace(PRINTED_HUB_ADDRESS, f"{NET}.1"))


def make_machine_environment(folder: Path, machine: str) -> dict[str, str]:
    """Return variables with this Python first on the search path, and a state folder for one machine."""
    return {
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "XDG_STATE_HOME": f"{folder}/state/{machine}",
        "OMP_NUM_THREADS": "1",
    }


def read_log_tails(folder: Path) -> str:
    """Return the ends of all logs in a folder."""
    return "\n".join(
        f"{path.name}: {path.read_text()[-500:]}" for path in sorted(folder.glob("*.log"))
    )
