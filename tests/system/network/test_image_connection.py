"""A connection for images has a short queue and low priority, unless the session file sets something else."""

import json

import zenoh

from snakesim_hal.network.image_connection import configure_for_images

SEND_BUFFER_KEY = "transport/link/tcp/so_sndbuf"
ENDPOINTS = ["tcp/robot-lab:7447", "tls/[::1]:7447#iface=wlan0", "tcp/far:7447#dscp=0x10"]


def make_zenoh_config(endpoints: list[str] = ENDPOINTS, **link: object) -> zenoh.Config:
    """Make the configuration of a Zenoh client. `link` has the settings of its links."""
    settings = {"mode": "client", "connect": {"endpoints": endpoints}, "transport": {"link": link}}
    return zenoh.Config.from_json5(json.dumps(settings))


def test_image_connection_queue_is_short_and_low_priority() -> None:
    config = make_zenoh_config()
    configure_for_images(config)
    assert int(config.get_json(SEND_BUFFER_KEY)) < 5000
    assert json.loads(config.get_json("connect/endpoints")) == [
        "tcp/robot-lab:7447#dscp=0x28",
        "tls/[::1]:7447#dscp=0x28;iface=wlan0",
        "tcp/far:7447#dscp=0x10",
    ]


def test_image_connection_over_loopback_keeps_default_send_buffer() -> None:
    config = make_zenoh_config(["tcp/127.0.0.1:7447"])
    configure_for_images(config)
    assert config.get_json(SEND_BUFFER_KEY) == "null"


def test_image_connection_keeps_settings_of_session_file() -> None:
    config = make_zenoh_config(tx={"batch_size": 9000}, tcp={"so_sndbuf": 100_000})
    configure_for_images(config)
    assert config.get_json(SEND_BUFFER_KEY) == "100000"
    assert config.get_json("transport/link/tx/batch_size") == "9000"
