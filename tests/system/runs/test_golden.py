"""One seed, one digest: shipped scenarios do what tests/golden.json says. Other processors: verification/computers."""

import json
from pathlib import Path

import pytest

from snakesim_hal.base import arithmetic
from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_operator.run.in_process import simulate

GOLDEN: dict[str, str] = json.loads((Path(__file__).parents[2] / "golden.json").read_text())
SECONDS = 3
DIFFERING = arithmetic.find_differing_parts(arithmetic.measure_arithmetic())
QUICK = ("triplet", "peg_row")


@pytest.mark.skipif(
    bool(DIFFERING), reason=f"the digests of this computer are its own: {' and '.join(DIFFERING)}"
)
@pytest.mark.parametrize(
    "scenario",
    [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in GOLDEN],
)
def test_shipped_scenario_has_its_digest(scenario: str) -> None:
    """After a change that is meant to change what robots do, `make golden` writes the digests again."""
    done = simulate(load_scenario(scenario, [parse_set_option(f"duration_s={SECONDS}")]).config)
    assert done.summary.command_digest[:16] == GOLDEN[scenario]
