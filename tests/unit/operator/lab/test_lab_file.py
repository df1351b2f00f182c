"""The lab file and the roles of a lab: errors name the conflict, and each role has only its permissions."""

from pathlib import Path

import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.wire.roles import ACCESS_RULES, ROLE_DESCRIPTIONS, Role, iterate_permissions
from snakesim_operator.features.lab.identities import iterate_identities
from snakesim_operator.features.lab.lab_file import EXAMPLE_PATH, load_lab
from snakesim_testing.messages import raises_error

EXAMPLE_TEXT = EXAMPLE_PATH.read_text()


def test_lab_example_assigns_every_role() -> None:
    identities = list(iterate_identities(load_lab(EXAMPLE_PATH)))
    assert {identity.role for identity in identities} == {*Role, None}
    assert len({identity.common_name for identity in identities}) == len(identities)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('machine = "robot1"\nscenario', 'machine = "robot7"\nscenario'),
        ('address = "10.0.0.1"\n', ""),
        ('role = "gnc"', 'role = "pilot"'),
        ('role = "gnc"\nrobot = "planar13"', 'role = "gnc"\nrobot = "all"'),
        ('role = "recorder"', 'role = "gnc"'),
        ('role = "recorder"\nrobot = "planar13"', 'role = "recorder"\nrobot = "snake"'),
        ("certificate_days = 30", "certificate_days = 3000"),
        ("[machines.laptop]", "[machines.Laptop]"),
        ("[routers.main]", "[router.main]"),
        ("faults = false", 'set = ["a=1\\nExecStart=evil"]'),
    ],
)
def test_lab_file_errors_name_the_conflict(tmp_path: Path, old: str, new: str) -> None:
    assert old in EXAMPLE_TEXT
    path = tmp_path / "lab.toml"
    path.write_text(EXAMPLE_TEXT.replace(old, new, 1))
    with raises_error(
        ConfigError,
        code=(
            "config/invalid-value",
            "config/out-of-range",
            "config/unknown-key",
            "lab/invalid-file",
        ),
        field="lab.toml",
    ):
        load_lab(path)


def test_lab_roles_include_a_writer_of_every_key() -> None:
    """A new key needs a writer in the access rules of `snakesim_hal/wire/roles.py`."""
    assert not [
        rule.key
        for rule in ACCESS_RULES
        if not rule.writers or (rule.kind == "query" and not rule.answerers)
    ]
    assert set(ROLE_DESCRIPTIONS) == set(Role)


def test_lab_roles_only_gnc_commands_and_only_robot_publishes() -> None:
    """These are the purposes of the access rules; the table of the rules contains the rest."""
    for role in Role:
        permissions = list(iterate_permissions(role, ["control"], allow_fault_injection=True))
        writable_keys = {
            key for flow, message, key in permissions if (flow, message) == ("ingress", "put")
        }
        assert ("actuator/joints" in writable_keys) == (role is Role.GNC)
        robot_keys = {
            key
            for key in writable_keys
            if key.startswith(("hal/", "sensor/")) and not key.startswith("hal/done/")
        }
        assert bool(robot_keys) == (role is Role.ROBOT)
    fault_permissions = {
        message
        for role in Role
        for _, message, key in iterate_permissions(role)
        if key.startswith("fault/")
    }
    assert not fault_permissions
