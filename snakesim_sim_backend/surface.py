"""Friction and softness of what MuJoCo has contacts for: obstacles, links, hills, steps. Flat ground: flat_ground.py.

MuJoCo relaxes friction to a convex problem, with a side effect: a contact that slides at speed v is also pushed apart,
with an acceleration of friction * 2 v / (time in which slip is corrected). If that exceeds what the softness of the
contact can absorb, a sliding body hops by micrometres, hundreds of times a second, and its IMUs and contact forces
are noisy. So slip is corrected slowly, and sliding contacts are softer than frictionless ones. Creep at rest stays
small, because `friction_hold` makes friction much stiffer than normals. The price: friction that is corrected slowly
follows changes of speed rather than opposing speed, so undulation on hills drifts by up to 20 mm/s towards the tail.
"""

from typing import TypedDict

from snakesim_sim_backend.settings import SimSettings

# solimp, see MuJoCo's manual: how hard a contact is at first touch, and 1 mm deeper.
BARE = [0.95, 0.99, 0.001, 0.5, 2.0]
RUBBING = [0.9, 0.95, 0.001, 0.5, 2.0]
LYING = [0.5, 0.9, 0.001, 0.5, 2.0]  # takes up the push of sliding under the body's own weight; sinks in by 0.1 mm


class LinkSurface(TypedDict):
    """Keyword arguments of MjsBody.add_geom."""

    friction: list[float]
    condim: int
    priority: int
    solref: list[float]
    solimp: list[float]


class PairSurface(TypedDict):
    """Keyword arguments of MjSpec.add_pair."""

    friction: list[float]
    condim: int
    solref: list[float]
    solreffriction: list[float]
    solimp: list[float]


def frictionless_skin(settings: SimSettings) -> LinkSurface:
    """Of an obstacle that only pushes. Its priority is above the links', or their friction would act."""
    return LinkSurface(
        friction=[0.0, 0.0, 0.0], condim=1, priority=1, solref=[settings.contact_time_s, 1.0], solimp=BARE
    )


def link_skin(settings: SimSettings) -> LinkSurface:
    """Of a link; acts only between links."""
    return LinkSurface(
        friction=[settings.self_friction, 0.0, 0.0],
        condim=3 if settings.self_friction > 0 else 1,
        priority=0,
        solref=[settings.contact_time_s, 1.0],
        solimp=RUBBING,
    )


def pair_surface(friction: float, settings: SimSettings, *, bears_weight: bool) -> PairSurface:
    """Between a link and ground, step or rough obstacle. Only a pair of geoms can have a slip time of its own."""
    return PairSurface(
        friction=[friction, friction, 0.0, 0.0, 0.0],
        condim=3 if friction > 0 else 1,
        solref=[settings.contact_time_s, 1.0],
        solreffriction=[settings.slip_time_s, 1.0],
        solimp=BARE if friction == 0 else LYING if bears_weight else RUBBING,
    )
