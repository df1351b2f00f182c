"""How old a joint state may be."""

from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Description

FRESH_PERIODS, FRESH_NS = 3, 30_000_000  # the longer of the two, plus its delay


def oldest_state_ns(description: Description) -> int:
    """Shorter than the lease, so that a silent joint is a fault within the lease."""
    delay_s = next((sensor.delay_s for sensor in description.sensors if sensor.key == keys.JOINTS), 0.0)
    fresh_ns = max(FRESH_PERIODS * description.period_ns, FRESH_NS)
    return min(fresh_ns + round(delay_s * 1e9), description.lease_ns)
