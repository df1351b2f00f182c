"""Contact parameters of everything that MuJoCo finds contacts of.

MuJoCo only pushes: friction is in contact_friction.py.
"""

from typing import TypedDict

from snakesim_sim_backend.settings import SimSettings

# Solimp, see MuJoCo's manual: at first touch, and 1 mm deeper.
IMPEDANCE = [0.95, 0.99, 0.001, 0.5, 2.0]
FRICTIONLESS_DIMENSION = 1  # condim: normal force alone


class ContactParameters(TypedDict):
    """Keyword arguments of MjsBody.add_geom."""

    condim: int
    solref: list[float]
    solimp: list[float]


def make_contact_parameters(settings: SimSettings) -> ContactParameters:
    """Return the contact parameters of every geom that can touch another."""
    return ContactParameters(
        condim=FRICTIONLESS_DIMENSION, solref=[settings.contact_time_s, 1.0], solimp=IMPEDANCE
    )
