"""Electronic data sheets (EDS, CiA 306): which objects a drive has, their types, and which can be in a PDO.

A vendor publishes an EDS with each drive. The driver checks with it, before anything is sent, that the drive has every
object that the driver needs. Emulated drives have exactly the objects of an EDS.
"""

from collections.abc import Iterator, Mapping, Sequence
from configparser import Error as ParserError
from configparser import RawConfigParser, SectionProxy
from dataclasses import dataclass
from pathlib import Path

from snakesim_can_backend.cia402.objects import (
    CONSUMER_HEARTBEAT,
    DEVICE_TYPE,
    MAX_TORQUE,
    MODE,
    PDOS,
    PRODUCER_HEARTBEAT,
    SUPPORTED_MODES,
    VENDOR_ID,
    ObjectEntry,
)
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.textfiles import read_text

BUNDLED = Path(__file__).with_name("snakesim-cia402.eds")
NODE_ID = "$NODEID"
# Bytes of the types of whole numbers, by their number.
SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 1, 6: 2, 7: 4}
WRITABLE = ("rw", "rww", "rwr", "wo")
READABLE = ("ro", "rw", "rww", "rwr", "const")
CONTAINER_OBJECT_TYPES = (0x8, 0x9)  # object types: array, record
SUGGESTION = "take the EDS file that the vendor publishes with the drive's firmware"
REQUIRED_ENTRIES = (
    DEVICE_TYPE,
    VENDOR_ID,
    CONSUMER_HEARTBEAT,
    PRODUCER_HEARTBEAT,
    MODE,
    MAX_TORQUE,
    SUPPORTED_MODES,
)


@dataclass(frozen=True)
class EdsObject:
    """One entry of an object dictionary, as its EDS describes it."""

    name: str
    size: int | None  # bytes of a whole number; None: it is of another type
    access: str
    mappable: bool
    default: str  # a number, perhaps with $NODEID; empty: none

    def default_value(self, node_id: int) -> int:
        """Return the default as a number; 0 if there is none, or if it is text."""
        total = 0
        for part in self.default.replace(" ", "").split("+"):
            if part.upper() == NODE_ID:
                total += node_id
                continue
            try:
                total += int(part, 0)
            except ValueError:
                return 0
        return total


@dataclass(frozen=True)
class EdsFile:
    """The object dictionary of a drive type."""

    path: str
    vendor: int
    product: int
    objects: Mapping[tuple[int, int], EdsObject]  # by index and subindex

    def find(self, entry: ObjectEntry) -> EdsObject | None:
        """Return the description of an entry; None if the drive does not have it."""
        return self.objects.get((entry.index, entry.sub))

    def find_missing_objects(self) -> Iterator[str]:
        """Yield what the driver needs and a drive of this type does not have."""
        for entry in REQUIRED_ENTRIES:
            if self.find(entry) is None:
                yield f"has no {entry.name} ({entry.address})"
        for pdo in PDOS:
            for required_entry in (pdo.cob_id_entry(), pdo.mapping_entry(0)):
                if self.find(required_entry) is None:
                    yield f"has no {required_entry.name} ({required_entry.address})"
            for entry in pdo.entries:
                yield from self._find_mapping_problems(entry)

    def _find_mapping_problems(self, entry: ObjectEntry) -> Iterator[str]:
        found = self.find(entry)
        if found is None:
            yield f"has no {entry.name} ({entry.address})"
        elif found.size != entry.size:
            yield f"has a {entry.name} ({entry.address}) of {found.size} bytes instead of {entry.size}"
        elif not found.mappable:
            yield f"does not allow {entry.name} ({entry.address}) in a PDO"


def read_all_eds(paths: Sequence[str]) -> list[EdsFile]:
    """Read the EDS files that the scenario names, and check that they have all objects that the driver needs.

    Raises:
        ConfigError: A file cannot be read, or an object is missing in it.
    """
    files = [read_eds(path) for path in paths]
    for file in files:
        problems = list(dict.fromkeys(file.find_missing_objects()))
        if problems:
            raise ConfigError(
                f"`backends.cia402.eds`: {file.path}: a drive of this type {'; '.join(problems)}: this driver cannot "
                f"drive it",
                code="drive/unsupported-setting",
            )
    return files


