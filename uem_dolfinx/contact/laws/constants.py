"""Numbers of laws that may be Constants, whose values may change between steps and are controls of gradients."""

from __future__ import annotations

from typing import Any

from dolfinx import fem

from uem_dolfinx import given


def value(number: float | fem.Constant) -> float:
    """The present value of a number or a Constant."""
    return float(number.value) if isinstance(number, fem.Constant) else number


def checked(what: str, number: Any, within: given.Range) -> float | fem.Constant:
    """A number or a Constant whose present value is in a range; raises as ``given.number`` does."""
    if isinstance(number, fem.Constant):
        given.number(what, number.value, within)
        return number
    return given.number(what, number, within)


def described(law: object) -> str:
    """A law with its arguments, the same in every run: Constants without their values."""
    return f"{type(law).__name__}({', '.join(f'{name}={given.described(one)}' for name, one in vars(law).items())})"
