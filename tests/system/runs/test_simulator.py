"""`snakesim sim` pauses, steps and resets the simulator of a run of real processes, and the run stays identical."""

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
    expected = simulate(load_scenario(RUN[0], [parse_set_option("duration_s=1")]).config).summary
    out = tmp_path / "run"
    with running_snakesim(out, *RUN) as run:

        def run_sim_command(*arguments: str, code: int = 0) -> str:
            result = run_command_for_robot(run, "sim", *arguments)
            assert result.code == code, result.out + result.err
            return result.out + result.err

        run.wait_for("network:")
        with open_session(ConnectionSettings(run.endpoint, "planar13"), 30.0) as session:
            reader = session.declare_latched_reader(keys.STATUS, RobotStatus)
            statuses: list[RobotStatus] = []

            def is_at(lifecycle: str, tick: int) -> bool:
                statuses.extend(reader.drain())
                if not statuses:
                    return False
                newest = statuses[-1]
                return newest.lifecycle == lifecycle and newest.tick == tick

            wait_until(lambda: request_pause(session), "the pause")
            wait_until(lambda: is_at("armed", 0), "armed in the pause, before the first tick")
            run_sim_command("step", "20")
            wait_until(lambda: is_at("armed", 20), "20 ticks")
            run_sim_command("reset")
            wait_until(lambda: is_at("disarmed", 0) and statuses[-1].ready_to_arm, "another host")
            hosts = {status.host for status in statuses}
            assert len(hosts) == 2, hosts
            assert "as fast as it can" in run_sim_command("speed", "2", code=1)
            run_sim_command("pause")
            assert run_command_for_robot(run, "robot", "arm", "planar13", "sim").code == 0
            run_sim_command("step", "7")
            wait_until(lambda: is_at("armed", 7), "7 ticks")
            wait_until(lambda: "PAUSED" in run.printed(), "the pause on the terminal")
            run_sim_command("resume")
        assert run.end() == 0, run.printed()
    assert_no_process_left(out)
    printed = run.printed()
    assert "the simulator was reset" in printed
    assert "host" in printed
    assert f"command digest        {expected.command_digest[:16]}" in printed
    assert (out / "recording-1.mcap").is_file()
    assert (out / "blackbox-1.rows").is_file()
    recorded = RunRecord.load(out / "recording.mcap").host
    assert recorded.command_digest == expected.command_digest
    assert recorded.ticks == 100
    recording_info = snakesim("recording", "info", str(out), cwd=tmp_path)
    assert recording_info.code == 0, recording_info.printed
    assert "missing" not in recording_info.out, recording_info.printed
    replayed = snakesim("replay", str(out), "--control", cwd=tmp_path)
    # The last command may arrive too late for the recording.
    expected_outputs = {f"{count} commands, the same to the bit\n" for count in (100, 99)}
    assert replayed.out in expected_outputs, replayed.out + replayed.err


def request_pause(session: Session) -> bool:
    """Request a pause; return False while no host answers."""
    with contextlib.suppress(NotConnectedError):
        return session.send_request(
            keys.SIMULATOR, SimulatorRequest(action="pause", requester="ada")
        ).ok
    return False
