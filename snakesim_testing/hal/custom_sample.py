"""A sample of a custom sensor, with a field of each allowed type."""

from typing import Annotated, Any, Literal

from msgspec import Meta

from snakesim_hal.wire import quantities as q
from snakesim_hal.wire.messages import CustomSample


class SkinSample(CustomSample, frozen=True, kw_only=True):
    """A sample with one field of each allowed type."""

    pressed_n: Annotated[list[q.Force | None], Meta(max_length=3)]
    flow_m_s: q.VelocityVector
    wet: bool
    count: Annotated[int, Meta(ge=0, le=9)]
    state: Literal["cold", "warm"]
    note: Annotated[str, Meta(max_length=9)] | None = None


MOUNTING: dict[str, Any] = {
    "tick": 3,
    "timestamp_ns": 2,
    "link": 1,
    "position_l": (0.0, 0.1, 0.0),
    "orientation_l_wxyz": (1.0, 0.0, 0.0, 0.0),
}
VALID_VALUES: dict[str, Any] = {
    "pressed_n": [1.5, None],
    "flow_m_s": (1.0, 2.0, 3.0),
    "wet": True,
    "count": 4,
    "state": "warm",
}
