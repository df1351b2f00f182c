"""Robot, router, workstation and laptop as four machines with rendered files: mTLS and access control between them."""

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
LIMIT_S = 120.0


class Lab:
    """The example lab, rendered, its machines and programs running."""

    def __init__(self, folder: Path, backend: str, stack: ExitStack) -> None:
        self.folder = folder
        self.machines = connect_machines(["hub", "robot1", "ws1", "laptop"], stack)
        (folder / "lab.toml").write_text(example(folder, backend))
        for step in ("certs", "render"):
            self.at("hub", "lab", step, "lab.toml", "--out", ".")
        scenario = (*SCENARIO, "--backend", backend)
        self.start("hub", "router", "start", "router", str(folder / "hub" / "router.main.json5"))
        out = ("--end-after-duration", "--out", str(folder / "record"))
        self.start(
            "robot1",
            "host",
            "start",
            "host",
            *scenario,
            *self.session("robot1", "robot.planar13"),
            *out,
        )
        for name in ("guidance", "navigation", "control"):
            self.start(
                "ws1",
                name,
                "start",
                "service",
                name,
                *scenario,
                *self.session("ws1", "gnc.planar13"),
            )

    def at(self, machine: str, *arguments: str, check: bool = True) -> str:
        """A `snakesim` command on one machine; what it says."""
        state = {"XDG_STATE_HOME": str(self.folder / "state" / machine)}
        return self.machines[machine].run(
            *SNAKESIM_COMMAND, *arguments, check=check, cwd=self.folder, env=state
        )

    def start(self, machine: str, name: str, *arguments: str) -> None:
        """A program of ours on one machine."""
        state = {"XDG_STATE_HOME": str(self.folder / "state" / machine), "OMP_NUM_THREADS": "1"}
        self.machines[machine].start(
            *SNAKESIM_COMMAND, *arguments, log=self.folder / f"{name}.log", env=state
        )

    def session(self, machine: str, label: str) -> tuple[str, str]:
        return "--session", str(self.folder / machine / f"{label}.json5")

    def logs(self) -> str:
        return "\n".join(
            f"{path.name}: {path.read_text()[-800:]}" for path in self.folder.glob("*.log")
        )


def example(folder: Path, backend: str) -> str:
    """The example with its folders here, without the recorder."""
    text = re.sub(
        r"^\[machines\.(\w+)\]$",
        rf'\g<0>\nfolder = "{folder}/\1"',
        EXAMPLE_PATH.read_text(),
        flags=re.M,
    )
    text = text.replace("10.0.0.1", f"{NET}.1").replace('backend = "sim"', f'backend = "{backend}"')
    return re.sub(
        r'\[\[roles\]\]\nmachine = "ws1"\nrole = "recorder"\nrobot = "planar13"\n', "", text
    )


def until(lab: Lab, words: str, *arguments: str) -> None:
    """Repeat an operator's command until it says these words."""
    deadline = time.monotonic() + LIMIT_S
    while words not in (said := lab.at("laptop", *arguments, check=False)):
        assert time.monotonic() < deadline, f"{said}\n{lab.logs()}"
        time.sleep(0.2)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["sim", pytest.param("can", marks=pytest.mark.slow)])
def test_lockstep_across_four_machines_has_digest_of_one(tmp_path: Path, backend: str) -> None:
    """With `can` the joints are emulated modules, on a bus in the host's memory.

    Even while somebody with a viewer's certificate repeats, commands and answers whatever they can.
    """
    with ExitStack() as stack:
        lab = Lab(tmp_path, backend, stack)
        operator, viewer = (
            lab.session("laptop", "operator.planar13"),
            lab.session("laptop", "viewer.planar13"),
        )
        until(lab, "next: `snakesim robot arm planar13", "status", *viewer)
        checked = lab.at("hub", "lab", "check", "lab.toml", "--out", ".")
        assert "all is as it should be" in checked, checked
        lab.machines["laptop"].start_module(
            "snakesim_testing.lab.intruder", viewer[1], log=tmp_path / "intruder.log"
        )
        refused = lab.at("laptop", "robot", "arm", "planar13", backend, *viewer, check=False)
        assert "exit code 1" in refused, refused
        until(lab, "planar13: armed", "robot", "arm", "planar13", backend, *operator)
        record = finished(lab)
        more = ("--in-process",) if backend == "sim" else ()
        # By this machine alone.
        lab.at("robot1", "run", *SCENARIO, "--backend", backend, "--out", "alone", *more)
    assert record.command_digest == read_summary(tmp_path / "alone").command_digest, lab.logs()
    did = (tmp_path / "intruder.log").read_text().splitlines()[-1]
    assert re.fullmatch(r"\{'repeated': \d{3,}, 'commanded': \d{2,}\}", did), did


def finished(lab: Lab) -> HostRecord:
    """The host's record, when it has ended."""
    path, deadline = lab.folder / "record" / "host.json", time.monotonic() + LIMIT_S
    while True:
        if path.is_file():
            record = msgspec.json.decode(path.read_bytes(), type=HostRecord)
            if record.ended == "complete" and record.ticks >= 100:
                return record
        assert time.monotonic() < deadline, lab.logs()
        time.sleep(0.1)
