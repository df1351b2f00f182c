"""Every qualification record in the documentation is signed with a listed key, and none is of an emulated drive."""

from pathlib import Path

from snakesim_operator.features.qualification.command import find_claim_problem
from snakesim_operator.features.qualification.protocol.record import Record, read_record
from snakesim_operator.features.qualification.protocol.signature import find_signature_problem

DOCS = Path(__file__).parents[4] / "docs" / "hardware"
RECORDS = DOCS / "records"
PAGE_BY_DRIVER_TYPE = {
    "odrive": "odrive.md",
    "moteus": "moteus.md",
    "cia402": "cia402.md",
    "dynamixel": "dynamixel.md",
    "feetech": "feetech.md",
    "can": "joint-modules.md",
}


def read_published_records() -> dict[str, Record]:
    """Return the published records by file name."""
    return {path.name: read_record(path) for path in RECORDS.glob("*.json")}


def test_published_records_have_listed_keys_and_real_drives():
    page = (RECORDS / "README.md").read_text(encoding="utf-8")
    for name, record in read_published_records().items():
        assert not record.subject.emulated, name
        assert not find_signature_problem(record), name
        assert not find_claim_problem(record), name
        assert record.signature is not None
        assert record.signature.public_key in page, name
        assert name in page


def test_drive_pages_without_record_state_emulated_and_link_first_hour():
    recorded_types = {record.subject.driver_type for record in read_published_records().values()}
    for driver_type, name in PAGE_BY_DRIVER_TYPE.items():
        page = (DOCS / name).read_text(encoding="utf-8")
        assert "first-hour.md" in page, name
        if driver_type not in recorded_types:
            assert "emulated only" in page.lower(), name
    for name in ("README.md", "mixed.md"):
        assert "first-hour.md" in (DOCS / name).read_text(encoding="utf-8")
