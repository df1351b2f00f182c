"""The lab file: what is wrong in it is named, with the way out."""

from pathlib import Path

import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.wire.roles import ACCESS_RULES, ROLE_DESCRIPTIONS, Role, iterate_permissions
from snakesim_operator.features.lab.identities import iterate_identities
from snakesim_operator.features.lab.lab_file import EXAMPLE_PATH, load_lab
from snakesim_testing.messages import raises_error

TEXT = EXAMPLE_PATH.read_text()


def test_lab_example_assigns_every_role() -> None:
    held = list(iterate_identities(load_lab(EXAMPLE_PATH)))
    assert {identity.role for identity in held} == {*Role, None}
    assert len({identity.common_name for identity in held}) == len(held)


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
    assert old in TEXT
    path = tmp_path / "lab.toml"
    path.write_text(TEXT.replace(old, new, 1))
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


def test_every_key_has_a_role_that_writes_it() -> None:
    """A key that is new in the key space names a writer that `snakesim_hal/wire/roles.py` knows."""
    assert not [
        line.key
        for line in ACCESS_RULES
        if not line.writers or (line.kind == "query" and not line.answerers)
    ]
    assert set(ROLE_DESCRIPTIONS) == set(Role)


def test_lab_rights_only_gnc_commands_and_only_robot_publishes() -> None:
    """What the rules are for; the rest is in the table."""
    for role in Role:
        granted = list(iterate_permissions(role, ["control"], allow_fault_injection=True))
        puts = {key for flow, message, key in granted if (flow, message) == ("ingress", "put")}
        assert ("actuator/joints" in puts) == (role is Role.GNC)
        own = {
            key
            for key in puts
            if key.startswith(("hal/", "sensor/")) and not key.startswith("hal/done/")
        }
        assert bool(own) == (role is Role.ROBOT)
    faults = {
        message
        for role in Role
        for _, message, key in iterate_permissions(role)
        if key.startswith("fault/")
    }
    assert not faults
