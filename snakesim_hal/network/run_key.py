"""The run key: a secret that a run's processes inherit, by which they know their own host's description.

Anybody on the network can publish a description. The one of a run's own host carries a proof that only somebody with
the run's key could make, so no service of a run believes another.
"""

import hmac
import os
import secrets

import msgspec

from snakesim_hal.wire.codec import encode
from snakesim_hal.wire.messages import Description

RUN_KEY = "SNAKESIM_RUN_KEY"  # environment variable: the processes of other users cannot read it


def new_run_key() -> str:
    """For one run."""
    return secrets.token_hex(32)


def own_run_key() -> str | None:
    """Of the run that this process is part of; None when it was started by itself."""
    return os.environ.get(RUN_KEY) or None


def proven(description: Description, key: str | None) -> Description:
    """The description with its proof."""
    return description if key is None else msgspec.structs.replace(description, proof=_proof(description, key))


def is_proven(description: Description, key: str | None) -> bool:
    """Whether it is of the run's own host; without a key nobody can tell, and any will do."""
    return key is None or hmac.compare_digest(description.proof, _proof(description, key))


def _proof(description: Description, key: str) -> str:
    told = encode(msgspec.structs.replace(description, proof=""))
    return hmac.new(key.encode(), told, "sha256").hexdigest()
