"""Reads the units in the column metadata of Parquet files with pyarrow."""

from pathlib import Path

import pytest

from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_operator.playback.export import export_run
from snakesim_operator.run.in_process import simulate

parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra `report`")


def test_parquet_export_has_unit_of_every_column(tmp_path: Path) -> None:
    run_folder = tmp_path / "run"
    exported = tmp_path / "a.parquet"
    simulate(load_scenario("triplet", [parse_set_option("duration_s=0.3")]).config, run_folder)
    assert export_run([run_folder], "parquet", exported, lambda _line: None) == 0
    schema = parquet.read_schema(exported)
    units = {column.name: column.metadata[b"unit"].decode() for column in schema}
    assert units["time_s"] == "s"
    assert units["torque_nm.joint_3"] == "N·m"
    assert units["velocity_b_m_s.x"] == "m/s"
    assert units["link_force_l_n.link_3.y"] == "N"
    table = parquet.read_table(exported)
    assert table.num_rows == 30
    assert table["time_s"].to_pylist()[1] == pytest.approx(0.01, abs=0.011)


def test_parquet_table_of_evaluation_has_units(tmp_path: Path) -> None:
    from snakesim_operator.features.evaluate.store import PARQUET_FILENAME, write_tables

    write_tables(tmp_path, [], {})
    schema = parquet.read_schema(tmp_path / PARQUET_FILENAME)
    assert schema.field("displacement_m_s").metadata[b"unit"] == b"m/s"
    assert schema.field("controller").metadata is None
