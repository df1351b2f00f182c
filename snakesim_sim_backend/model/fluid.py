"""The fluid of a scene, by MuJoCo's own model: every link is an ellipsoid, and gravity compensation is its buoyancy.

Gravity itself stays as it is: the law of flat ground divides by it, and IMUs measure it also in a fluid.
"""

import mujoco

from snakesim_hal.model.scene_file.fluid import Fluid

ELLIPSOID = 1.0  # MjsGeom.fluid_ellipsoid: on


def add_fluid(spec: mujoco.MjSpec, fluid: Fluid | None, link_count: int) -> None:
    """Let the links of a model move in a fluid.

    Args:
        spec: Model with the snake, which is changed.
        fluid: Fluid of the scene. None: there is none, and nothing is changed.
        link_count: Number of links.
    """
    if fluid is None:
        return
    spec.option.density = fluid.density_kg_m3
    spec.option.viscosity = fluid.viscosity_pa_s
    for i in range(link_count):
        spec.body(f"link_{i}").gravcomp = fluid.buoyancy
        geom = spec.geom(f"link_{i}")
        geom.fluid_ellipsoid = ELLIPSOID
        geom.fluid_coefs = [
            fluid.blunt_drag,
            fluid.slender_drag,
            fluid.angular_drag,
            fluid.kutta_lift,
            fluid.magnus_lift,
        ]
