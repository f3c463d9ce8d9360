"""A type checker for jaxtyping that looks at tensors alone, for tests with all shapes and dtypes checked:

pytest --jaxtyping-packages=symphony,helpers_shapes.tensors_only tests/...
"""

from __future__ import annotations

import functools
import inspect
import types
from collections.abc import Callable, Mapping
from typing import Any, Union, get_args, get_origin

from jaxtyping import AbstractArray


def tensors_only(function: Callable[..., Any]) -> Callable[..., Any]:
    """Check the tensors that go into a function and come out of it."""
    signature = inspect.signature(function)

    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        for name, value in signature.bind(*args, **kwargs).arguments.items():
            parameter = signature.parameters[name]
            several = parameter.kind is parameter.VAR_POSITIONAL
            for item in value if several else [value]:
                if not fits(item, parameter.annotation):
                    raise TypeError(f"{name} is not {parameter.annotation}")
        out = function(*args, **kwargs)
        if not fits(out, signature.return_annotation):
            raise TypeError(f"the result is not {signature.return_annotation}")
        return out

    return checked


def fits(value: Any, hint: Any) -> bool:
    """Whether the tensors of a value are what an annotation says."""
    if inspect.isclass(hint) and issubclass(hint, AbstractArray):
        return isinstance(value, hint)
    origin, parts = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return any(fits(value, part) and _is(value, part) for part in parts)
    if origin is tuple and isinstance(value, tuple):
        parts = parts[:1] * len(value) if len(parts) == 2 and parts[1] is ... else parts
        return len(value) == len(parts) and all(map(fits, value, parts))
    if not (inspect.isclass(origin) and isinstance(value, origin)):
        return True
    items = value.values() if issubclass(origin, Mapping) else value if issubclass(origin, list) else ()
    return all(fits(item, parts[-1]) for item in items)


def _is(value: Any, hint: Any) -> bool:
    checkable = inspect.isclass(hint) and not getattr(hint, "_is_protocol", False)
    return not checkable or isinstance(value, hint)
