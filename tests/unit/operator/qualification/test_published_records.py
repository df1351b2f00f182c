"""Records in the documentation: each is signed by a listed key, and none is of an emulated drive."""

from pathlib import Path

from snakesim_operator.features.qualification.command import find_claim_problem
from snakesim_operator.features.qualification.protocol.record import Record, read_record
from snakesim_operator.features.qualification.protocol.signature import find_signature_problem

DOCS = Path(__file__).parents[4] / "docs" / "hardware"
RECORDS = DOCS / "records"
STATUS_BY_PAGE = {
    "odrive": "odrive.md",
    "moteus": "moteus.md",
    "cia402": "cia402.md",
    "dynamixel": "dynamixel.md",
    "feetech": "feetech.md",
    "can": "joint-modules.md",
}


def list_records() -> dict[str, Record]:
    return {path.name: read_record(path) for path in RECORDS.glob("*.json")}


def test_published_records_are_signed_by_a_listed_key_and_are_of_real_drives():
    page = (RECORDS / "README.md").read_text(encoding="utf-8")
    for name, record in list_records().items():
        assert not record.subject.emulated, name
        assert not find_signature_problem(record), name
        assert not find_claim_problem(record), name
        assert record.signature is not None
        assert record.signature.public_key in page, name
        assert name in page


def test_pages_say_emulated_only_until_there_is_a_record_and_link_the_first_hour():
    recorded = {record.subject.driver_type for record in list_records().values()}
    for driver_type, name in STATUS_BY_PAGE.items():
        page = (DOCS / name).read_text(encoding="utf-8")
        assert "first-hour.md" in page, name
        if driver_type not in recorded:
            assert "emulated only" in page.lower(), name
    for name in ("README.md", "mixed.md"):
        assert "first-hour.md" in (DOCS / name).read_text(encoding="utf-8")
