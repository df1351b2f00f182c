"""A number that each field has of its own, such as a friction: what a lab does not choose."""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from snakesim_hal.base.errors import ConfigError, short
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.scenario import Override


class Draw(FileStruct, frozen=True, kw_only=True):
    """Evenly between two numbers, the same for all its keys; a field is a number, and always has the same draw."""

    set: Annotated[list[str], Meta(min_length=1)]
    low: float
    high: float

    def __post_init__(self) -> None:
        """Raises ValueError, for the file reader."""
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low <= self.high):
            raise ValueError(f"`low` = {self.low:g} must be at most `high` = {self.high:g}, and both finite")

    def on_field(self, field: int, origin: str = "[[draw]]") -> list[Override]:
        """By the field's number and the first key, so that a draw more changes no other."""
        number = np.random.default_rng([field, *self.set[0].encode()]).uniform(self.low, self.high)
        return [Override(key, round(float(number), 6), origin) for key in self.set]


def draws_of(given: Mapping[str, Sequence[Any]] | None) -> list[Draw]:
    """Of `{"key": (low, high)}`; a comma puts keys together. Raises ConfigError."""
    found: list[Draw] = []
    for keys, bounds in (given or {}).items():
        try:
            low, high = (float(bound) for bound in bounds)
            found.append(Draw(set=[key.strip() for key in keys.split(",")], low=low, high=high))
        except (TypeError, ValueError):
            wrong = f"draw {keys}: {short(str(bounds))}: give the lowest and the highest number, both finite"
            raise ConfigError(wrong) from None
    return found


def parse_draw(text: str) -> tuple[str, list[str]]:
    """`key=low:high` of --draw, for `draws_of`. Raises ConfigError."""
    keys, equals, given = (part.strip() for part in text.partition("="))
    if not (keys and equals and given):
        raise ConfigError(f"--draw {short(text)}: give KEY=LOW:HIGH, such as scene.ground.friction=0.1:0.4")
    return keys, given.split(":")
