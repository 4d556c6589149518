"""What ``tests/shape_checks.py`` leaves out was checked before: whatever differs is checked in full, at whichever call it comes."""

from collections.abc import Callable
from typing import Literal

import jaxtyping
import numpy as np
import pytest
from beartype import beartype
from jaxtyping import Float, TypeCheckError

TWO, THREE = np.zeros((4, 2)), np.zeros((4, 3))


@jaxtyping.jaxtyped(typechecker=beartype)
def joined(
    a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, " n"], out: Callable[[], object] | None = None
) -> Float[np.ndarray, "n 4"]:
    return np.column_stack([a, b]) if out is None else out()


@jaxtyping.jaxtyped(typechecker=beartype)
def turned(sense: Literal[1, -1], name: str = "", more: tuple[Float[np.ndarray, "k 3"], ...] = ()) -> list[float]:
    return [float(sense)] if name != "words" else [name]


@pytest.fixture(autouse=True)
def passed_before():
    """Calls that pass, twice; one after which nothing would be looked at any more if calls were only counted."""
    for _ in range(2):
        assert joined(THREE, np.zeros(4)).shape == (4, 4)
        assert joined(THREE, b=np.zeros(4)).shape == (4, 4)
        assert turned(1, more=(THREE, THREE)) == [1.0]


@pytest.mark.parametrize(
    "arguments",
    [
        (TWO, np.zeros(4)),
        (THREE, np.zeros(5)),
        (THREE.astype(int), np.zeros(4)),
        (THREE.astype(complex), np.zeros(4)),
        (THREE.tolist(), np.zeros(4)),
        (THREE, None),
    ],
)
def test_arguments_of_another_kind_are_refused(arguments):
    with pytest.raises(TypeCheckError, match="parameters"):
        joined(*arguments)
    with pytest.raises(TypeCheckError, match="parameters"):
        joined(arguments[0], b=arguments[1])


@pytest.mark.parametrize("result", [np.zeros((4, 3)), np.zeros((5, 4)), np.zeros((4, 4), int), "text", [1.0]])
def test_another_result_for_the_same_arguments_is_refused(result):
    for _ in range(2):
        joined(THREE, np.zeros(4), lambda: np.zeros((4, 4)))
        with pytest.raises(TypeCheckError):
            joined(THREE, np.zeros(4), lambda: result)


def test_a_result_that_depends_on_values_is_refused():
    assert turned(1, "letters") == [1.0]
    with pytest.raises(TypeCheckError, match="return value"):
        turned(1, "words")


def test_a_value_that_is_not_one_of_those_that_may_be_is_refused():
    with pytest.raises(TypeCheckError):
        turned(2)


@pytest.mark.parametrize("more", [(TWO, TWO), (THREE.astype(int),), (THREE[0], THREE[0])])
def test_arrays_in_a_tuple_belong_to_what_is_checked(more):
    with pytest.raises(TypeCheckError):
        turned(1, more=more)


def test_a_tuple_of_this_and_that_is_checked_every_time():
    """beartype looks at one element of it, each time at another."""
    with pytest.raises(TypeCheckError):  # noqa: PT012
        for _ in range(100):
            turned(1, more=(THREE, TWO))


def test_the_code_base_is_checked():
    from rotaline.geometry.primitives import Plane

    for _ in range(2):
        assert Plane(np.array([0.0, 0.0, 1.0]), 2.0).offset == 2.0
    with pytest.raises(TypeCheckError):
        Plane(np.array([0.0, 1.0]), 2.0)
