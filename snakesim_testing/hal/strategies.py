"""Hypothesis strategies and plain examples of any wire message, made from the message's own types and bounds."""

from collections.abc import Iterator
from typing import Any

import msgspec
from hypothesis import strategies as st
from msgspec import inspect

MAX_EXTRA_ENTRIES = 3  # entries of a list or section, where the type allows more
NAMES = st.characters(exclude_categories=("Cs",))


def make_strategy(struct: type[msgspec.Struct]) -> st.SearchStrategy[Any]:
    """Return a strategy for all values of a Struct that its own decoder accepts."""
    return _make_strategy(inspect.type_info(struct))


def _make_strategy(type_info: inspect.Type) -> st.SearchStrategy[Any]:  # noqa: C901 - one case a type
    """Return a Hypothesis strategy that generates valid values of a type, up to its bounds.

    Args:
        type_info: Type of a message's field with its bounds, as msgspec inspects it.

    Raises:
        NotImplementedError: There is no strategy for this type yet.
    """
    match type_info:
        case inspect.Metadata():
            return _make_strategy(type_info.type)
        case inspect.FloatType():
            min_value = type_info.ge if type_info.ge is not None else type_info.gt
            max_value = type_info.le if type_info.le is not None else type_info.lt
            return st.floats(
                min_value,
                max_value,
                exclude_min=type_info.gt is not None,
                exclude_max=type_info.lt is not None,
                allow_nan=False,
            )
        case inspect.IntType():
            return st.integers(find_min_integer(type_info), find_max_integer(type_info))
        case inspect.StrType():
            return st.text(
                NAMES,
                min_size=type_info.min_length or 0,
                max_size=min(type_info.max_length or 20, 20),
            )
        case inspect.BytesType():
            return st.binary(max_size=20)
        case inspect.BoolType():
            return st.booleans()
        case inspect.NoneType():
            return st.none()
        case inspect.LiteralType():
            return st.sampled_from(type_info.values)
        case inspect.EnumType():
            return st.sampled_from(list(type_info.cls))
        case inspect.ListType():
            min_length = type_info.min_length or 0
            return st.lists(
                _make_strategy(type_info.item_type),
                min_size=min_length,
                max_size=min_length + MAX_EXTRA_ENTRIES,
            )
        case inspect.TupleType():
            return st.tuples(*(_make_strategy(item) for item in type_info.item_types))
        case inspect.DictType():
            return st.dictionaries(
                _make_strategy(type_info.key_type),
                _make_strategy(type_info.value_type),
                max_size=MAX_EXTRA_ENTRIES,
            )
        case inspect.UnionType():
            return st.one_of([_make_strategy(option) for option in type_info.types])
        case inspect.StructType():
            return st.builds(
                type_info.cls, **{f.name: _make_strategy(f.type) for f in type_info.fields}
            )
        case _:
            raise NotImplementedError(
                f"no strategy for {type_info}; write one, so that the message stays tested"
            )


def find_min_integer(info: inspect.IntType) -> int | None:
    """Return the minimum integer of a type; None if it has no lower bound."""
    if info.ge is not None:
        return info.ge
    if info.gt is not None:
        return info.gt + 1
    return None


def find_max_integer(info: inspect.IntType) -> int | None:
    """Return the maximum integer of a type; None if it has no upper bound."""
    if info.le is not None:
        return info.le
    if info.lt is not None:
        return info.lt - 1
    return None


def make_plain_example(struct: type[msgspec.Struct]) -> dict[str, Any]:
    """Return one valid value of a Struct as plain dicts and lists, with an entry in every list and section."""
    return _make_example(inspect.type_info(struct))


