"""Parses XML into a tree that records which parts were read, so that all others can be reported.

Document types are refused, and with them entities and anything fetched from elsewhere. Size, depth and number of
elements are bounded.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from xml.parsers import expat

from snakesim_hal.base.errors import ConfigError, shorten

MAX_ELEMENTS = 100_000
MAX_DEPTH = 32


@dataclass(frozen=True)
class AbsentPart:
    """Something that an element leaves out, and the value that was taken in its place."""

    sentence: str
    element: "XmlElement"


@dataclass(frozen=True)
class UnusedPart:
    """A value of the file that no part of the program has read."""

    outermost: str  # path of tags of the outermost element that is unused as a whole; empty: the element was read
    outermost_line: int
    path: str  # path of tags, with the attribute's name: `<link><visual name>`
    value: str | None  # None: an element without attributes, text and children
    line: int


@dataclass
class XmlElement:
    """An element with its line in the file."""

    tag: str
    attributes: dict[str, str]
    line: int
    source: str
    absences: list[AbsentPart]  # of the whole file, in the order in which they were noticed
    children: list["XmlElement"] = field(default_factory=list["XmlElement"])
    text: str = ""
    read: bool = False
    read_text: bool = False
    read_attributes: set[str] = field(default_factory=set[str])

    @property
    def place(self) -> str:
        """The place of the element for a report: its name, if it has one, and its line."""
        name = self.attributes.get("name")
        return f"{shorten(name)} (line {self.line})" if name else f"line {self.line}"

    def find_children(self, tag: str) -> list["XmlElement"]:
        """Return the children of a tag, and mark them as read."""
        children = [child for child in self.children if child.tag == tag]
        for child in children:
            child.read = True
        return children

    def find_child(self, tag: str) -> "XmlElement | None":
        """Return the first child of a tag and mark it as read, or None. Other children of the tag are reported."""
        child = next((child for child in self.children if child.tag == tag), None)
        if child is not None:
            child.read = True
        return child

    def read_optional_attribute(self, name: str) -> str | None:
        """Return an attribute, or None. The caller reports what a missing one means."""
        self.read_attributes.add(name)
        return self.attributes.get(name)

    def read_attribute(self, name: str, default: str | None = None) -> str:
        """Return an attribute.

        Args:
            name: Name of the attribute.
            default: Value of a missing attribute, which is reported as assumed.

        Raises:
            ConfigError: The attribute is missing and has no default.
        """
        value = self.read_optional_attribute(name)
        if value is not None:
            return value
        if default is None:
            raise self.make_error(f"has no attribute `{name}`; add it")
        self.note_absent(f"`{name}`", default)
        return default

    def read_numbers(self, name: str, count: int, default: str | None = None) -> list[float]:
        """Return the `count` finite numbers of an attribute; `default` as for `read_attribute`. Raises ConfigError."""
        return self._parse_numbers(self.read_attribute(name, default), count, f"`{name}`")

    def read_number(self, name: str, default: str | None = None) -> float:
        """Return the number of an attribute; `default` as for `read_attribute`. Raises ConfigError."""
        return self.read_numbers(name, 1, default)[0]

    def read_child_number(self, tag: str, default: float) -> float:
        """Return the number in the text of a child, as Gazebo writes them, or the default. Raises ConfigError."""
        child = self.find_child(tag)
        if child is None:
            self.note_absent(f"<{tag}>", f"{default:g}")
            return default
        return child.read_text_numbers(1)[0]

    def read_text_numbers(self, count: int) -> list[float]:
        """Return the `count` finite numbers in the text of the element. Raises ConfigError."""
        self.read_text = True
        return self._parse_numbers(self.text, count, "the text")

    def note_absent(self, what: str, value: str) -> None:
        """Record that the element leaves something out, and which value is assumed."""
        self.absences.append(AbsentPart(f"<{self.tag}> without {what}: {value}", self))

    def _parse_numbers(self, text: str, count: int, what: str) -> list[float]:
        try:
            numbers = [float(word) for word in text.split()]
        except ValueError:
            numbers = []
        if len(numbers) != count or not all(math.isfinite(number) for number in numbers):
            raise self.make_error(
                f"{what} = {shorten(text)!r}; expected {count} finite number{'s' * (count > 1)}"
            )
        return numbers

    def make_error(self, reason: str) -> ConfigError:
        """Make an error about this element. `reason` is the rest of a sentence that begins with the element's tag."""
        name = ""
        if "name" in self.attributes:
            name = f" name={shorten(self.attributes['name'])!r}"
        return ConfigError(
            f"{self.source}, line {self.line}: <{self.tag}{name}> {reason}", code="urdf/invalid"
        )

    def mark_all_as_read(self) -> None:
        """Mark the element and everything in it as read."""
        self.read = True
        self.read_text = True
        self.read_attributes.update(self.attributes)
        for child in self.children:
            child.mark_all_as_read()

    def is_equal_to(self, other: "XmlElement") -> bool:
        """Return whether tag, attributes, text and children of both are equal, whatever their lines."""
        if self.tag != other.tag or self.attributes != other.attributes:
            return False
        if self.text.strip() != other.text.strip() or len(self.children) != len(other.children):
            return False
        return all(
            mine.is_equal_to(theirs)
            for mine, theirs in zip(self.children, other.children, strict=True)
        )

    def iterate_unused(self, path: str = "") -> Iterator[UnusedPart]:
        """Yield every value in the element and below it that was not read.

        path: the tags of the elements above this one and of itself, such as `<link><visual>`.
        """
        yield from self._iterate_unused_here(path, "", 0, everything=False)
        for child in self.children:
            inner = f"{path}<{child.tag}>"
            if child.read:
                yield from child.iterate_unused(inner)
            else:
                yield from child._iterate_all_values(inner, inner, child.line)

    def _iterate_unused_here(
        self, path: str, outermost: str, outermost_line: int, *, everything: bool
    ) -> Iterator[UnusedPart]:
        own_tag = path or f"<{self.tag}>"
        for name, value in self.attributes.items():
            if everything or name not in self.read_attributes:
                yield UnusedPart(
                    outermost, outermost_line, f"{own_tag[:-1]} {name}>", value, self.line
                )
        text = self.text.strip()
        if text and (everything or not self.read_text):
            yield UnusedPart(outermost, outermost_line, own_tag, text, self.line)

    def _iterate_all_values(
        self, path: str, outermost: str, outermost_line: int
    ) -> Iterator[UnusedPart]:
        """Yield all values of an element that was not read."""
        if not (self.attributes or self.text.strip() or self.children):
            yield UnusedPart(outermost, outermost_line, path, None, self.line)
        yield from self._iterate_unused_here(path, outermost, outermost_line, everything=True)
        for child in self.children:
            yield from child._iterate_all_values(f"{path}<{child.tag}>", outermost, outermost_line)


