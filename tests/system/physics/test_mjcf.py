"""Another MuJoCo program loads an exported model, and MuJoCo's engine applies the laws there."""

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

MU = 0.3
SPEED_M_S = 0.5
SLIDE_S = 0.1

# It knows MuJoCo alone.
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
    """Return the compiled laws."""
    loaded = load_shared_library(LAWS_LIBRARY)
    if loaded.path is None:
        pytest.skip(loaded.problem)
    return loaded.path


def test_a_snake_slides_to_a_stop_in_a_program_that_knows_mujoco_alone(
    tmp_path: Path, library: Path
) -> None:
    obstacle = {
        "name": "post",
        "position_m": [5.0, 5.0],
        "size_m": [0.1, 0.1, 0.2],
        "stiffness_n_per_m": 300.0,
    }
    config = make_config(scene={"ground": {"friction": MU}, "box": [obstacle]})
    file = tmp_path / "snake.xml"
    file.write_text(export_mjcf(config, SimSettings()))
    assert "snakesim.dry_friction" in file.read_text()
    assert "snakesim.yielding" in file.read_text()

    command = [sys.executable, "-c", PROGRAM, str(file), str(library), str(SPEED_M_S), str(SLIDE_S)]
    finished = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=True, timeout=60
    )
    result = json.loads(finished.stdout)
    assert not [name for name in result["modules"] if name.startswith("snakesim")]
    assert result["height"] == pytest.approx(config.robot.module.radius_m, abs=1e-3), (
        "the ground does not carry it"
    )
    lost_m_s = SPEED_M_S - result["speed"]
    assert lost_m_s == pytest.approx(MU * result["gravity"] * SLIDE_S, rel=0.05)


def test_a_model_without_the_library_is_refused_by_name(tmp_path: Path, library: Path) -> None:
    assert library.is_file()
    file = tmp_path / "snake.xml"
    file.write_text(export_mjcf(make_config(scene={"ground": {"friction": MU}}), SimSettings()))
    program = f"import mujoco; mujoco.MjModel.from_xml_path({str(file)!r})"
    finished = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=60
    )
    assert "snakesim.dry_friction" in finished.stderr
