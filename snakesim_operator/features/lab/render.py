"""Writes the files of each machine of a lab into a folder of its own; `certificates` adds the certificates."""

import json
from collections.abc import Iterator
from pathlib import Path

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.textfiles import read_text, write_text
from snakesim_operator.features.lab.identities import iterate_identities
from snakesim_operator.features.lab.lab_file import LabPlan
from snakesim_operator.features.lab.units import render_unit_files
from snakesim_operator.features.lab.zenoh_files import make_router_settings, make_session_settings

# Names of the files that were written, so that the next time leaves none of an earlier lab.
WRITTEN_FILES_LIST = "rendered.txt"


def write_lab_files(lab: LabPlan, folder: Path) -> list[Path]:
    """Write the files of all machines; return their paths. Files of an earlier lab are removed."""
    files = dict(render_files(lab))
    written: list[Path] = []
    for machine in lab.file.machines:
        machine_files = {
            name: text for (file_machine, name), text in files.items() if file_machine == machine
        }
        machine_folder = folder / machine
        for old_name in _read_written_files(machine_folder):
            if old_name not in machine_files:
                (machine_folder / old_name).unlink(missing_ok=True)
        for name, text in {
            **machine_files,
            WRITTEN_FILES_LIST: "".join(f"{name}\n" for name in sorted(machine_files)),
        }.items():
            write_text(machine_folder / name, text)
            written.append(machine_folder / name)
    return written


def _read_written_files(folder: Path) -> list[str]:
    try:
        names = read_text(folder / WRITTEN_FILES_LIST).splitlines()
    except ConfigError:
        return []
    return [name for name in names if not name.startswith("/") and ".." not in name]


def render_files(lab: LabPlan) -> Iterator[tuple[tuple[str, str], str]]:
    """Yield every file as ((machine, path in the machine's folder), text)."""
    for identity in iterate_identities(lab):
        settings = (
            make_router_settings(identity, lab)
            if identity.role is None
            else make_session_settings(identity, lab)
        )
        text = f"// {_describe_origin(lab, identity.common_name)}\n{json.dumps(settings, indent=2)}\n"  # JSON is JSON5
        yield (identity.machine, f"{identity.label}.json5"), text
    for machine in lab.file.machines:
        for name, text in render_unit_files(lab, machine, _describe_origin(lab, machine)):
            yield (machine, name), text


def _describe_origin(lab: LabPlan, what: str) -> str:
    return f"{what}, of {lab.file.name}: made from {lab.path.name} by `snakesim lab render`; change it there."
