"""Writes a robot that is described as real and was not checked, and reads the setpoints that its backend received."""

import json
from pathlib import Path
from typing import Any

from snakesim_testing.benches.workbench import read_example_from_docs
from snakesim_testing.runs.bench_host import write_lab_folder
from snakesim_testing.runs.hand_turned_robot import JOINT_COUNT, SCENARIO

BACKEND = "./setpoint_log.py:SetpointLog"


SETPOINT_LOG = """

import json
from pathlib import Path


class SetpointLog(Workbench):
    \"\"\"Writes the setpoints that it receives to a file.\"\"\"

    ticks = 0

    def enact(self, setpoints, lifecycle):
        super().enact(setpoints, lifecycle)
        self.ticks += 1
        received = {"tick": self.ticks, "lifecycle": lifecycle, "mode": setpoints.mode, "target": setpoints.target}
        Path("new.json").write_text(json.dumps({**received, "limit_nm": setpoints.torque_limit_nm}))
        Path("new.json").replace("setpoints.json")
"""


def make_jogged_folder(folder: Path) -> Path:
    """Write the robot, its scenario and its backend `setpoint_log.py` into a folder, and return the folder."""
    real = read_example_from_docs().replace("emulated=True", "emulated=False")
    return write_lab_folder(folder, JOINT_COUNT, SCENARIO, {"setpoint_log.py": real + SETPOINT_LOG})


def read_setpoints(home: Path) -> dict[str, Any]:
    """Return the newest setpoints that the backend received, with their tick and the lifecycle state."""
    return json.loads((home / "setpoints.json").read_text())


def is_at_fault(home: Path) -> bool:
    """Return whether the backend received its newest setpoints while the robot was at fault."""
    return read_setpoints(home)["lifecycle"] == "fault"
