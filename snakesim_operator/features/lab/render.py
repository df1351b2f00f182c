"""Writes the files of each machine of a lab into a folder of its own; `certificates` adds the certificates."""

import json
from collections.abc import Iterator
from pathlib import Path

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.textfiles import read_text, write_text
from snakesim_operator.features.lab.identities import identities
from snakesim_operator.features.lab.lab_file import Lab
from snakesim_operator.features.lab.units import unit_files
from snakesim_operator.features.lab.zenoh_files import router_settings, session_settings

WRITTEN = "rendered.txt"  # names of the files that were written, so that the next time leaves none of an earlier lab


def render(lab: Lab, folder: Path) -> list[Path]:
    """Write the files of all machines; return their paths. Files of an earlier lab are removed."""
    files = dict(rendered(lab))
    written: list[Path] = []
    for machine in lab.file.machines:
        own = {name: text for (at, name), text in files.items() if at == machine}
        place = folder / machine
        for old in _written_before(place):
            if old not in own:
                (place / old).unlink(missing_ok=True)
        for name, text in {**own, WRITTEN: "".join(f"{name}\n" for name in sorted(own))}.items():
            write_text(place / name, text)
            written.append(place / name)
    return written


def _written_before(place: Path) -> list[str]:
    try:
        names = read_text(place / WRITTEN).splitlines()
    except ConfigError:
        return []
    return [name for name in names if not name.startswith("/") and ".." not in name]


def rendered(lab: Lab) -> Iterator[tuple[tuple[str, str], str]]:
    """Yield every file as ((machine, path in the machine's folder), text)."""
    for identity in identities(lab):
        settings = router_settings(identity, lab) if identity.role is None else session_settings(identity, lab)
        text = f"// {_origin(lab, identity.common_name)}\n{json.dumps(settings, indent=2)}\n"  # JSON is JSON5
        yield (identity.machine, f"{identity.label}.json5"), text
    for machine in lab.file.machines:
        for name, text in unit_files(lab, machine, _origin(lab, machine)):
            yield (machine, name), text


def _origin(lab: Lab, what: str) -> str:
    return f"{what}, of {lab.file.name}: made from {lab.path.name} by `snakesim lab render`; change it there."
