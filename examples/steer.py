"""Ask a robot for 0.1 m/s towards 0.3 rad for five seconds: with zenoh and msgpack alone. Explained in client.md."""

import json
import sys
import time

import msgpack
import zenoh

ENDPOINT, ROBOT = sys.argv[1:] or ("tcp/127.0.0.1:7447", "planar13")
QUIET = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
LINK = {
    "mode": "client",
    "connect": {"endpoints": [ENDPOINT]},
    "namespace": ROBOT,
    "scouting": QUIET,
}

with zenoh.open(zenoh.Config.from_json5(json.dumps(LINK))) as session:
    clocks, until = (
        session.declare_subscriber("hal/clock", zenoh.handlers.RingChannel(1)),
        time.monotonic() + 5,
    )
    while time.monotonic() < until:
        now_ns = msgpack.unpackb(clocks.recv().payload.to_bytes())["timestamp_ns"]
        wish = {
            "timestamp_ns": now_ns,
            "requester": "steer.py",
            "speed_m_s": 0.1,
            "heading_w_rad": 0.3,
            "valid_for_ns": 500000000,
        }
        session.put(
            "operator/intent",
            msgpack.packb(wish),
            encoding="application/msgpack;snakesim.LocomotionIntent/1",
        )
        time.sleep(0.1)
