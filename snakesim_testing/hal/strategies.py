"""Hypothesis strategies and plain examples of any wire message, made from the message's own types and bounds."""

from collections.abc import Iterator
from typing import Any

import msgspec
from hypothesis import strategies as st
from msgspec import inspect

LONGEST = 3  # entries of a list or section, where the type allows more
NAMES = st.characters(exclude_categories=("Cs",))


def messages_of(struct: type[msgspec.Struct]) -> st.SearchStrategy[Any]:
    """Any value of a Struct that its own decoder takes."""
    return _strategy(inspect.type_info(struct))


def _strategy(info: inspect.Type) -> st.SearchStrategy[Any]:  # noqa: C901 - one case a type
    """Return a strategy of Hypothesis that generates every valid value of a message's field.

    Args:
        info: type of the field with its bounds, as msgspec inspects it.
    """
    match info:
        case inspect.Metadata():
            return _strategy(info.type)
        case inspect.FloatType():
            low = info.ge if info.ge is not None else info.gt
            high = info.le if info.le is not None else info.lt
            return st.floats(
                low, high, exclude_min=info.gt is not None, exclude_max=info.lt is not None, allow_nan=False
            )
        case inspect.IntType():
            return st.integers(lowest(info), highest(info))
        case inspect.StrType():
            return st.text(NAMES, min_size=info.min_length or 0, max_size=min(info.max_length or 20, 20))
        case inspect.BytesType():
            return st.binary(max_size=20)
        case inspect.BoolType():
            return st.booleans()
        case inspect.NoneType():
            return st.none()
        case inspect.LiteralType():
            return st.sampled_from(info.values)
        case inspect.EnumType():
            return st.sampled_from(list(info.cls))
        case inspect.ListType():
            least = info.min_length or 0
            return st.lists(_strategy(info.item_type), min_size=least, max_size=least + LONGEST)
        case inspect.TupleType():
            return st.tuples(*(_strategy(item) for item in info.item_types))
        case inspect.DictType():
            return st.dictionaries(_strategy(info.key_type), _strategy(info.value_type), max_size=LONGEST)
        case inspect.UnionType():
            return st.one_of([_strategy(option) for option in info.types])
        case inspect.StructType():
            return st.builds(info.cls, **{f.name: _strategy(f.type) for f in info.fields})
        case _:
            raise NotImplementedError(f"no strategy for {info}; write one, so that the message stays tested")


def lowest(info: inspect.IntType) -> int | None:
    """The least whole number that is allowed."""
    return info.ge if info.ge is not None else None if info.gt is None else info.gt + 1


def highest(info: inspect.IntType) -> int | None:
    """The greatest whole number that is allowed."""
    return info.le if info.le is not None else None if info.lt is None else info.lt - 1


def plain_example(struct: type[msgspec.Struct]) -> dict[str, Any]:
    """One valid value as plain dicts and lists, with an entry in every list and section."""
    return _example(inspect.type_info(struct))


def _example(info: inspect.Type) -> Any:  # noqa: C901 - one case a type
    """Return one valid value of a message's field, as simple as its type allows.

    Args:
        info: type of the field with its bounds, as msgspec inspects it.
    """
    match info:
        case inspect.Metadata():
            return _example(info.type)
        case inspect.FloatType():
            return 0.5
        case inspect.IntType():
            return lowest(info) or 0
        case inspect.StrType():
            return "a"
        case inspect.BytesType():
            return b"a"
        case inspect.BoolType():
            return True
        case inspect.NoneType():
            return None
        case inspect.LiteralType():
            return info.values[0]
        case inspect.EnumType():
            return next(iter(info.cls)).value
        case inspect.ListType():
            return [_example(info.item_type) for _ in range(max(info.min_length or 0, 1))]
        case inspect.TupleType():
            return [_example(item) for item in info.item_types]
        case inspect.DictType():
            return {_example(info.key_type): _example(info.value_type)}
        case inspect.UnionType():
            return _example(next(option for option in info.types if not isinstance(option, inspect.NoneType)))
        case inspect.StructType():
            return {f.encode_name: _example(f.type) for f in info.fields}
        case _:
            raise NotImplementedError(f"no example for {info}")


Place = tuple[str | int, ...]


def places(value: Any, info: inspect.Type, at: Place = ()) -> Iterator[tuple[Place, inspect.Type]]:
    """Every place inside an example, with the type that is declared there."""
    if isinstance(info, inspect.Metadata):
        info = info.type
    if isinstance(info, inspect.UnionType):
        info = next(option for option in info.types if not isinstance(option, inspect.NoneType))
        yield from places(value, info, at)
        return
    yield at, info
    match info:
        case inspect.StructType():
            for field in info.fields:
                yield from places(value[field.encode_name], field.type, (*at, field.encode_name))
        case inspect.ListType():
            yield from places(value[0], info.item_type, (*at, 0))
        case inspect.TupleType():
            for i, item in enumerate(info.item_types):
                yield from places(value[i], item, (*at, i))
        case inspect.DictType():
            for key, inner in value.items():
                yield from places(inner, info.value_type, (*at, key))
        case _:
            pass


def replaced(value: Any, at: Place, by: Any) -> Any:
    """A copy of plain data with another value in one place."""
    if not at:
        return by
    step: Any = at[0]
    copy: Any = list(value) if isinstance(value, list) else dict(value)
    copy[step] = replaced(value[step], at[1:], by)
    return copy


def poisons(info: inspect.Type) -> list[Any]:  # noqa: C901 - one case a type
    """Return values that a field of this type must reject: values out of its bounds, and values of other types."""
    match info:
        case inspect.FloatType():
            return _invalid_floats(info)
        case inspect.IntType():
            return _invalid_integers(info)
        case inspect.StrType():
            invalid: list[Any] = [1, b"a"]
            if info.max_length is not None:
                invalid.append("a" * (info.max_length + 1))
            if info.min_length:
                invalid.append("")
            return invalid
        case inspect.BytesType():
            invalid = [1, [1]]
            if info.max_length is not None:
                invalid.append(bytes(info.max_length + 1))
            return invalid
        case inspect.BoolType():
            return [0, 1, "true"]
        case inspect.LiteralType():
            return ["no such word", 0]
        case inspect.EnumType():
            return [-1, 1000, "POSITION"]
        case inspect.ListType():
            invalid = [{}, 1]
            if info.min_length:
                invalid.append([])
            return invalid
        case inspect.TupleType():
            return [[], [0.0] * (len(info.item_types) + 1)]
        case inspect.DictType() | inspect.StructType():
            return [[], 1]
        case _:
            return []


def _invalid_floats(info: inspect.FloatType) -> list[Any]:
    """Return numbers that are not finite or out of bounds, and values of other types."""
    invalid: list[Any] = [float("nan"), float("inf"), float("-inf"), "1.0", [1.0]]
    if info.ge is not None:
        invalid.append(info.ge - 1e-3 - abs(info.ge) * 1e-9)  # the second term: large bounds absorb the first
    if info.gt is not None:
        invalid.append(info.gt)
    if info.le is not None:
        invalid.append(info.le + 1e-3 + abs(info.le) * 1e-9)
    if info.lt is not None:
        invalid.append(info.lt)
    return invalid


def _invalid_integers(info: inspect.IntType) -> list[Any]:
    """Return integers out of the wire's range or the field's bounds, and values of other types."""
    invalid: list[Any] = [-(2**63), 2**63, 0.5, "1"]
    minimum = lowest(info)
    if minimum is not None:
        invalid.append(minimum - 1)
    maximum = highest(info)
    if maximum is not None:
        invalid.append(maximum + 1)
    return invalid
