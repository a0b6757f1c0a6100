"""Nothing that is refused is refused without a word, or after a long while."""

import pytest

from ep2sindy.data.quantities import conversion, same_unit
from ep2sindy.library.units import Clock, registry, unit_product

NO_UNITS = [
    "-", "#/m^3", "['m' 's']", "[1,2] m", "9**9**9**9", "9^9^9^9 m", "m**9**9**9", "$", "m^", "m^-",
    "(((9^99)^99)^99)^99", "1" + "0" * 5000, "((((((m", "1/0 m", "", "  ", "1e999 m", "nan m",
    "__import__('os')", "m.__class__", "m - s", "m " * 29 + "!", "(m " * 15 + "!", "a.u.",
]  # fmt: skip


@pytest.mark.parametrize("text", NO_UNITS)
def test_text_that_is_no_unit_is_refused_at_once_with_the_way_out(
    text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is reckoned out would never come back."""
    registry()
    built: list[object] = []
    monkeypatch.setattr("pint.UnitRegistry", built.append)
    with pytest.raises(ValueError, match=r"the unit of x must be .*; write "):
        conversion("x", text)
    with pytest.raises(ValueError, match="a unit of time must be such as"):
        Clock.of(text)
    assert unit_product([(text, 1), ("m", 2)])
    assert same_unit("m", text) in (True, False)
    assert not built  # the registry, which takes long, is built once


@pytest.mark.parametrize(
    ("text", "factor", "unit"),
    [
        ("1e19 m^-3", 1e19, "m^-3"), ("10^19 m^-3", 1e19, "m^-3"), ("cm-3", 1e6, "m^-3"),
        ("1/cm^3", 1e6, "m^-3"), ("m s-1", 1.0, "m s^-1"), ("(m/s)^2", 1.0, "m^2 s^-2"),
        ("cm^{-3}", 1e6, "m^-3"), ("%", 0.01, "1"), ("µs", 1e-6, "s"),
        ("m^3.s^-1", 1.0, "m^3 s^-1"), ("kg*m**2/s**2", 1.0, "J"), ("°C", 1.0, "K"),
        ("1 / m3", 1.0, "m^-3"),
    ],
)  # fmt: skip
def test_units_are_read_as_people_write_them(text: str, factor: float, unit: str) -> None:
    assert conversion("x", text)[::2] == (pytest.approx(factor, rel=1e-12), unit)
