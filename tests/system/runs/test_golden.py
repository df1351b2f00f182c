"""Shipped scenarios have the command digests of tests/golden.json (other processors: verification/computers)."""

import json
from pathlib import Path

import pytest

from snakesim_hal.base import arithmetic
from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_operator.run.in_process import simulate

GOLDEN_DIGESTS: dict[str, str] = json.loads((Path(__file__).parents[2] / "golden.json").read_text())
DURATION_S = 3
DIFFERING_PARTS = arithmetic.find_differing_parts(arithmetic.measure_arithmetic())
QUICK_SCENARIOS = ("triplet", "peg_row")


@pytest.mark.heavy
@pytest.mark.skipif(
    bool(DIFFERING_PARTS),
    reason=f"the digests of this computer are its own: {' and '.join(DIFFERING_PARTS)}",
)
@pytest.mark.parametrize(
    "scenario",
    [
        pytest.param(name, marks=() if name in QUICK_SCENARIOS else pytest.mark.slow)
        for name in GOLDEN_DIGESTS
    ],
)
def test_shipped_scenario_has_its_golden_digest(scenario: str) -> None:
    """Run `make golden` to update the digests after an intended change of the motion of robots."""
    result = simulate(
        load_scenario(scenario, [parse_set_option(f"duration_s={DURATION_S}")]).config
    )
    assert result.summary.command_digest[:16] == GOLDEN_DIGESTS[scenario]
