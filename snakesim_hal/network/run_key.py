"""The run key: a secret that a run's processes inherit, by which they recognize their own host's description.

Any client on the network can publish a description. The one of a run's own host carries a proof that needs
the run's key, so the services of a run reject any other.
"""

import hmac
import os
import secrets

import msgspec

from snakesim_hal.wire.codec import encode
from snakesim_hal.wire.messages import RobotDescription

RUN_KEY = "SNAKESIM_RUN_KEY"  # environment variable: the processes of other users cannot read it


def new_run_key() -> str:
    """Return a new key, for one run."""
    return secrets.token_hex(32)


def read_own_run_key() -> str | None:
    """Return the key of the run that this process is part of; None if it was started on its own."""
    return os.environ.get(RUN_KEY) or None


def add_proof(description: RobotDescription, key: str | None) -> RobotDescription:
    """Return a description with the proof that it is of the run with this key."""
    if key is None:
        return description
    return msgspec.structs.replace(description, proof=_compute_proof(description, key))


def has_valid_proof(description: RobotDescription, key: str | None) -> bool:
    """Return whether a description is of the run's own host. Without a key, any description is accepted."""
    if key is None:
        return True
    return hmac.compare_digest(description.proof, _compute_proof(description, key))


def _compute_proof(description: RobotDescription, key: str) -> str:
    unproven = encode(msgspec.structs.replace(description, proof=""))
    return hmac.new(key.encode(), unproven, "sha256").hexdigest()
