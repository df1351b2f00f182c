"""Everything that docs/how-to/lab.md asks its reader to type is typed here, on four machines, as printed.

Only the machine's `/etc/snakesim` is another folder here, the address of the hub is that of its namespace, and the
clock mode is lockstep, because several robots in real time share a test machine.
"""

import os
import re
import shutil
import sys
import time
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
LIMIT_S = 120.0


def test_a_new_lab_step_by_step(tmp_path: Path) -> None:
    with ExitStack() as stack:
        machines = connect_machines(["hub", "robot1", "ws1", "laptop"], stack)
        for number, (info, script) in enumerate(BLOCKS):
            where = info.rpartition(" on ")[2]
            if info == "sh by hand":
                for machine in machines:  # as rsync does
                    shutil.copytree(
                        tmp_path / "lab" / machine, tmp_path / "etc" / machine, dirs_exist_ok=True
                    )
            elif info.startswith("sh background on"):
                line = f"cd {tmp_path}; exec env {here(script, tmp_path, where)}"
                log, env = tmp_path / f"{number}.log", environment(tmp_path, where)
                machines[where].start("bash", "-c", line, log=log, env=env)
            elif info.startswith("sh on"):
                typed(machines[where], script, tmp_path)


def typed(machine: NamespaceMachine, script: str, folder: Path) -> None:
    """Type a block, line by line; each line as often as somebody who waits for the machines would."""
    exported: list[str] = []
    env = environment(folder, machine.name)
    for line in here(script, folder, machine.name).splitlines():
        if line.startswith("export "):
            exported.append(line)
            continue
        code = (re.search(r"# \(exit code (\d)\)$", line) or ["", "0"])[1]
        deadline = time.monotonic() + LIMIT_S
        while True:
            said = machine.run(
                "bash", "-c", "\n".join([*exported, line]), check=False, cwd=folder, env=env
            )
            if (
                said.endswith(f"(exit code {code})")
                and "host: not running" not in said
                and "control: not" not in said
            ):
                break
            assert time.monotonic() < deadline, f"{line}: {said}\n{logs(folder)}"
            time.sleep(0.5)
        if line.startswith("snakesim lab example"):
            own_places(folder)


def here(script: str, folder: Path, machine: str) -> str:
    """The script with this machine's folder, in lockstep."""
    return script.replace("/etc/snakesim", f"{folder}/etc/{machine}").replace(
        "--backend sim", "--backend sim --clock-mode lockstep"
    )


def own_places(folder: Path) -> None:
    """What a reader edits in step 1."""
    lab = folder / "lab.toml"
    text = re.sub(
        r"^\[machines\.(\w+)\]$", rf'\g<0>\nfolder = "{folder}/etc/\1"', lab.read_text(), flags=re.M
    )
    lab.write_text(text.replace("10.0.0.1", f"{NET}.1"))


def environment(folder: Path, machine: str) -> dict[str, str]:
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    return {"PATH": path, "XDG_STATE_HOME": f"{folder}/state/{machine}", "OMP_NUM_THREADS": "1"}


def logs(folder: Path) -> str:
    return "\n".join(
        f"{path.name}: {path.read_text()[-500:]}" for path in sorted(folder.glob("*.log"))
    )
