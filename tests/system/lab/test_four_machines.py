"""A robot runs in lockstep across four machines that use the rendered files of a lab, with mTLS and access control.

The machines are network namespaces: a hub with the router, the robot, a workstation and a laptop.
"""

import os
import re
import time
from contextlib import ExitStack
from pathlib import Path

import msgspec
import pytest

from snakesim_hal.run_log.host_record import HostRecord
from snakesim_operator.features.lab.lab_file import EXAMPLE_PATH
from snakesim_testing.lab.machines import NET, connect_machines
from snakesim_testing.runs.command import SNAKESIM_COMMAND, read_summary

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.timeout(400),
    pytest.mark.skipif(os.geteuid() != 0, reason="network namespaces need root"),
]
SCENARIO = ("triplet", "--clock-mode", "lockstep", "--duration", "1")
STEP_TIMEOUT_S = 120.0  # for each step of the test, on a busy computer
MIN_TICKS = 100  # control cycles of a complete run


class Lab:
    """The example lab with its rendered files, whose machines and programs are running."""

    def __init__(self, folder: Path, backend: str, stack: ExitStack) -> None:
        self.folder = folder
        self.machines = connect_machines(["hub", "robot1", "ws1", "laptop"], stack)
        (folder / "lab.toml").write_text(format_lab_file(folder, backend))
        for step in ("certs", "render"):
            self.run_snakesim("hub", "lab", step, "lab.toml", "--out", ".")
        scenario = (*SCENARIO, "--backend", backend)
        self.start_snakesim(
            "hub", "router", "start", "router", str(folder / "hub" / "router.main.json5")
        )
        out = ("--end-after-duration", "--out", str(folder / "record"))
        self.start_snakesim(
            "robot1",
            "host",
            "start",
            "host",
            *scenario,
            *self.make_session_options("robot1", "robot.planar13"),
            *out,
        )
        for name in ("guidance", "navigation", "control"):
            self.start_snakesim(
                "ws1",
                name,
                "start",
                "service",
                name,
                *scenario,
                *self.make_session_options("ws1", "gnc.planar13"),
            )

    def run_snakesim(self, machine: str, *arguments: str, check: bool = True) -> str:
        """Run a `snakesim` command on one machine, and return its output."""
        environment = {"XDG_STATE_HOME": str(self.folder / "state" / machine)}
        return self.machines[machine].run(
            *SNAKESIM_COMMAND, *arguments, check=check, cwd=self.folder, env=environment
        )

    def start_snakesim(self, machine: str, name: str, *arguments: str) -> None:
        """Start a `snakesim` program on one machine, with its output in `name`.log."""
        environment = {
            "XDG_STATE_HOME": str(self.folder / "state" / machine),
            "OMP_NUM_THREADS": "1",
        }
        self.machines[machine].start(
            *SNAKESIM_COMMAND, *arguments, log=self.folder / f"{name}.log", env=environment
        )

    def make_session_options(self, machine: str, label: str) -> tuple[str, str]:
        """Return the options that select a session file of a machine."""
        return "--session", str(self.folder / machine / f"{label}.json5")

    def read_logs(self) -> str:
        """Return the end of each program's log."""
        return "\n".join(
            f"{path.name}: {path.read_text()[-800:]}" for path in self.folder.glob("*.log")
        )


def format_lab_file(folder: Path, backend: str) -> str:
    """Return the example lab file without its recorder, with machine folders below `folder`."""
    text = re.sub(
        r"^\[machines\.(\w+)\]$",
        rf'\g<0>\nfolder = "{folder}/\1"',
        EXAMPLE_PATH.read_text(),
        flags=re.M,
    )
    text = text.replace("10.0.0.1", f"{NET}.1").replace('backend = "sim"', f'backend = "{backend}"')
    text = re.sub(r"^can = .*", "emulated = true", text, flags=re.M)
    return re.sub(
        r'\[\[roles\]\]\nmachine = "ws1"\nrole = "recorder"\nrobot = "planar13"\n', "", text
    )


def repeat_until_printed(lab: Lab, text: str, *arguments: str) -> None:
    """Repeat a `snakesim` command on the laptop until its output contains a text."""
    deadline_s = time.monotonic() + STEP_TIMEOUT_S
    output = lab.run_snakesim("laptop", *arguments, check=False)
    while text not in output:
        assert time.monotonic() < deadline_s, f"{output}\n{lab.read_logs()}"
        time.sleep(0.2)
        output = lab.run_snakesim("laptop", *arguments, check=False)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["sim", pytest.param("can", marks=pytest.mark.slow)])
def test_lockstep_on_four_machines_has_digest_of_one_machine(tmp_path: Path, backend: str) -> None:
    """The digest is the same although an intruder attacks with the certificate of a viewer.

    The intruder repeats messages, sends commands, and answers queries.
    With `can`, the joints are emulated modules on a bus in the host's memory.
    """
    with ExitStack() as stack:
        lab = Lab(tmp_path, backend, stack)
        operator = lab.make_session_options("laptop", "operator.planar13")
        viewer = lab.make_session_options("laptop", "viewer.planar13")
        repeat_until_printed(lab, "next: `snakesim robot arm planar13", "status", *viewer)
        check_output = lab.run_snakesim("hub", "lab", "check", "lab.toml", "--out", ".")
        assert "all is as it should be" in check_output, check_output
        lab.machines["laptop"].start_module(
            "snakesim_testing.lab.intruder", viewer[1], log=tmp_path / "intruder.log"
        )
        refusal = lab.run_snakesim(
            "laptop", "robot", "arm", "planar13", backend, *viewer, check=False
        )
        assert "exit code 1" in refusal, refusal
        repeat_until_printed(lab, "planar13: armed", "robot", "arm", "planar13", backend, *operator)
        record = wait_for_host_record(lab)
        # Repeat the run on one machine.
        options = ("--in-process",) if backend == "sim" else ()
        lab.run_snakesim(
            "robot1", "run", *SCENARIO, "--backend", backend, "--out", "alone", *options
        )
    expected_digest = read_summary(tmp_path / "alone").command_digest
    assert record.command_digest == expected_digest, lab.read_logs()
    attack_counts = (tmp_path / "intruder.log").read_text().splitlines()[-1]
    assert re.fullmatch(r"\{'repeated': \d{3,}, 'commanded': \d{2,}\}", attack_counts), (
        attack_counts
    )


def wait_for_host_record(lab: Lab) -> HostRecord:
    """Wait until the host has completed its run, and return its record."""
    path = lab.folder / "record" / "host.json"
    deadline_s = time.monotonic() + STEP_TIMEOUT_S
    while True:
        if path.is_file():
            record = msgspec.json.decode(path.read_bytes(), type=HostRecord)
            if record.ended == "complete" and record.ticks >= MIN_TICKS:
                return record
        assert time.monotonic() < deadline_s, lab.read_logs()
        time.sleep(0.1)
