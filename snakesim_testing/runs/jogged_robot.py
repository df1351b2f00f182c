"""A robot that claims to be real and was not checked, and what its backend received."""

import json
from pathlib import Path
from typing import Any

from snakesim_testing.benches.workbench import read_example_from_docs
from snakesim_testing.runs.bench import lab_folder
from snakesim_testing.runs.hand_turned_robot import JOINTS, SCENARIO

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
    real = read_example_from_docs().replace("emulated=True", "emulated=False")
    return lab_folder(folder, JOINTS, SCENARIO, {"setpoint_log.py": real + SETPOINT_LOG})


def read_setpoints(home: Path) -> dict[str, Any]:
    return json.loads((home / "setpoints.json").read_text())


def stopped(home: Path) -> bool:
    return read_setpoints(home)["lifecycle"] == "fault"
