"""The sentences in the documentation that a qualification tests on a drive. Pure.

A claim's id is stable: records name it. A test compares each sentence with its page.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Claim:
    """One sentence of a page below docs/."""

    id: str
    page: str
    sentence: str  # as in the page's source, with single spaces
    driver_types: tuple[str, ...] = ()  # empty: all


WITH_WATCHDOG = ("can", "cia402", "dynamixel", "moteus", "odrive")

CLAIMS = (
    Claim(
        "limits-held",
        "concepts/safety.md",
        "An armed robot stays within its limits of angle, speed, acceleration, torque and rate.",
    ),
    Claim(
        "si-units",
        "hardware/write-a-driver.md",
        "Angles, speeds and torques of the drives are those at their shafts, in SI units.",
    ),
    Claim(
        "stops-without-host",
        "hardware/README.md",
        "Every drive but one stops by itself when its host dies.",
        WITH_WATCHDOG,
    ),
    Claim(
        "holds-without-host",
        "hardware/README.md",
        "Feetech servos have no watchdog: they hold their last angle until their supply is cut.",
        ("feetech",),
    ),
    Claim(
        "polling-feeds-watchdog",
        "hardware/dynamixel.md",
        "If another program sends packets to a servo, the servo keeps its torque after the host has died.",
        ("dynamixel",),
    ),
    Claim("stop-is-a-fault", "concepts/stop-modes.md", "**Each such stop is a fault.**"),
    Claim(
        "stays-off", "concepts/stop-modes.md", "**No drive is enabled before `reset` and `arm`.**"
    ),
    Claim(
        "never-arms-itself",
        "concepts/safety.md",
        "The robot never arms by itself, also not after a restart.",
    ),
    Claim("estop-off-at-once", "concepts/safety.md", "off, at once, on every drive"),
    Claim(
        "estop-without-zenoh",
        "concepts/safety.md",
        "An emergency stop reaches the host without a lease, and without Zenoh if necessary.",
    ),
    Claim("bus-cut-odrive", "hardware/odrive.md", "The axes stop by their watchdog", ("odrive",)),
    Claim(
        "bus-cut-moteus",
        "hardware/moteus.md",
        "The controllers stop by their watchdog",
        ("moteus",),
    ),
    Claim(
        "bus-cut-dynamixel",
        "hardware/dynamixel.md",
        "The servos stop by their watchdog",
        ("dynamixel",),
    ),
    Claim("bus-cut-can", "hardware/joint-modules.md", "driver: fault. Modules: watchdog", ("can",)),
    Claim(
        "bus-cut-cia402",
        "hardware/cia402.md",
        "`watchdog_s` counts from the last heartbeat of the host, which it sends with the setpoints of the bus.",
        ("cia402",),
    ),
    Claim(
        "bus-cut-feetech",
        "hardware/feetech.md",
        "switches the torque off once the bus is back",
        ("feetech",),
    ),
)
CLAIM_BY_ID = {claim.id: claim for claim in CLAIMS}


def list_claims(driver_type: str) -> list[Claim]:
    """Return the claims that a qualification of a driver type tests."""
    return [
        claim for claim in CLAIMS if not claim.driver_types or driver_type in claim.driver_types
    ]