def _make_example(type_info: inspect.Type) -> Any:  # noqa: C901 - one case a type
    """Return one valid value of a type as plain data, as simple as the type allows.

    Args:
        type_info: Type of a message's field with its bounds, as msgspec inspects it.

    Raises:
        NotImplementedError: There is no example for this type yet.
    """
    match type_info:
        case inspect.Metadata():
            return _make_example(type_info.type)
        case inspect.FloatType():
            return 0.5
        case inspect.IntType():
            return find_min_integer(type_info) or 0
        case inspect.StrType():
            return "a"
        case inspect.BytesType():
            return b"a"
        case inspect.BoolType():
            return True
        case inspect.NoneType():
            return None
        case inspect.LiteralType():
            return type_info.values[0]
        case inspect.EnumType():
            return next(iter(type_info.cls)).value
        case inspect.ListType():
            return [
                _make_example(type_info.item_type) for _ in range(max(type_info.min_length or 0, 1))
            ]
        case inspect.TupleType():
            return [_make_example(item) for item in type_info.item_types]
        case inspect.DictType():
            return {_make_example(type_info.key_type): _make_example(type_info.value_type)}
        case inspect.UnionType():
            return _make_example(
                next(
                    option for option in type_info.types if not isinstance(option, inspect.NoneType)
                )
            )
        case inspect.StructType():
            return {f.encode_name: _make_example(f.type) for f in type_info.fields}
        case _:
            raise NotImplementedError(f"no example for {type_info}")


Place = tuple[str | int, ...]


def iter_places(
    value: Any, type_info: inspect.Type, place: Place = ()
) -> Iterator[tuple[Place, inspect.Type]]:
    """Yield every place inside an example, with the declared type of the value there.

    Args:
        value: The example, or a part of it, as plain dicts and lists.
        type_info: Declared type of the value.
        place: Place of the value in the whole example: names of fields and indices of entries.
    """
    if isinstance(type_info, inspect.Metadata):
        type_info = type_info.type
    if isinstance(type_info, inspect.UnionType):
        type_info = next(
            option for option in type_info.types if not isinstance(option, inspect.NoneType)
        )
        yield from iter_places(value, type_info, place)
        return
    yield place, type_info
    match type_info:
        case inspect.StructType():
            for field in type_info.fields:
                yield from iter_places(
                    value[field.encode_name], field.type, (*place, field.encode_name)
                )
        case inspect.ListType():
            yield from iter_places(value[0], type_info.item_type, (*place, 0))
        case inspect.TupleType():
            for i, item in enumerate(type_info.item_types):
                yield from iter_places(value[i], item, (*place, i))
        case inspect.DictType():
            for key, inner in value.items():
                yield from iter_places(inner, type_info.value_type, (*place, key))
        case _:
            pass


def replace_at(value: Any, at: Place, by: Any) -> Any:
    """Return a copy of plain data with another value in one place."""
    if not at:
        return by
    step: Any = at[0]
    copy: Any = list(value) if isinstance(value, list) else dict(value)
    copy[step] = replace_at(value[step], at[1:], by)
    return copy


def list_invalid_values(type_info: inspect.Type) -> list[Any]:  # noqa: C901 - one case a type
    """Return values that a field of this type must reject: values out of its bounds, and values of other types."""
    match type_info:
        case inspect.FloatType():
            return _invalid_floats(type_info)
        case inspect.IntType():
            return _invalid_integers(type_info)
        case inspect.StrType():
            invalid_values: list[Any] = [1, b"a"]
            if type_info.max_length is not None:
                invalid_values.append("a" * (type_info.max_length + 1))
            if type_info.min_length:
                invalid_values.append("")
            return invalid_values
        case inspect.BytesType():
            invalid_values = [1, [1]]
            if type_info.max_length is not None:
                invalid_values.append(bytes(type_info.max_length + 1))
            return invalid_values
        case inspect.BoolType():
            return [0, 1, "true"]
        case inspect.LiteralType():
            return ["no such word", 0]
        case inspect.EnumType():
            return [-1, 1000, "POSITION"]
        case inspect.ListType():
            invalid_values = [{}, 1]
            if type_info.min_length:
                invalid_values.append([])
            return invalid_values
        case inspect.TupleType():
            return [[], [0.0] * (len(type_info.item_types) + 1)]
        case inspect.DictType() | inspect.StructType():
            return [[], 1]
        case _:
            return []


def _invalid_floats(info: inspect.FloatType) -> list[Any]:
    """Return numbers that are not finite or out of bounds, and values of other types."""
    invalid: list[Any] = [float("nan"), float("inf"), float("-inf"), "1.0", [1.0]]
    if info.ge is not None:
        # The second term: large bounds absorb the first.
        invalid.append(info.ge - 1e-3 - abs(info.ge) * 1e-9)
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
    minimum = find_min_integer(info)
    if minimum is not None:
        invalid.append(minimum - 1)
    maximum = find_max_integer(info)
    if maximum is not None:
        invalid.append(maximum + 1)
    return invalid
