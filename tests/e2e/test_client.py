"""The clients that docs/client.md shows: few lines, nothing of ours in them, and a robot that does what they ask."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from snakesim_hal.network.session import Link, Session, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import JointState, Status
from tests.e2e.command import Running, call, running
from tests.harness.wait import wait_until

pytestmark = pytest.mark.e2e

DOCS = Path(__file__).parents[2] / "docs"
CLIENT, STEER, STOP = DOCS / "client.py", DOCS / "steer.py", DOCS / "stop.py"
EXTERNAL = ("triplet", "--set", "services.control.external=true", "--set", "rate_hz=50", "--duration", "600", "--stay")
DEPTH = 8192


@pytest.fixture(scope="module", params=["realtime", "lockstep"])
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """One for both clients: it ends in an emergency stop."""
    with running(tmp_path_factory.mktemp("client") / "run", *EXTERNAL, "--pace", request.param) as started:
        started.wait_for("a client that takes the lease")
        yield started


def status(session: Session) -> Status:
    found = session.latest(keys.STATUS, Status, 10.0)
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("script", "known"), [(CLIENT, {"msgpack", "zenoh"}), (STEER, {"msgpack", "zenoh"}), (STOP, set[str]())]
)
def test_a_client_needs_nothing_of_ours(script: Path, known: set[str]) -> None:
    tree = ast.parse(script.read_text(encoding="utf-8"))
    assert not [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    imported = {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    assert imported - sys.stdlib_module_names == known


def test_the_clients_are_as_short_as_they_are_said_to_be() -> None:
    assert len(CLIENT.read_text(encoding="utf-8").splitlines()) <= 60
    lines = STOP.read_text(encoding="utf-8").split("import sys\n")[1].split("\n")
    assert len([line for line in lines if line]) == 9


def test_a_client_leases_arms_moves_and_disarms(run: Running) -> None:
    with open_session(Link(run.endpoint, "planar13")) as session:
        wait_until(lambda: status(session).waiting_for == ["control"], "a run that waits for control alone")
        joints = session.reader(keys.JOINTS, JointState, depth=DEPTH)
        ended = call([sys.executable, CLIENT, run.endpoint, "planar13"], run.home, urgent=True)
        assert ended.code == 0, ended.out + ended.err
        angles = [state.angle_rad for state in joints.drain()]
        furthest = [max(abs(angle - joint[0]) for angle in joint) for joint in zip(*angles, strict=True)]
        assert 0.09 < furthest[2] < 0.11, furthest
        assert max(furthest[:2] + furthest[3:]) < 0.03, furthest
        now = status(session)
        assert now.lifecycle == "disarmed"
        assert now.commands_rejected in ({}, {"no_lease": 1})  # its last, if that arrives after it has left
        assert now.commands_accepted > 50 and {fault.what for fault in now.faults} <= {"service_lost"}


def test_a_stop_by_udp_stops_the_robot(run: Running) -> None:
    host, _, port = run.endpoint.removeprefix("tcp/").partition(":")
    ended = call([sys.executable, STOP, host, port], run.home)
    assert ended.code == 0 and ended.out.startswith("planar13\n") and "anna" in ended.out, ended.out + ended.err
    with open_session(Link(run.endpoint, "planar13")) as session:
        assert status(session).lifecycle == "estop"
