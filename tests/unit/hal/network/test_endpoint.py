"""Endpoints and namespaces as people mistype them."""

import pytest

from snakesim_hal.errors import ConfigError
from snakesim_hal.network.endpoint import check_endpoint, check_namespace

GOOD = [
    *("tcp/127.0.0.1:7447", "tcp/localhost:1", "tls/lab-router.example:65535"),
    *("tcp/[::1]:7447", "tcp/[fe80::1]:7#iface=eth0", "unixsock-stream/tmp/robot"),
]
WRONG = {
    "banana": "this is not an endpoint",
    "": "this is not an endpoint",
    "127.0.0.1:7447": "this is not an endpoint",
    "tcp/127.0.0.1": "this is not an endpoint",
    "tcp/:7447": "this is not an endpoint",
    "tcp/127.0.0.1:": "this is not an endpoint",
    "tcp/127.0.0.1:http": "this is not an endpoint",
    "tcp/127.0.0.1:7447 ": "this is not an endpoint",
    "tcp/127.0.0.1:7447\n": "this is not an endpoint",
    "http/127.0.0.1:80": "the protocol is one of tcp",
    "tcp/127.0.0.1:0": "the port is a number from 1 to 65535",
    "tcp/127.0.0.1:70000": "the port is a number from 1 to 65535",
    "x" * 10_000: "this is not an endpoint",
}


@pytest.mark.parametrize("text", GOOD)
def test_an_endpoint_is_taken_as_it_is(text: str) -> None:
    assert check_endpoint(text, "--endpoint") == text


@pytest.mark.parametrize("text", WRONG)
def test_a_wrong_endpoint_says_what_a_valid_one_looks_like(text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        check_endpoint(text, "--router")
    said = str(caught.value)
    assert said.startswith("--router ") and WRONG[text] in said and "tcp/127.0.0.1:7447" in said and len(said) < 400


def test_namespaces() -> None:
    assert check_namespace("lab/planar13", "--namespace") == "lab/planar13"
    for text in ("", "/", "a/", "/a", "a//b", "**", "a/*", "a b", "a#b", "@x", "a\x1b"):
        with pytest.raises(ConfigError, match="such as planar13"):
            check_namespace(text, "--namespace")
