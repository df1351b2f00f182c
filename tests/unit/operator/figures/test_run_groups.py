"""The runs of a figure: which arguments name runs, and which runs are drawn as one mean."""

import dataclasses
from pathlib import Path

import msgspec
import numpy as np
import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_operator.features.figures.run_groups import (
    group_runs_by_configuration,
    make_single_run_groups,
    split_runs_and_signals,
)
from snakesim_operator.results.metrics.intervals import find_mean_and_half_width
from snakesim_operator.results.run_log import RunRecord
from snakesim_testing.operator.triplet_report import simulate_triplet


def make_run(folder: str, seed: int, duration_s: float = 10.0) -> RunRecord:
    """Return a simulated run with another folder, seed and duration."""
    config = msgspec.structs.replace(simulate_triplet().config, seed=seed, duration_s=duration_s)
    return dataclasses.replace(simulate_triplet(), path=Path(folder), config=config)


def test_figure_arguments_are_runs_and_then_signals(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "b").mkdir()
    runs, signals = split_runs_and_signals(["runs/a", "b", "angle_rad", "torque_nm.joint_1"])
    assert runs == [Path("runs/a"), Path("b")]
    assert signals == ["angle_rad", "torque_nm.joint_1"]
    assert split_runs_and_signals(["missing"]) == ([Path("missing")], [])


def test_runs_that_differ_only_in_seed_are_one_group() -> None:
    runs = [make_run("a", 1), make_run("b", 2), make_run("c", 1, 5.0), make_run("d", 3)]
    groups = group_runs_by_configuration(runs)
    assert [[run.path.name for run in group.records] for group in groups] == [
        ["a", "b", "d"],
        ["c"],
    ]
    assert [group.label for group in groups] == [
        "duration_s 10 (mean of 3 runs)",
        "duration_s 5 (1 run)",
    ]


def test_run_groups_without_repetitions_are_refused() -> None:
    with pytest.raises(ConfigError, match="differ in their seeds"):
        group_runs_by_configuration([make_run("a", 1), make_run("b", 1, 5.0)])


def test_run_groups_with_one_run_given_twice_are_refused() -> None:
    with pytest.raises(ConfigError, match="count as one run"):
        group_runs_by_configuration([make_run("a", 1), make_run("b", 1), make_run("c", 2)])


def test_run_groups_with_equal_folder_names_have_paths_as_labels() -> None:
    groups = make_single_run_groups([make_run("x/run", 1), make_run("y/run", 2)])
    assert [group.label for group in groups] == ["x/run", "y/run"]


def test_mean_interval_is_computed_for_each_point() -> None:
    """For two values that differ by 2, the standard error is 1, and Student's t is 12.706."""
    mean, half_width = find_mean_and_half_width(np.array([[1.0, 2.0, np.nan], [3.0, 2.0, 1.0]]))
    assert mean[:2].tolist() == [2.0, 2.0]
    assert half_width[:2].tolist() == pytest.approx([12.706, 0.0])
    assert np.isnan(mean[2])