def parse_xml(data: bytes, source: str) -> XmlElement:
    """Parse a file.

    Args:
        data: Content of the file.
        source: Name of the file, for error messages.

    Returns:
        The root element.

    Raises:
        ConfigError: The file is not XML, has a document type, or is too large.
    """
    parser = expat.ParserCreate()
    absences: list[AbsentPart] = []
    top = XmlElement("", {}, 0, source, absences)
    open_elements = [top]
    count = 0

    def open_element(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        line = parser.CurrentLineNumber
        if count > MAX_ELEMENTS or len(open_elements) > MAX_DEPTH:
            raise ConfigError(
                f"{source}, line {line}: more than {MAX_ELEMENTS} elements, or nested deeper than {MAX_DEPTH} levels",
                code="urdf/invalid",
            )
        if tag.startswith("xacro:"):
            raise ConfigError(
                f"{source}, line {line}: <{shorten(tag)}> is xacro; convert it first: xacro FILE > robot.urdf",
                code="urdf/invalid",
            )
        element = XmlElement(tag, attributes, line, source, absences)
        open_elements[-1].children.append(element)
        open_elements.append(element)

    def close_element(_tag: str) -> None:
        open_elements.pop()

    def add_text(text: str) -> None:
        open_elements[-1].text += text

    def refuse_doctype(*_: object) -> None:
        raise ConfigError(
            f"{source}, line {parser.CurrentLineNumber}: has a <!DOCTYPE>; URDF needs none: remove it",
            code="urdf/invalid",
        )

    parser.buffer_text = True
    parser.StartElementHandler = open_element
    parser.EndElementHandler = close_element
    parser.CharacterDataHandler = add_text
    parser.StartDoctypeDeclHandler = refuse_doctype
    try:
        parser.Parse(data, True)
    except (expat.ExpatError, ValueError, LookupError) as error:  # LookupError: an unknown encoding
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(
            f"{source}: is no URDF: not valid XML: {error}; give a file that ends with .urdf",
            code="urdf/invalid",
        ) from None
    return top.children[0]
