"""Writes the model of a run as MJCF, MuJoCo's own file format, for other MuJoCo programs."""

from snakesim_hal.model.scenario import RunConfig
from snakesim_sim_backend.model.build import make_blueprint
from snakesim_sim_backend.settings import SimSettings


def export_mjcf(config: RunConfig, settings: SimSettings) -> str:
    """Return the model of a run as MJCF.

    The file names the plugins `snakesim.dry_friction` and `snakesim.yielding`. A program that loads it must first load
    the library with the C version of the laws: `mujoco.mj_loadPluginLibrary(str(load(LAWS).path))`. All numbers have
    the digits that MuJoCo writes, so a simulation of the file may differ from SnakeSIM's own in the last digits.

    Raises:
        ConfigError: the settings do not match the robot or the scene.
        RuntimeError: the C version of the laws cannot be loaded.
    """
    spec = make_blueprint(config, settings, motors=True, laws="c").spec
    spec.compile()
    return spec.to_xml()
