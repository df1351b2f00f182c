"""How surfaces grip and yield: the contact parameters of everything that a link can touch.

MuJoCo relaxes friction to a convex problem, which has a price: a contact that slides at speed v is also pushed apart,
with an acceleration of friction * 2 v / (time in which slip is undone). Where that exceeds what the softness of the
contact takes up, a sliding body hops by micrometres, hundreds of times a second, and its IMUs and contact forces
flicker. So slip is undone slowly, and sliding contacts are softer than frictionless ones. Creep at rest stays small
all the same, because `friction_hold` makes friction much stiffer than normals.
"""

from typing import TypedDict

from snakesim_sim_backend.settings import Settings

HARD = [0.95, 0.99, 0.001, 0.5, 2.0]  # solimp, see MuJoCo's manual
SLIDING = [0.9, 0.95, 0.001, 0.5, 2.0]


class Skin(TypedDict):
    """Keyword arguments of MjsBody.add_geom."""

    friction: list[float]
    condim: int
    priority: int
    solref: list[float]
    solimp: list[float]


class Sole(TypedDict):
    """Keyword arguments of MjSpec.add_pair."""

    friction: list[float]
    condim: int
    solref: list[float]
    solreffriction: list[float]
    solimp: list[float]


def obstacle_skin(friction: float, settings: Settings) -> Skin:
    """Of an obstacle. Its priority is above the links', or MuJoCo would take the greater friction of the two."""
    return Skin(
        friction=[friction, 0.0, 0.0],
        condim=3 if friction > 0 else 1,
        priority=1,
        solref=[settings.slip_time_s if friction > 0 else settings.contact_time_s, 1.0],
        solimp=SLIDING if friction > 0 else HARD,
    )


def link_skin(settings: Settings) -> Skin:
    """Of a link; acts only between links."""
    return Skin(
        friction=[settings.self_friction, 0.0, 0.0],
        condim=3 if settings.self_friction > 0 else 1,
        priority=0,
        solref=[settings.contact_time_s, 1.0],
        solimp=HARD,
    )


def ground_sole(friction: float, settings: Settings) -> Sole:
    """Between the ground, or a step, and a link."""
    return Sole(
        friction=[friction, friction, 0.0, 0.0, 0.0],
        condim=3 if friction > 0 else 1,
        solref=[settings.contact_time_s, 1.0],
        solreffriction=[settings.slip_time_s, 1.0],
        solimp=SLIDING if friction > 0 else HARD,
    )
