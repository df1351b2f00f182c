"""Writes the model of a run as MJCF, MuJoCo's own file format, for other MuJoCo programs."""

from snakesim_hal.model.scenario import RunConfig
from snakesim_sim_backend.model.build import assemble_model_blueprint
from snakesim_sim_backend.settings import SimSettings


def export_mjcf(config: RunConfig, settings: SimSettings) -> str:
    """Return the model of a run as MJCF.

    The file names the plugins `snakesim.dry_friction` and `snakesim.yielding`. A program that loads it must first load
    the library with the C version of the laws, at `load_shared_library(LAWS_LIBRARY).path`, by
    `mujoco.mj_loadPluginLibrary`. All numbers have the digits that MuJoCo writes, so a simulation of the file may
    differ from SnakeSIM's own in the last digits.

    Raises:
        ConfigError: The settings do not match the robot or the scene.
        RuntimeError: The C version of the laws cannot be loaded.
    """
    spec = assemble_model_blueprint(config, settings, motors=True, laws="c").spec
    spec.compile()
    return spec.to_xml()
