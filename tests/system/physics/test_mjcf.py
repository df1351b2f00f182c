"""A program that imports only MuJoCo loads an exported model, and applies the friction laws of the simulator."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from snakesim_native.libraries import LAWS_LIBRARY
from snakesim_native.load import load_shared_library
from snakesim_sim_backend.model.mjcf import export_mjcf
from snakesim_sim_backend.settings import SimSettings
from snakesim_testing.sim.simulator_rig import make_config

GROUND_FRICTION = 0.3
SPEED_M_S = 0.5
SLIDE_S = 0.1

# This program imports MuJoCo, and nothing of SnakeSIM.
PROGRAM = """
import json, sys
import mujoco
mujoco.mj_loadPluginLibrary(sys.argv[2])
model = mujoco.MjModel.from_xml_path(sys.argv[1])
data = mujoco.MjData(model)
mujoco.mj_step(model, data, round(0.5 / model.opt.timestep))
height = data.qpos[2]
data.qvel[0] = float(sys.argv[3])
mujoco.mj_step(model, data, round(float(sys.argv[4]) / model.opt.timestep))
result = {"height": height, "speed": data.qvel[0], "gravity": -model.opt.gravity[2], "modules": sorted(sys.modules)}
print(json.dumps(result))
"""


@pytest.fixture
def library() -> Path:
    """Provide the path of the compiled friction laws."""
    loaded = load_shared_library(LAWS_LIBRARY)
    if loaded.path is None:
        pytest.skip(loaded.problem)
    return loaded.path


def test_exported_model_in_plain_mujoco_is_slowed_by_dry_friction(
    tmp_path: Path, library: Path
) -> None:
    obstacle = {
        "name": "post",
        "position_m": [5.0, 5.0],
        "size_m": [0.1, 0.1, 0.2],
        "stiffness_n_per_m": 300.0,
    }
    config = make_config(scene={"ground": {"friction": GROUND_FRICTION}, "box": [obstacle]})
    file = tmp_path / "snake.xml"
    file.write_text(export_mjcf(config, SimSettings()))
    assert "snakesim.dry_friction" in file.read_text()
    assert "snakesim.yielding" in file.read_text()

    command = [sys.executable, "-c", PROGRAM, str(file), str(library), str(SPEED_M_S), str(SLIDE_S)]
    process = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=True, timeout=60
    )
    result = json.loads(process.stdout)
    assert not [name for name in result["modules"] if name.startswith("snakesim")]
    assert result["height"] == pytest.approx(config.robot.module.radius_m, abs=1e-3), (
        "the ground does not carry the body"
    )
    speed_loss_m_s = SPEED_M_S - result["speed"]
    assert speed_loss_m_s == pytest.approx(GROUND_FRICTION * result["gravity"] * SLIDE_S, rel=0.05)


def test_exported_model_without_library_is_refused_by_plugin_name(
    tmp_path: Path, library: Path
) -> None:
    assert library.is_file()
    file = tmp_path / "snake.xml"
    file.write_text(
        export_mjcf(make_config(scene={"ground": {"friction": GROUND_FRICTION}}), SimSettings())
    )
    program = f"import mujoco; mujoco.MjModel.from_xml_path({str(file)!r})"
    process = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=60
    )
    assert "snakesim.dry_friction" in process.stderr
