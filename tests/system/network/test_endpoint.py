"""Endpoints and namespaces are checked when they are read: mistyped ones are refused with an example."""

import shutil
import subprocess
from pathlib import Path

import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.process import make_child_environment, make_python_command
from snakesim_hal.network.endpoint import (
    check_endpoint,
    check_namespace,
    require_loopback_up,
    require_safe_listening_endpoint,
)
from snakesim_testing.messages import raises_error

VALID_ENDPOINTS = [
    *("tcp/127.0.0.1:7447", "tcp/localhost:1", "tls/lab-router.example:65535"),
    *("tcp/[::1]:7447", "tcp/[fe80::1]:7#iface=eth0", "unixsock-stream/tmp/robot"),
]
INVALID_ENDPOINTS = [
    "banana",
    "",
    "127.0.0.1:7447",
    "tcp/127.0.0.1",
    "tcp/:7447",
    "tcp/127.0.0.1:",
    "tcp/127.0.0.1:http",
    "tcp/127.0.0.1:7447 ",
    "tcp/127.0.0.1:7447\n",
    "http/127.0.0.1:80",
    "tcp/127.0.0.1:0",
    "tcp/127.0.0.1:70000",
    "x" * 10_000,
]


@pytest.mark.parametrize("text", VALID_ENDPOINTS)
def test_check_endpoint_returns_valid_endpoint_unchanged(text: str) -> None:
    assert check_endpoint(text, "--endpoint") == text


@pytest.mark.parametrize("text", INVALID_ENDPOINTS)
def test_check_endpoint_invalid_endpoint_is_refused_with_example(text: str) -> None:
    with raises_error(
        ConfigError, code="network/invalid-address", field=("--router", "tcp/127.0.0.1:7447")
    ) as caught:
        check_endpoint(text, "--router")
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    ("endpoint", "exposed"),
    [
        ("tcp/127.0.0.1:7447", False),
        ("tcp/127.8.0.1:7447", False),
        ("tcp/localhost:7447", False),
        ("tcp/[::1]:7447", False),
        ("unixsock-stream/tmp/robot", False),
        ("tcp/0.0.0.0:7447", True),
        ("tcp/[::]:7447", True),
        ("tls/192.168.1.5:7447#iface=eth0", True),
        ("udp/robot.lab:7447", True),
    ],
)
def test_listening_endpoint_for_other_machines_needs_protection_or_insecure_flag(
    endpoint: str, exposed: bool
) -> None:
    require_safe_listening_endpoint(endpoint, "--endpoint", insecure=True)
    require_safe_listening_endpoint(endpoint, "--endpoint", access_control=True)
    if exposed:
        with raises_error(ConfigError, code="network/insecure-endpoint", field="--endpoint"):
            require_safe_listening_endpoint(endpoint, "--endpoint")
    else:
        require_safe_listening_endpoint(endpoint, "--endpoint")


def test_check_namespace_refuses_empty_parts_and_special_characters() -> None:
    assert check_namespace("lab/planar13", "--namespace") == "lab/planar13"
    for text in ("", "/", "a/", "/a", "a//b", "**", "a/*", "a b", "a#b", "@x", "a\x1b"):
        with raises_error(ConfigError, code="network/invalid-address"):
            check_namespace(text, "--namespace")


# `unshare` starts a program in a new network namespace, whose loopback interface is down.
UNSHARE_COMMAND = ["unshare", "--net", "--map-root-user"]
CLI_CODE = "from snakesim_operator.cli import main; import sys; sys.exit(main(sys.argv[1:]))"


@pytest.mark.heavy
def test_run_without_loopback_names_interface_and_remedy(tmp_path: Path) -> None:
    if (
        shutil.which("unshare") is None
        or subprocess.run([*UNSHARE_COMMAND, "true"], check=False, capture_output=True).returncode
    ):
        pytest.skip("this computer does not allow new network namespaces")
    command = [
        *UNSHARE_COMMAND,
        *make_python_command("-c", CLI_CODE),
        "run",
        "triplet",
        "--out",
        "run",
    ]
    result = subprocess.run(
        command,
        cwd=tmp_path,
        env=make_child_environment(),
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert result.returncode == 1
    assert "loopback interface" in result.stderr
    assert "ip link set lo up" in result.stderr
    assert not (tmp_path / "run").exists()
    require_loopback_up("tcp/127.0.0.1:7447")
    # Not on loopback: whether it answers is another question.
    require_loopback_up("tcp/192.0.2.1:7447")
