"""Whether a push-point carries: elsewhere the force that a controller has solved for is asked for, and not there."""

from collections.abc import Iterable

from snakesim_hal.wire.messages import WorldContact


def is_felt(push_point: WorldContact, contacts: Iterable[WorldContact]) -> bool:
    """Whether one of the measured contacts is on the push-point's obstacle."""
    return any(contact.obstacle == push_point.obstacle for contact in contacts)
