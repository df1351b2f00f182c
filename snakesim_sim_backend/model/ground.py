"""The ground as MuJoCo has it: a plane, or a height field of smooth random hills."""

import mujoco

from snakesim_hal.model.scene_file.scene import Ground, Heightfield
from snakesim_hal.physics.hills import make_heights
from snakesim_sim_backend.model.surface import ContactParameters

GROUND = "ground"  # name of the plane's geom
HILLS = "hills"  # name of the height field and of its geom
GROUND_GROUP = 1  # MuJoCo geom group of everything that the snake may lie on, including steps
PLANE_GROUP = 4  # of the plane: where rays hit it is computed without MuJoCo, see sensors/rays.py
SAND = [0.76, 0.70, 0.58, 1.0]  # color
DEPTH_M = 0.5  # of the height field below its lowest point


def add_ground(spec: mujoco.MjSpec, ground: Ground, contact: ContactParameters) -> list[str]:
    """Add the ground to a model: a plane, and hills above it if the scene has a heightfield.

    Args:
        spec: Model, which is changed.
        ground: Ground of the scene.
        contact: Parameters of MuJoCo's contacts with hills.

    Returns:
        The names of the geoms of which MuJoCo finds contacts. The list is empty for flat ground, whose contacts
        flat_ground.py computes.
    """
    if ground.heightfield is None:
        plane = _add_plane(spec, height_m=0.0)
        plane.contype = 0
        plane.conaffinity = 0
        return []
    lowest_m = -ground.heightfield.height_m / 2
    plane = _add_plane(spec, height_m=lowest_m)  # it catches what leaves the hills
    plane.condim = contact["condim"]
    plane.solref = contact["solref"]
    plane.solimp = contact["solimp"]
    _add_hills(spec, ground.heightfield, lowest_m, contact)
    return [GROUND, HILLS]


def _add_plane(spec: mujoco.MjSpec, height_m: float) -> mujoco.MjsGeom:
    return spec.worldbody.add_geom(
        name=GROUND,
        group=PLANE_GROUP,
        rgba=SAND,
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 1],
        pos=[0, 0, height_m],
    )


def _add_hills(
    spec: mujoco.MjSpec, field: Heightfield, lowest_m: float, contact: ContactParameters
) -> None:
    """Add a heightfield with the heights of the scene's hills.

    Args:
        spec: Model, which is changed.
        field: Size, height, wavelength and seed of the hills.
        lowest_m: Height of the lowest point of the hills in m.
        contact: Parameters of MuJoCo's contacts.
    """
    heights_m = make_heights(field)
    row_count = len(heights_m)
    spec.add_hfield(
        name=HILLS,
        nrow=row_count,
        ncol=row_count,
        size=[field.area_m / 2, field.area_m / 2, field.height_m, DEPTH_M],
        userdata=((heights_m - lowest_m) / field.height_m).ravel().tolist(),  # 0 to 1
    )
    spec.worldbody.add_geom(
        name=HILLS,
        group=GROUND_GROUP,
        rgba=SAND,
        type=mujoco.mjtGeom.mjGEOM_HFIELD,
        hfieldname=HILLS,
        pos=[0, 0, lowest_m],
        **contact,
    )
