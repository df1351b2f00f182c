"""Forces of contacts as a robot would feel them do not depend on how hard the simulator's surfaces are."""

import numpy as np
import pytest

from snakesim_testing.runs.whole_run import load_run_config, run_controller

# From the shortest at steps of 2 ms; an instant's peak varies sixfold.
CONTACT_TIMES_S = 0.004, 0.005, 0.01, 0.02


@pytest.mark.slow  # so is a jam below
@pytest.mark.parametrize("scenario", ["triplet", "peg_row"])
def test_contact_force_peak_hardly_depends_on_surface_hardness(scenario: str) -> None:
    wholes = [
        run_controller(
            load_run_config(scenario, f"backends.sim.contact_time_s={time_s}"), duration_s=8.0
        )
        for time_s in CONTACT_TIMES_S
    ]
    assert not any(report.jammed for whole in wholes for report in whole.reports)
    peaks_n = np.array([np.nanmax(whole.record.contact_peak_n) for whole in wholes])
    print(
        scenario,
        *(
            f"{time_s} s: {peak_n:.1f} N;"
            for time_s, peak_n in zip(CONTACT_TIMES_S, peaks_n, strict=True)
        ),
    )
    assert np.abs(peaks_n / peaks_n.mean() - 1).max() < 0.1
    # Of the order of the 35 N of propulsion, and less than what lets go of a triplet.
    assert 10.0 < peaks_n.mean() < 60.0


@pytest.mark.slow
@pytest.mark.parametrize(
    "contact_time_s",
    [
        *CONTACT_TIMES_S[::3],
        *(pytest.param(s, marks=pytest.mark.slow) for s in CONTACT_TIMES_S[1:3]),
    ],
)
def test_a_jam_is_a_jam_however_hard_the_surfaces_are(contact_time_s: float) -> None:
    whole = run_controller(
        load_run_config("jam", f"backends.sim.contact_time_s={contact_time_s}"), duration_s=4.0
    )
    assert any(report.jammed for report in whole.reports)
    assert np.nanmax(whole.record.contact_peak_n) > 60.0  # jam_force_n
