"""The run key: a secret that a run's processes inherit, by which they recognize their own host's description.

Any client on the network can publish a description. The one of a run's own host carries a proof that needs
the run's key, so the services of a run reject any other.
"""

import hmac
import os
import secrets

import msgspec

from snakesim_hal.wire.codec import encode
from snakesim_hal.wire.messages import Description

RUN_KEY = "SNAKESIM_RUN_KEY"  # environment variable: the processes of other users cannot read it


def new_run_key() -> str:
    """A new key, for one run."""
    return secrets.token_hex(32)


def own_run_key() -> str | None:
    """The key of the run that this process is part of; None when it was started on its own."""
    return os.environ.get(RUN_KEY) or None


def proven(description: Description, key: str | None) -> Description:
    """The description with its proof."""
    return description if key is None else msgspec.structs.replace(description, proof=_proof(description, key))


def is_proven(description: Description, key: str | None) -> bool:
    """Whether it is of the run's own host; without a key this cannot be checked, and any is accepted."""
    return key is None or hmac.compare_digest(description.proof, _proof(description, key))


def _proof(description: Description, key: str) -> str:
    unproven = encode(msgspec.structs.replace(description, proof=""))
    return hmac.new(key.encode(), unproven, "sha256").hexdigest()
