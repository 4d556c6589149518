"""Checks of annotations while testing, each once: what was checked for some types and shapes needs no check for the same ones again.

jaxtyping and beartype take 20 to 50 µs a call, which is more than many functions take for their work. Whether a call passes depends only on
the types of its arguments and of its result, and on shapes and dtypes of arrays, also of those in tuples, lists and dicts; with ``Literal``
on words and numbers. So these are remembered for each function, and a call is checked in full if it has others than those before. Where a
list or dict is long, and where something else may hold arrays, every call is checked in full as ever.
"""

import functools
import inspect
import threading
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass, field
from enum import Enum
from types import CodeType
from typing import Any

import jaxtyping._decorator as decorator
import numpy as np
from jaxtyping import config
from scipy.spatial.transform import RigidTransform, Rotation

AT_MOST = 64
"""Elements that are looked at."""
REMEMBERED = 4000
"""Combinations of a function."""

_SAMPLED = (", ...]", "list[", "dict[", "set[", "Sequence[", "Collection[", "Iterable[", "Mapping[")

_in_full = decorator.jaxtyped
_records: dict[int, "_Record"] = {}
_plain: dict[type, bool] = {Rotation: True, RigidTransform: True}


class _NotToldError(Exception):
    """The types do not tell what the check depends on."""


def _is_plain(kind: type) -> bool:
    """Nothing but the class matters: it holds nothing, or it is one of the code base, whose fields were checked when it was made."""
    if issubclass(kind, (str, bytes, Enum)):
        return True
    return not issubclass(kind, (Collection, np.ndarray, type)) and not hasattr(kind, "__getitem__")


def _kind(value: Any, look: "_Look") -> Any:
    """What a check of a value depends on."""
    kind = type(value)
    if kind is np.ndarray:
        return value.dtype, value.shape
    plain = _plain.get(kind)
    if plain is None:
        plain = _plain[kind] = _is_plain(kind)
    if plain:
        return (kind, value) if look.literally and isinstance(value, (str, bytes, int, Enum)) else kind
    if isinstance(value, np.ndarray):
        return kind, value.dtype, value.shape
    if isinstance(value, type):
        return value
    if isinstance(value, (tuple, list, dict)) and len(value) <= AT_MOST:
        kinds = [_kind(v, look) for v in value]
        values = [_kind(v, look) for v in value.values()] if isinstance(value, dict) else []
        if not look.samples or max(len(set(kinds)), len(set(values))) <= 1:
            return kind, *kinds, *values
    raise _NotToldError


def _key(args: tuple[Any, ...], kwargs: dict[str, Any], look: "_Look") -> tuple[Any, ...]:
    key = tuple([_kind(v, look) for v in args])
    return (key, *[(name, _kind(v, look)) for name, v in kwargs.items()]) if kwargs else key


@dataclass(frozen=True)
class _Look:
    """How closely to look.

    ``literally``: words and whole numbers matter themselves; ``samples``: beartype looks at one element of a list, each time at another, so
    that only lists of one kind are known to pass.
    """

    literally: bool
    samples: bool


@dataclass(frozen=True, eq=False)
class _Record:
    """What a function was called with and what it gave; also of one that is defined again with every call of another."""

    code: CodeType
    arguments: _Look
    result: _Look
    always_in_full: bool
    passed: dict[Any, set[Any]] = field(default_factory=dict)


def _record_of(function: Callable[..., Any]) -> _Record:
    code = function.__code__
    record = _records.get(id(code))
    if record is None:
        signature = inspect.signature(function)
        texts = " ".join(str(p.annotation) for p in signature.parameters.values()), str(signature.return_annotation)
        looks = [_Look("Literal" in text, any(word in text for word in _SAMPLED)) for text in texts]
        by_value = any(word in text for word in ("Annotated", "{") for text in texts)
        record = _records[id(code)] = _Record(code, looks[0], looks[1], by_value)
    return record


def _checked_once(function: Callable[..., Any], typechecker: Any) -> Callable[..., Any]:
    """``function`` with checks of what it has not been called with before."""
    result = threading.local()

    def given(*args: Any, **kwargs: Any) -> Any:
        return result.value

    # most functions are not called: nothing is made for them
    record_of = functools.cache(lambda: _record_of(function))
    in_full = functools.cache(lambda: _in_full(function, typechecker=typechecker))
    result_in_full = functools.cache(lambda: _in_full(functools.wraps(function)(given), typechecker=typechecker))

    @functools.wraps(function)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        __tracebackhide__ = True
        if config.jaxtyping_disable:
            return function(*args, **kwargs)
        record = record_of()
        passed = record.passed
        try:
            key = _key(args, kwargs, record.arguments)
        except _NotToldError:
            key = None
        results = passed.get(key)
        if results is None:
            out = in_full()(*args, **kwargs)
            if key is None or record.always_in_full:
                return out
            if len(passed) >= REMEMBERED:
                passed.clear()
            results = passed[key] = set()
        else:
            out = function(*args, **kwargs)
            with suppress(_NotToldError):
                if _kind(out, record.result) in results:
                    return out
            result.value = out
            result_in_full()(*args, **kwargs)
        with suppress(_NotToldError):
            results.add(_kind(out, record.result))
        return out

    return wrapped


def _jaxtyped(fn: Any = decorator._sentinel, *, typechecker: Any = decorator._sentinel) -> Any:
    if inspect.isfunction(fn) and typechecker not in (None, decorator._sentinel):
        return _checked_once(fn, typechecker)
    return _in_full(fn, typechecker=typechecker)


def install() -> None:
    """For all modules that are imported from now on."""
    import jaxtyping

    decorator.jaxtyped = jaxtyping.jaxtyped = _jaxtyped
