"""XML as a tree that records which parts were read, so that the rest can be reported.

Document types are refused, and with them entities and anything fetched from elsewhere. Size, depth and number of
elements are bounded.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from xml.parsers import expat

from snakesim_hal.errors import ConfigError, short

MAX_ELEMENTS, MAX_DEPTH = 100_000, 32


@dataclass
class Element:
    """An element with its line in the file."""

    tag: str
    attributes: dict[str, str]
    line: int
    source: str
    children: list["Element"] = field(default_factory=list["Element"])
    text: str = ""
    read: bool = False
    read_attributes: set[str] = field(default_factory=set[str])

    def all(self, tag: str) -> list["Element"]:
        """Its children of a tag, which count as read."""
        found = [child for child in self.children if child.tag == tag]
        for child in found:
            child.read = True
        return found

    def first(self, tag: str) -> "Element | None":
        """Its first child of a tag; the others are left to be reported."""
        child = next((child for child in self.children if child.tag == tag), None)
        if child is not None:
            child.read = True
        return child

    def get(self, name: str, default: str | None = None) -> str:
        """An attribute. Raises ConfigError when it is missing and has no default."""
        self.read_attributes.add(name)
        value = self.attributes.get(name, default)
        if value is None:
            raise self.wrong(f"has no attribute `{name}`; add it")
        return value

    def numbers(self, name: str, count: int, default: str | None = None) -> list[float]:
        """An attribute of `count` finite numbers. Raises ConfigError."""
        return self._numbers(self.get(name, default), count, f"`{name}`")

    def number(self, name: str, default: str | None = None) -> float:
        """An attribute that is a number. Raises ConfigError."""
        return self.numbers(name, 1, default)[0]

    def text_number(self, tag: str, default: float) -> float:
        """The number in a child, as Gazebo writes them; the default when there is none. Raises ConfigError."""
        child = self.first(tag)
        return default if child is None else self._numbers(child.text, 1, f"<{tag}>")[0]

    def text_numbers(self, count: int) -> list[float]:
        """The numbers between its tags. Raises ConfigError."""
        return self._numbers(self.text, count, "the text")

    def _numbers(self, text: str, count: int, what: str) -> list[float]:
        try:
            found = [float(word) for word in text.split()]
        except ValueError:
            found = []
        if len(found) != count or not all(math.isfinite(number) for number in found):
            raise self.wrong(f"{what} = {short(text)!r}; expected {count} finite number{'s' * (count > 1)}")
        return found

    def wrong(self, why: str) -> ConfigError:
        """An error about this element."""
        name = f" name={short(self.attributes['name'])!r}" if "name" in self.attributes else ""
        return ConfigError(f"{self.source}, line {self.line}: <{self.tag}{name}> {why}")

    def read_all(self) -> None:
        """Mark it and all within it as read."""
        self.read = True
        self.read_attributes.update(self.attributes)
        for child in self.children:
            child.read_all()

    def unread(self, path: str = "") -> Iterator[tuple[str, int]]:
        """What nobody has read below it, as (path of tags or attribute, line); of nested elements the outermost."""
        for child in self.children:
            inner = f"{path}<{child.tag}>"
            if not child.read:
                yield inner, child.line
                continue
            for name in child.attributes.keys() - child.read_attributes:
                yield f"{path}<{child.tag} {name}=...>", child.line
            yield from child.unread(inner)


def parse_xml(data: bytes, source: str) -> Element:
    """The root element. Raises ConfigError: for what is not XML, has a document type, or is too large."""
    parser = expat.ParserCreate()
    top = Element("", {}, 0, source)
    open_elements = [top]
    count = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        line = parser.CurrentLineNumber
        if count > MAX_ELEMENTS or len(open_elements) > MAX_DEPTH:
            raise ConfigError(
                f"{source}, line {line}: more than {MAX_ELEMENTS} elements, or nested deeper than {MAX_DEPTH} levels"
            )
        if tag.startswith("xacro:"):
            raise ConfigError(
                f"{source}, line {line}: <{short(tag)}> is xacro; convert it first: xacro FILE > robot.urdf"
            )
        element = Element(tag, attributes, line, source)
        open_elements[-1].children.append(element)
        open_elements.append(element)

    def end(_tag: str) -> None:
        open_elements.pop()

    def characters(text: str) -> None:
        open_elements[-1].text += text

    def refuse(*_: object) -> None:
        raise ConfigError(f"{source}, line {parser.CurrentLineNumber}: has a <!DOCTYPE>; URDF needs none: remove it")

    parser.buffer_text = True
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = characters, refuse
    try:
        parser.Parse(data, True)
    except (expat.ExpatError, ValueError, LookupError) as error:  # LookupError: an encoding that nobody knows
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"{source}: is no URDF: not valid XML: {error}; give a file that ends with .urdf") from None
    return top.children[0]
