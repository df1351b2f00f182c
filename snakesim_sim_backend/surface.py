"""How a surface grips and yields: the contact parameters of every geom that a link can touch.

Ground and obstacles have a higher MuJoCo priority than links, so that their own values act; MuJoCo would otherwise
take the greater friction of the two.
"""

from typing import TypedDict


class Surface(TypedDict):
    """Keyword arguments of MjsBody.add_geom."""

    friction: list[float]
    condim: int
    priority: int
    solref: list[float]
    solimp: list[float]


def surface(friction: float, contact_time_s: float, *, priority: int = 1) -> Surface:
    """Contact parameters of a surface with a Coulomb coefficient. Without friction only a normal force acts."""
    return Surface(
        friction=[friction, 0.0, 0.0],
        condim=3 if friction > 0 else 1,
        priority=priority,
        solref=[contact_time_s, 1.0],
        solimp=[0.95, 0.99, 0.001, 0.5, 2.0],
    )
