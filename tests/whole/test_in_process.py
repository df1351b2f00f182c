"""What `simulate` and `snakesim run --in-process` leave. What they refuse is in refusals.toml."""

from pathlib import Path

from snakesim_hal.model.scenario import Override, load, parse_set
from snakesim_operator.results.record import BLACK_BOX, CONFIG, DESCRIPTION, HOST_RECORD, RECORDING, REPORT, SUMMARY
from snakesim_operator.run.in_process import WORDS, simulate
from tests.whole.command import snakesim

LEFT = {BLACK_BOX, CONFIG, DESCRIPTION, HOST_RECORD, RECORDING, REPORT, SUMMARY}


def test_the_command_leaves_the_folder_of_a_run(tmp_path: Path) -> None:
    out = tmp_path / "run"
    ended = snakesim("run", "triplet", "--in-process", "--duration", "1", "--out", str(out), cwd=tmp_path)
    assert ended.code == 0, ended.out + ended.err
    assert {path.name for path in out.iterdir()} == LEFT | {WORDS}
    assert "in one process" in ended.out and str(out / REPORT) in ended.out and not ended.err


FAILING = """
from snakesim_gnc.control.hold import Hold


class Failing(Hold):
    def update(self, view):
        if view.tick == 20:
            raise ValueError("no idea")
        return super().update(view)
"""


def test_a_controller_that_fails_ends_the_run_in_a_safe_stop(tmp_path: Path) -> None:
    (tmp_path / "failing.py").write_text(FAILING)
    result = simulate(load("triplet", [Override("controller", f"{tmp_path}/failing.py:Failing", "the test")]).config)
    assert "control ended: controller" in result.summary.ended and "no idea" in result.summary.ended
    assert [fault.what for fault in result.summary.faults] == ["service_lost", "lease_expired"]
    assert result.record.host.lifecycle == "fault"


def test_a_run_that_ends_in_a_fault_is_the_same_each_time() -> None:
    config = load("peg_row", [parse_set("duration_s=3"), parse_set('faults=["mute:joint_3@0.5"]')]).config
    first, second = (simulate(config).summary for _ in range(2))
    assert "joint_3" in first.ended
    assert (first.ticks, first.command_digest) == (second.ticks, second.command_digest)
