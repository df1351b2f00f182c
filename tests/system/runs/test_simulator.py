"""`snakesim sim`, and what it leaves of a run: real processes, over their network."""

import contextlib
from pathlib import Path

import pytest

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import RobotStatus, SimulatorRequest
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.run.in_process import simulate
from snakesim_testing.harness.processes import assert_no_process_left
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.command import running_snakesim
from snakesim_testing.runs.in_process_command import run_command_for_robot, snakesim

pytestmark = pytest.mark.e2e

RUN = ["peg_row", "--duration", "1"]


@pytest.mark.slow  # tests/system/host/test_simulated_time.py
def test_simulator_paused_stepped_and_reset_keeps_digest(tmp_path: Path) -> None:
    plain = simulate(load_scenario(RUN[0], [parse_set_option("duration_s=1")]).config).summary
    out = tmp_path / "run"
    with running_snakesim(out, *RUN) as run:

        def sim(*asked: str, code: int = 0) -> str:
            ended = run_command_for_robot(run, "sim", *asked)
            assert ended.code == code, ended.out + ended.err
            return ended.out + ended.err

        run.wait_for("network:")
        with open_session(ConnectionSettings(run.endpoint, "planar13"), 30.0) as session:
            statuses = session.declare_latched_reader(keys.STATUS, RobotStatus)
            seen: list[RobotStatus] = []

            def shows(lifecycle: str, tick: int) -> bool:
                seen.extend(statuses.drain())
                return bool(seen) and (seen[-1].lifecycle, seen[-1].tick) == (lifecycle, tick)

            wait_until(lambda: pause(session), "the pause")
            wait_until(lambda: shows("armed", 0), "armed in the pause, before the first tick")
            sim("step", "20")
            wait_until(lambda: shows("armed", 20), "20 ticks")
            sim("reset")
            wait_until(lambda: shows("disarmed", 0) and seen[-1].ready_to_arm, "another host")
            hosts = {status.host for status in seen}
            assert len(hosts) == 2, hosts
            assert "as fast as it can" in sim("speed", "2", code=1)
            sim("pause")
            assert run_command_for_robot(run, "robot", "arm", "planar13", "sim").code == 0
            sim("step", "7")
            wait_until(lambda: shows("armed", 7), "7 ticks")
            wait_until(lambda: "PAUSED" in run.printed(), "the pause on the terminal")
            sim("resume")
        assert run.end() == 0, run.printed()
    assert_no_process_left(out)
    said = run.printed()
    assert "the simulator was reset" in said
    assert "host" in said
    assert f"command digest        {plain.command_digest[:16]}" in said
    assert (out / "recording-1.mcap").is_file()
    assert (out / "blackbox-1.rows").is_file()
    recorded = RunRecord.load(out / "recording.mcap").host
    assert recorded.command_digest == plain.command_digest
    assert recorded.ticks == 100
    told = snakesim("recording", "info", str(out), cwd=tmp_path)
    assert told.code == 0 and "missing" not in told.out, told.printed
    replayed = snakesim("replay", str(out), "--control", cwd=tmp_path)
    # The last may come too late.
    same = {f"{count} commands, the same to the bit\n" for count in (100, 99)}
    assert replayed.out in same, replayed.out + replayed.err


def pause(session: Session) -> bool:
    """False while there is no host that answers."""
    with contextlib.suppress(NotConnectedError):
        return session.send_request(
            keys.SIMULATOR, SimulatorRequest(action="pause", requester="ada")
        ).ok
    return False
