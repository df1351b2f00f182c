"""The lab file: what is wrong in it is named, with the way out."""

from pathlib import Path

import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.wire.roles import ROLE_DESCRIPTIONS, TABLE, Role, list_permissions
from snakesim_operator.features.lab.identities import identities
from snakesim_operator.features.lab.lab_file import EXAMPLE, load_lab

TEXT = EXAMPLE.read_text()


def test_the_example_is_a_lab_in_which_every_role_is_held() -> None:
    held = list(identities(load_lab(EXAMPLE)))
    assert {identity.role for identity in held} == {*Role, None}
    assert len({identity.common_name for identity in held}) == len(held)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('machine = "robot1"\nscenario', 'machine = "robot7"\nscenario', "`robots.planar13.machine` = 'robot7'"),
        ('address = "10.0.0.1"\n', "", "`machines.hub.address` is missing; the router `main` listens there"),
        ('role = "gnc"', 'role = "pilot"', "`roles.0.role` = 'pilot'"),
        ('role = "gnc"\nrobot = "planar13"', 'role = "gnc"\nrobot = "all"', "a gnc commands one robot"),
        ('role = "recorder"', 'role = "gnc"', "a second time"),
        ('role = "recorder"\nrobot = "planar13"', 'role = "recorder"\nrobot = "snake"', "it has planar13, all"),
        ("certificate_days = 30", "certificate_days = 3000", "3000 days"),
        ("[machines.laptop]", "[machines.Laptop]", "machines"),
        ("[routers.main]", "[router.main]", "did you mean `routers`?"),
        ("faults = false", 'set = ["a=1\\nExecStart=evil"]', "`robots.planar13.set.0`"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in TEXT
    path = tmp_path / "lab.toml"
    path.write_text(TEXT.replace(old, new, 1))
    with pytest.raises(ConfigError) as error:
        load_lab(path)
    assert said in str(error.value) and "lab.toml" in str(error.value)


def test_every_key_has_a_role_that_writes_it() -> None:
    """A key that is new in the key space names a writer that `snakesim_hal/wire/roles.py` knows."""
    assert not [line.key for line in TABLE if not line.writers or (line.kind == "query" and not line.answerers)]
    assert set(ROLE_DESCRIPTIONS) == set(Role)


def test_only_the_robot_speaks_for_itself_and_only_its_gnc_commands_it() -> None:
    """What the rules are for; the rest is in the table."""
    for role in Role:
        granted = list(list_permissions(role, ["control"], faults=True))
        puts = {key for flow, message, key in granted if (flow, message) == ("ingress", "put")}
        assert ("actuator/joints" in puts) == (role is Role.GNC)
        own = {key for key in puts if key.startswith(("hal/", "sensor/")) and not key.startswith("hal/done/")}
        assert bool(own) == (role is Role.ROBOT)
    faults = {message for role in Role for _, message, key in list_permissions(role) if key.startswith("fault/")}
    assert not faults
