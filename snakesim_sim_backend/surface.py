"""How hard everything is that MuJoCo finds contacts of. They only push: friction is in contact_friction.py."""

from typing import TypedDict

from snakesim_sim_backend.settings import SimSettings

IMPEDANCE = [0.95, 0.99, 0.001, 0.5, 2.0]  # solimp, see MuJoCo's manual: at first touch, and 1 mm deeper


class Skin(TypedDict):
    """Keyword arguments of MjsBody.add_geom."""

    condim: int
    solref: list[float]
    solimp: list[float]


def skin(settings: SimSettings) -> Skin:
    """Of every geom that touches."""
    return Skin(condim=1, solref=[settings.contact_time_s, 1.0], solimp=IMPEDANCE)
