"""The two versions of the laws: in C, as plugins of MuJoCo's engine, and in Python.

Both compute the same bits. The C version is used if its library can be loaded (see `snakesim_native`). The Python
version is the specification that tests compare the C version with, and is used on a computer without a C compiler.
"""

import ctypes
from typing import Literal

import mujoco

from snakesim_native.libraries import LAWS_LIBRARY
from snakesim_native.load import load_shared_library
from snakesim_sim_backend.laws.contact_friction import count_contact_values
from snakesim_sim_backend.laws.directional import USER_VALUES_PER_GEOM
from snakesim_sim_backend.laws.flat_ground import VALUES_PER_FOOT
from snakesim_sim_backend.laws.yielding import DOFS, VALUES_PER_SPRING

LawsVersion = Literal["c", "python"]

FRICTION_PLUGIN = "snakesim.dry_friction"
YIELDING_PLUGIN = "snakesim.yielding"
TOUCHES_PLUGIN = "snakesim.touches"
MEASURED_FORCE_PLUGIN = "snakesim.measured_force"
FRICTION_INSTANCE = "dry_friction"  # names in MuJoCo's model
YIELDING_INSTANCE = "yielding"
TOUCHES_INSTANCE = "touches"
MEASURED_FORCE_INSTANCE = "measured_force"


def choose_laws() -> LawsVersion:
    """Return the version that this process uses: the C version, if it can be loaded."""
    if load_shared_library(LAWS_LIBRARY).library is None:
        return "python"
    return "c"


def load_library() -> ctypes.CDLL:
    """Return the library with the C version, whose plugins MuJoCo knows from then on.

    Raises:
        RuntimeError: The library cannot be loaded.
    """
    loaded = load_shared_library(LAWS_LIBRARY)
    if loaded.library is None:
        raise RuntimeError(f"the C version of the laws cannot be loaded: {loaded.problem}")
    return loaded.library


def add_laws(
    spec: mujoco.MjSpec,
    laws: LawsVersion,
    link_count: int,
    yielding_bodies: list[str],
    *,
    keeps_touches: bool,
    measures_force: bool,
) -> None:
    """Add the laws' parameters and memory to a model that is otherwise complete.

    Args:
        spec: Model, which is changed.
        laws: Version of the laws that computes the forces.
        link_count: Number of links.
        yielding_bodies: Names of the bodies of obstacles that yield.
        keeps_touches: Whether the C version writes the forces between links and obstacles into MuJoCo's state.
        measures_force: Whether the force between links and obstacles can be measured.
    """
    spec.nuser_geom = USER_VALUES_PER_GEOM
    spec.nuser_body = VALUES_PER_SPRING
    match laws:
        case "python":
            spec.nuserdata = (
                VALUES_PER_FOOT * (link_count + 1)
                + count_contact_values(link_count)
                + DOFS * len(yielding_bodies)
            )
        case "c":
            load_library()
            _add_plugin(spec, FRICTION_PLUGIN, FRICTION_INSTANCE, ["link_0"])
            if yielding_bodies:
                _add_plugin(spec, YIELDING_PLUGIN, YIELDING_INSTANCE, yielding_bodies)
            if keeps_touches:
                _add_plugin(spec, TOUCHES_PLUGIN, TOUCHES_INSTANCE, [])
            if measures_force:
                _add_plugin(spec, MEASURED_FORCE_PLUGIN, MEASURED_FORCE_INSTANCE, [])


def _add_plugin(spec: mujoco.MjSpec, plugin: str, instance: str, bodies: list[str]) -> None:
    """Add an instance of a plugin, which belongs to these bodies. It advances after those that are added before."""
    spec.activate_plugin(plugin)
    spec.add_plugin(name=instance, plugin_name=plugin, active=True)
    for body in bodies:
        reference = spec.body(body).plugin
        reference.active = True
        reference.plugin_name = plugin
        reference.name = instance
