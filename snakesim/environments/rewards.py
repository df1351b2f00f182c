"""What an environment pays for, term by term."""

from collections.abc import Mapping
from dataclasses import dataclass

from snakesim_hal.base.errors import ConfigError, did_you_mean, short


@dataclass(frozen=True)
class Term:
    """One term: its weight unless another is given, the unit of what it weighs, and what that is."""

    weight: float
    unit: str
    about: str


TERMS = {
    "advance": Term(1.0, "m", "of the center of mass towards the goal; without a goal along the first heading"),
    "energy": Term(-0.005, "J", "sum over joints of |torque x velocity| over time"),
    "limited": Term(-0.001, "1", "share of joints whose targets the limiter changed, mean over the ticks of the step"),
    "goal": Term(1.0, "1", "1 in the step that reaches the goal"),
    "stopped": Term(-1.0, "1", "1 in the step in which the robot is stopped by a fault"),
}


def weights_of(given: Mapping[str, float] | None) -> dict[str, float]:
    """The weight of every term. given: those that differ. Raises ConfigError for what is no term, or no number."""
    for name, weight in (given or {}).items():
        if name not in TERMS:
            hint = did_you_mean(str(name), TERMS)
            raise ConfigError(f"reward={short(str(given))}: no term {name!r}; {hint}there are {', '.join(TERMS)}")
        if not isinstance(weight, int | float):
            raise ConfigError(f"reward[{name!r}]={weight!r:.60}: give a number, the reward per {TERMS[name].unit}")
    return {name: float((given or {}).get(name, term.weight)) for name, term in TERMS.items()}
