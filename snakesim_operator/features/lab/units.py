"""Renders systemd units, CAN bring-up and a compose file for a lab's machines, from the templates in this folder."""

import re
from collections.abc import Iterator
from ipaddress import ip_address
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from snakesim_hal.base.process import SERVICE_PRIORITY
from snakesim_operator.features.lab.drive_buses import list_can_interfaces
from snakesim_operator.features.lab.lab_file import LabPlan
from snakesim_operator.features.lab.programs import STATE_FOLDER, MachineProgram, iterate_programs

CONTAINER_USER = "10001:10001"
NEEDS_QUOTES = re.compile(r"[\s';]")


def render_unit_files(lab: LabPlan, machine: str, origin: str) -> Iterator[tuple[str, str]]:
    """Render the service files of a machine: systemd units, and a Compose file with the same programs.

    Args:
        lab: The lab.
        machine: Name of the machine in the lab file.
        origin: A line that names the source of the files; it is written at their top.

    Yields:
        The path of a file relative to the machine's folder, and its text.
    """
    templates = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,
    )
    template_variables = {
        "machine": lab.file.machines[machine],
        "origin": origin,
        "state": STATE_FOLDER,
        "uid": CONTAINER_USER,
        "priority": SERVICE_PRIORITY,
    }
    machine_programs = list(iterate_programs(lab, machine))
    unit_template = templates.get_template("unit.j2")
    for program in machine_programs:
        command = _format_command_line(lab, program)
        text = unit_template.render(
            **template_variables,
            program=program,
            command=command,
            addresses=_list_router_addresses(lab),
        )
        yield f"systemd/{program.name}.service", text
    can_template = templates.get_template("can.j2")
    for robot in lab.file.robots.values():
        if robot.machine != machine:
            continue
        for interface in list_can_interfaces(robot):
            text = can_template.render(**template_variables, interface=interface)
            yield f"systemd/snakesim-{interface.name}.service", text
    if machine_programs:
        commands = [(program, ["snakesim", *program.arguments]) for program in machine_programs]
        yield (
            "compose.yaml",
            templates.get_template("compose.j2").render(**template_variables, programs=commands),
        )


def _format_command_line(lab: LabPlan, program: MachineProgram) -> str:
    """Return the command as systemd splits it. The file's types allow no double quotes, `%`, `$` or backslashes."""
    words = (lab.file.machines[program.identity.machine].program, *program.arguments)
    return " ".join(f'"{word}"' if NEEDS_QUOTES.search(word) else word for word in words)


def _list_router_addresses(lab: LabPlan) -> list[str]:
    """Return the addresses of the routers, or none if one of them is a name."""
    addresses = [
        lab.file.machines[router.machine].address or "" for router in lab.file.routers.values()
    ]
    try:
        return sorted({str(ip_address(address)) for address in addresses})
    except ValueError:
        return []
