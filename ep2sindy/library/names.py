"""Grammar and parsing of term names, and checks of variable names."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

# The grammar of terms, as patterns without capturing groups. Possessive quantifiers (`++`, `*+`)
# prevent backtracking, since a term from someone else may be very long.
# A word, or the average of a product in < >; of one zone among several as n_i@exit.
VARIABLE = r"(?:(?:<[^<>]+>|[^\W\d]\w*+)(?:@\w++)?)"

NUMBER = r"(?:\d++\.?\d*+|\.\d++)(?:[eE][+-]?\d++)?"

# Arguments of functions: x, 2*x, -x, 0.5 + x, 1 - 2*x, and x + 0.5
ARGUMENT = (
    rf"(?:-?\s*+{NUMBER}\s*+(?=[+-]))?\s*+[+-]?\s*+(?:{NUMBER}\s*+\*\s*+)?{VARIABLE}"
    rf"(?:\s*+[+-]\s*+{NUMBER})?"
)

_POWER = r"(?:\^\d++)?"

_FACTOR = rf"(?:[^\W\d]\w*+\(\s*+{ARGUMENT}\s*+\)|{VARIABLE}){_POWER}"

_DIVISOR = rf"(?:\(\s*+{ARGUMENT}\s*+\)|{VARIABLE}){_POWER}"

PRODUCT = rf"(?:1\s*+/\s*+{_DIVISOR}|{_FACTOR})(?:\s*+\*\s*+{_FACTOR}|\s*+/\s*+{_DIVISOR})*"

_TERM = re.compile(rf"\s*+{PRODUCT}\s*+")

_FACTORS = re.compile(
    rf"(?P<over>/)?\s*+(?:(?P<function>[^\W\d]\w*+)?\(\s*+(?P<argument>{ARGUMENT})\s*+\)"
    rf"|(?P<variable>{VARIABLE}))(?:\^(?P<power>\d++))?"
)

_ARGUMENT = re.compile(
    rf"(?P<shift>-?\s*+{NUMBER}(?=\s*+[+-]))?\s*+(?P<sign>[+-]?)\s*+(?:(?P<scale>{NUMBER})\s*+\*\s*+)?"
    rf"(?P<variable>{VARIABLE})\s*+(?P<behind>[+-]\s*+{NUMBER})?"
)


_AVERAGED = r"[^\W\d]\w{,99}(?:\^\d{1,3})?"


def check_variable(name: str) -> None:
    """Raise ValueError for a name that cannot stand in a term; paths and markup are refused too."""
    if not isinstance(name, str) or not re.fullmatch(r"[^\W\d]\w{,99}", name):
        word = re.sub(r"\W+", "_", str(name)).strip("_")[:50] or "x"
        other = f"x{word}" if word[0].isdecimal() else word
        raise ValueError(
            "a variable's name must be a word of letters, digits and _, such as 'n_i', got "
            f"{name!r}; rename it, perhaps {other!r}"
        )


def check_state(name: str) -> None:
    """Raise ValueError unless a name is a valid variable or an average such as `<n_i*n_n>`.

    The name of a zone may follow: `n_i@exit`, see `zone_averages`.
    """
    averaged = rf"<{_AVERAGED}(?:\*{_AVERAGED})*>"
    name = re.sub(r"(?<=.)@\w{1,100}$", "", name) if isinstance(name, str) else name
    if not (isinstance(name, str) and re.fullmatch(averaged, name)):
        check_variable(name)


LONGEST_POWER = 100  # digits; a longer power is certainly a mistake

RECIPROCAL = "1/"  # name of the function x -> 1/x, for factors below the fraction line


@dataclass(frozen=True)
class Part:
    """One factor of a term as written: function(shift + scale * variable)^power.

    function: empty for the variable itself, `RECIPROCAL` for a factor below the fraction line.
    """

    function: str
    variable: str
    scale: float = 1.0
    shift: float = 0.0
    power: int = 1

    @property
    def argument(self) -> str:
        """Argument such as `x`, `2*x`, `0.5+x`, `1-2*x`; its numbers are read back exactly."""
        return self.argument_of(self.variable, times="*")

    def argument_of(self, variable: str, *, times: str) -> str:
        """Argument with another notation for the variable and for the multiplication sign."""
        size = abs(self.scale)
        product = variable if size == 1.0 else f"{number_text(size)}{times}{variable}"
        sign = "-" if self.scale < 0.0 else "+" if self.shift else ""
        return f"{number_text(self.shift) if self.shift else ''}{sign}{product}"

    @property
    def is_bare(self) -> bool:
        """True if the argument is the variable itself."""
        return self.scale == 1.0 and self.shift == 0.0

    @property
    def text(self) -> str:
        """Factor without its power: `x`, `sin(2*x)`, `1/x`, `1/(0.5+x)`."""
        is_call = self.function not in ("", RECIPROCAL) or not self.is_bare
        return self.function + (f"({self.argument})" if is_call else self.argument)


def number_text(value: float) -> str:
    """Shortest text that is read back as the same number: `2`, `0.5`, `1e+18`."""
    return repr(value).removesuffix(".0")


def split_term(name: str) -> list[Part]:
    """Split a term name such as `x^2*sin(2*y)/(0.5+z)` into its factors; `1` has none.

    Raises ValueError for anything but a product of variables and functions of one variable.
    """
    if name.strip() == "1":
        return []
    if not _TERM.fullmatch(name):
        raise ValueError(
            "a term is variables joined by *, with whole powers, and functions of one variable, "
            f"got {name!r:.300}; write it like 'n_i^2*n_n', 'x*sin(2*y)' or 'x/(0.5+y)'"
        )
    parts = []
    for found in _FACTORS.finditer(name):
        function = RECIPROCAL if found["over"] else found["function"] or ""
        variable, scale, shift = _split_argument(found["argument"] or found["variable"])
        power = found["power"] or "1"
        if len(power) > LONGEST_POWER:
            raise ValueError(f"a power must have up to {LONGEST_POWER} digits, got {name!r:.80}")
        parts.append(Part(function, variable, scale, shift, int(power)))
    return parts


def _split_argument(text: str) -> tuple[str, float, float]:
    """Variable, scale and shift of a function's argument."""
    found = _ARGUMENT.fullmatch(text.strip())
    assert found is not None
    scale = float(found["scale"] or 1.0) * (-1.0 if found["sign"] == "-" else 1.0)
    added = (found["shift"] or "0", found["behind"] or "0")
    return found["variable"], scale, sum(float(part.replace(" ", "")) for part in added)


def split_factors(name: str) -> list[tuple[str, int]]:
    """Variables and powers of a product: `n_i^2*<n_n*R_ion>` -> (n_i, 2), (<n_n*R_ion>, 1)."""
    parts = split_term(name)
    if not parts or any(part.function for part in parts):
        raise ValueError(
            f"a product is variables joined by *, with whole powers, got {name!r:.300}; write it "
            "like 'n_i^2*n_n'"
        )
    return [(part.variable, part.power) for part in parts]


def product_of(powers: Mapping[str, int]) -> str:
    """The term that is the product of variables to these powers; "1" without any."""
    parts = [name if n == 1 else f"{name}^{n}" for name, n in powers.items() if n]
    return "*".join(parts) or "1"


def factors_of(name: str) -> dict[str, int]:
    """The variables that a term is a product of, and their powers; none for another function."""
    try:
        return dict(split_factors(name))
    except ValueError:
        return {}