def read_eds(path: str | Path) -> EdsFile:
    """Read one EDS file, without checking which objects the drive has.

    Args:
        path: Path of the file.

    Raises:
        ConfigError: The file cannot be read, is malformed, or describes no object.
    """
    context = "`backends.cia402.eds`"
    try:
        text = read_text(Path(path))
    except ConfigError as error:
        raise ConfigError(f"{context}: {error}; {SUGGESTION}", code="file/not-readable") from None
    parser = RawConfigParser(
        strict=False, comment_prefixes=(";", "#"), inline_comment_prefixes=None
    )
    try:
        parser.read_string(text)
    except ParserError as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(
            f"{context}: {path}: {reason}; {SUGGESTION}", code="file/not-readable"
        ) from None
    objects: dict[tuple[int, int], EdsObject] = {}
    for section in parser.sections():
        address = _parse_address(section)
        if address is not None:
            objects |= _read_object_entries(str(path), parser[section], *address)
    if not objects:
        raise ConfigError(
            f"{context}: {path}: describes no object; {SUGGESTION}", code="file/not-readable"
        )
    vendor = 0
    product = 0
    if parser.has_section("DeviceInfo"):
        device = parser["DeviceInfo"]
        vendor = _read_number(str(path), device, "VendorNumber", 0)
        product = _read_number(str(path), device, "ProductNumber", 0)
    return EdsFile(str(path), vendor, product, objects)


def find_eds(files: Sequence[EdsFile], vendor: int, product: int) -> EdsFile | None:
    """Return the file of a drive, by the vendor and the product of its identity object."""
    for file in files:
        if (file.vendor, file.product) == (vendor, product):
            return file
    return None


def _parse_address(section: str) -> tuple[int, int] | None:
    """Return index and subindex of a section such as 607D or 607Dsub1; None if the section describes no entry."""
    index_text, _, sub_text = section.lower().partition("sub")
    try:
        if len(index_text) != 4:
            return None
        return int(index_text, 16), int(sub_text or "0", 16)
    except ValueError:
        return None


def _read_object_entries(
    path: str, section: SectionProxy, index: int, sub: int
) -> dict[tuple[int, int], EdsObject]:
    """Return the object dictionary entries that a section of an EDS file describes.

    Args:
        path: Path of the file, used in error messages.
        section: Section of one object or subindex.
        index: Index of the object.
        sub: Subindex of the entry.

    Returns:
        The entries by index and subindex: one, or all of a compact array. Empty for an array or a record, whose
        entries have sections of their own.
    """
    object_type = _read_number(path, section, "ObjectType", 0x7)
    compact_count = _read_number(path, section, "CompactSubObj", 0)
    if object_type in CONTAINER_OBJECT_TYPES and not compact_count:
        return {}
    number = _read_number(path, section, "DataType", 0)
    entry = EdsObject(
        name=section.get("ParameterName", ""),
        size=SIZES.get(number),
        access=section.get("AccessType", "").lower(),
        mappable=bool(_read_number(path, section, "PDOMapping", 0)),
        default=section.get("DefaultValue", ""),
    )
    if not compact_count:
        return {(index, sub): entry}
    entries = {(index, number): entry for number in range(1, compact_count + 1)}
    entries[index, 0] = EdsObject(
        "number of entries", 1, "ro", mappable=False, default=str(compact_count)
    )
    return entries


def _read_number(path: str, section: SectionProxy, key: str, default: int) -> int:
    text = section.get(key, "").strip()
    if not text:
        return default
    try:
        return int(text, 0)
    except ValueError:
        raise ConfigError(
            f"`backends.cia402.eds`: {path}: [{section.name}] {key} = {text!r} is no whole number; {SUGGESTION}",
            code="file/not-readable",
        ) from None
