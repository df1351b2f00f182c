"""The measured contact forces do not depend on the hardness of the simulator's surfaces."""

import numpy as np
import pytest

from snakesim_testing.runs.whole_run import load_run_config, run_controller

# The first one is the shortest that steps of 2 ms allow. The peaks of single instants vary sixfold among them.
CONTACT_TIMES_S = 0.004, 0.005, 0.01, 0.02
JAM_FORCE_N = 60.0  # above this measured force, the controller reports a jam


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["triplet", "peg_row"])
def test_contact_force_peak_hardly_depends_on_surface_hardness(scenario: str) -> None:
    runs = [
        run_controller(
            load_run_config(scenario, f"backends.sim.contact_time_s={time_s}"), duration_s=8.0
        )
        for time_s in CONTACT_TIMES_S
    ]
    assert not any(report.jammed for run in runs for report in run.reports)
    peaks_n = np.array([np.nanmax(run.record.contact_peak_n) for run in runs])
    print(
        scenario,
        *(
            f"{time_s} s: {peak_n:.1f} N;"
            for time_s, peak_n in zip(CONTACT_TIMES_S, peaks_n, strict=True)
        ),
    )
    assert np.abs(peaks_n / peaks_n.mean() - 1).max() < 0.1
    # The peaks are similar to the propulsion of 35 N, and too small for a jam.
    assert 10.0 < peaks_n.mean() < JAM_FORCE_N


@pytest.mark.slow
@pytest.mark.parametrize(
    "contact_time_s",
    [
        *CONTACT_TIMES_S[::3],
        *(pytest.param(s, marks=pytest.mark.slow) for s in CONTACT_TIMES_S[1:3]),
    ],
)
def test_jam_is_reported_for_every_surface_hardness(contact_time_s: float) -> None:
    run = run_controller(
        load_run_config("jam", f"backends.sim.contact_time_s={contact_time_s}"), duration_s=4.0
    )
    assert any(report.jammed for report in run.reports)
    assert np.nanmax(run.record.contact_peak_n) > JAM_FORCE_N
