"""Values of a study file, checked before anything is recorded or trained."""

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, get_args, get_origin

_EXPECTED = {int: "whole numbers", float: "numbers", str: "texts"}


def check_values(section: Any, where: str, least: Mapping[str, float]) -> None:
    """Raise ValueError for a field of a dataclass that has not its annotated type, is below its least value, or repeats itself.

    where: names the section in the message. least: by name; other fields have no least value.
    """
    for field in fields(section):
        value = getattr(section, field.name)
        is_list = get_origin(field.type) is tuple
        kind = get_args(field.type)[0] if is_list else field.type
        if kind not in _EXPECTED:
            continue
        smallest = least.get(field.name)
        values = value if isinstance(value, tuple) and is_list else (value,)
        right = isinstance(value, tuple) == is_list and all(_is(item, kind) for item in values)
        if not right or (smallest is not None and any(item < smallest for item in values)):
            expected = f"a list of {_EXPECTED[kind]}" if is_list else f"a {_EXPECTED[kind].removesuffix('s')}"
            bound = "" if smallest is None else f" of at least {smallest}"
            given = list(value) if isinstance(value, tuple) else value
            raise ValueError(f"{where} {field.name} must be {expected}{bound}, got {given!r}.")
        repeated = sorted({str(item) for item in values if values.count(item) > 1})
        if repeated:
            raise ValueError(f"{where} {field.name} names {', '.join(repeated)} more than once; name each once.")


def _is(value: Any, kind: type) -> bool:
    if isinstance(value, bool):
        return False  # Python counts it among the whole numbers
    if kind is float:
        return isinstance(value, int | float) and math.isfinite(value)
    return isinstance(value, kind)
