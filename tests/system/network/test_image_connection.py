"""What a connection for images alone has, and what a session file decides."""

import json

import zenoh

from snakesim_hal.network.image_connection import configure_for_images

SNDBUF = "transport/link/tcp/so_sndbuf"


ENDPOINTS = ["tcp/robot-lab:7447", "tls/[::1]:7447#iface=wlan0", "tcp/far:7447#dscp=0x10"]


def settings(endpoints: list[str] = ENDPOINTS, **link: object) -> zenoh.Config:
    file = {"mode": "client", "connect": {"endpoints": endpoints}, "transport": {"link": link}}
    return zenoh.Config.from_json5(json.dumps(file))


def test_image_connection_queue_is_short_and_low_priority() -> None:
    config = settings()
    configure_for_images(config)
    assert int(config.get_json(SNDBUF)) < 5000
    assert json.loads(config.get_json("connect/endpoints")) == [
        "tcp/robot-lab:7447#dscp=0x28",
        "tls/[::1]:7447#dscp=0x28;iface=wlan0",
        "tcp/far:7447#dscp=0x10",
    ]


def test_loopback_is_never_slow() -> None:
    config = settings(["tcp/127.0.0.1:7447"])
    configure_for_images(config)
    assert config.get_json(SNDBUF) == "null"


def test_what_a_session_file_says_stays() -> None:
    config = settings(tx={"batch_size": 9000}, tcp={"so_sndbuf": 100_000})
    configure_for_images(config)
    assert config.get_json(SNDBUF) == "100000"
    assert config.get_json("transport/link/tx/batch_size") == "9000"
