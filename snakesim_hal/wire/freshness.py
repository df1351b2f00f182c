"""The age up to which a joint state counts as fresh."""

from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import RobotDescription

# A fresh state is not older than the longer of the two, plus the delay of its sensor.
FRESH_PERIODS = 3
FRESH_NS = 30_000_000


def max_state_age_ns(description: RobotDescription) -> int:
    """Return the maximum age of a joint state in ns. It is at most a lease, so a silent joint is a fault within it."""
    delay_s = next(
        (sensor.delay_s for sensor in description.sensors if sensor.key == keys.JOINTS), 0.0
    )
    fresh_ns = max(FRESH_PERIODS * description.period_ns, FRESH_NS)
    return min(fresh_ns + round(delay_s * 1e9), description.lease_ns)
