"""Test that the import contracts in pyproject.toml detect wrong imports, by adding some to a copy of the packages."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]
LINTER = Path(sys.executable).parent / "lint-imports"
NEIGHBORS = "Packages: each imports only packages below it"
HAL = "Subpackages of the HAL"
OPERATOR = "Subpackages of the operator package"
CAN = "Subpackages of the CAN backend"
PURE = "What keeps a robot safe is pure"
WRONG_IMPORTS = [  # (folder, imported module, contract that the import breaks)
    ("snakesim_gnc", "mujoco", "Only the simulator runs MuJoCo"),
    ("snakesim_gnc", "snakesim_sim_backend.model.build", NEIGHBORS),
    ("snakesim_hal/host", "snakesim_gnc.guidance.service", NEIGHBORS),
    ("snakesim_operator/run", "zenoh", "Only the network package of the HAL imports Zenoh"),
    ("snakesim_hal/host", "zenoh", "Only the network package of the HAL imports Zenoh"),
    ("snakesim_gnc", "can", "Only the CAN backend touches CAN"),
    ("snakesim_hal/safety", "time", PURE),
    ("snakesim_hal/safety", "threading", PURE),
    ("snakesim_hal/wire", "snakesim_hal.model.robot_file.robot", HAL),
    ("snakesim_hal/model", "snakesim_hal.backend", HAL),
    ("snakesim_hal/safety", "snakesim_hal.network.session", HAL),
    ("snakesim_hal/network", "snakesim_hal.faults.injector", HAL),
    ("snakesim_hal/faults", "snakesim_hal.host.host", HAL),
    ("snakesim_hal/host", "snakesim_hal.programs.service_program", HAL),
    ("snakesim_hal/faults", "snakesim_hal.service", HAL),
    ("snakesim_operator/results", "snakesim_operator.robot_commands.status", OPERATOR),
    ("snakesim_operator/robot_commands", "snakesim_operator.run.processes.supervisor", OPERATOR),
    ("snakesim_operator/run", "snakesim_operator.cli", OPERATOR),
    ("snakesim_can_backend/protocol", "snakesim_can_backend.settings", CAN),
    ("snakesim_can_backend/bus", "snakesim_can_backend.emulator.chain", CAN),
    ("snakesim_can_backend/emulator", "snakesim_can_backend.driver.backend", CAN),
    ("snakesim_can_backend/driver", "snakesim_can_backend.can_command", CAN),
]

REPORT_COLUMNS = "300"  # the linter breaks longer lines


@pytest.mark.skipif(
    not LINTER.is_file(), reason="import-linter is not installed in this environment"
)
def test_wrong_import_breaks_its_contract_at_every_level(tmp_path: Path) -> None:
    shutil.copy(REPOSITORY / "pyproject.toml", tmp_path)
    for package in REPOSITORY.glob("snakesim*/"):
        shutil.copytree(
            package, tmp_path / package.name, ignore=shutil.ignore_patterns("__pycache__")
        )
    for folder, _, _ in WRONG_IMPORTS:
        modules = sorted({module for place, module, _ in WRONG_IMPORTS if place == folder})
        imports = "".join(f"import {module}\n" for module in modules)
        (tmp_path / folder / "planted.py").write_text(f'"""Breaks rules."""\n\n{imports}')
    (tmp_path / "snakesim_hal" / "in_no_layer.py").write_text('"""Belongs to no layer."""\n')
    command = [str(LINTER), "--config", "pyproject.toml", "--no-cache"]
    report = subprocess.run(
        command,
        cwd=tmp_path,
        env={**os.environ, "COLUMNS": REPORT_COLUMNS},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    ).stdout
    for folder, module, contract in WRONG_IMPORTS:
        broken = next(row for row in report.splitlines() if row.startswith(contract))
        assert broken.endswith("BROKEN"), broken
        planted = f"{folder.replace('/', '.')}.planted"
        assert re.search(
            rf"{re.escape(planted)} -> {re.escape(module)}\b|{re.escape(planted)}.*{module}", report
        ), report
    assert "in_no_layer" in report
