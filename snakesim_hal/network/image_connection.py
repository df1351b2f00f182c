"""Settings of a connection for images alone, so that they delay nothing else on a slow link.

A session sends everything over one connection. Zenoh sends by priority, but nothing overtakes what the kernel has in
its buffer, nor what waits before the link: an image of 38 kB takes 50 ms at 6 Mbit/s, as long as a lease. On their own
connection images are handed to the kernel in pieces, of which two at most are on their way; a queue that is fair or
knows priorities, as most systems and Wi-Fi have, lets everything else pass them.
"""

import json
from collections.abc import Mapping
from typing import Any

import zenoh

from snakesim_hal.network.endpoint import is_exposed
from snakesim_hal.network.session_file import read_endpoints

# A piece waits up to a second for the one before it. No other thread waits for the thread that sends images.
WAIT_SETTINGS = {
    "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": 1_000_000
}
FRAGMENT_SETTINGS = {
    "transport/link/tx/batch_size": 1400,  # bytes of a piece: less than a packet
    # The least that Linux allows: it takes twice the number, for its own records too. With 4096 a state waited twice as
    # long behind images on a link of 6 Mbit/s; on a good link that makes large images faster.
    **{f"transport/link/{kind}/so_sndbuf": 2304 for kind in ("tcp", "tls")},
}
# The type of service that `pfifo_fast` sends last, and Wi-Fi as background (AF11).
BULK_PARAMETER = "dscp=0x28"
MARKED_PROTOCOLS = ("tcp/", "tls/")


def configure_for_images(config: zenoh.Config) -> None:
    """Change a client's settings into those of its connection for images. Values of a session file stay."""
    endpoints = read_endpoints(config, "connect/endpoints", "client")
    set_if_default(config, WAIT_SETTINGS)
    if any(is_exposed(endpoint) for endpoint in endpoints):  # loopback is never slow
        set_if_default(config, FRAGMENT_SETTINGS)
    marked = [_mark_as_bulk(endpoint) for endpoint in endpoints]
    config.insert_json5("connect/endpoints", json.dumps(marked))


def _mark_as_bulk(endpoint: str) -> str:
    """Return an endpoint with the type of service for bulk data, unless it names one already."""
    if not endpoint.startswith(MARKED_PROTOCOLS) or "dscp=" in endpoint:
        return endpoint
    separator = ";" if "#" in endpoint else "#"
    return f"{endpoint}{separator}{BULK_PARAMETER}"


def set_if_default(config: zenoh.Config, settings: Mapping[str, Any]) -> None:
    """Change the settings that still have Zenoh's default value."""
    untouched = zenoh.Config()
    for key, value in settings.items():
        if config.get_json(key) == untouched.get_json(key):
            config.insert_json5(key, json.dumps(value))
