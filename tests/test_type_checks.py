"""What all tests check beside their own facts: shapes and types of the whole package."""

import sys
from importlib.util import module_from_spec, spec_from_file_location
from types import ModuleType

import numpy as np
import pytest
from beartype.roar import BeartypeCallHintViolation

import ep2sindy as ep
from tests.type_checks import Loader

SOURCE = """
from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, no_type_check

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from heavy import Guest

@dataclass(frozen=True)
class Line:
    slopes: Float[np.ndarray, " n"]
    offsets: Float[np.ndarray, " n"]

    def joined(self, other: Line) -> Line:
        return other

    @property
    def mean(self) -> float:
        return "no number"

def product(a: Float[np.ndarray, "i j"], b: Float[np.ndarray, " j"]) -> Float[np.ndarray, " i"]:
    return a @ b

def transposed(a: Float[np.ndarray, "i j"]) -> Float[np.ndarray, "j i"]:
    return a

def twice(n: int, guest: Guest = "any") -> int:
    return 2 * n

@no_type_check
def lenient(n: int) -> int:
    return n
"""


@pytest.fixture(scope="module")
def module(tmp_path_factory: pytest.TempPathFactory) -> ModuleType:
    path = tmp_path_factory.mktemp("source") / "checked_source.py"
    path.write_text(SOURCE)
    spec = spec_from_file_location(path.stem, path, loader=Loader(path.stem, str(path)))
    assert spec is not None
    assert spec.loader is not None
    found = module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, path.stem, found)
        spec.loader.exec_module(found)
    return found


@pytest.mark.parametrize(
    "call",
    [
        pytest.param(lambda m: m.product(np.ones((2, 3)), np.ones(2)), id="an axis of two sizes"),
        pytest.param(lambda m: m.product(np.ones(3), np.ones(3)), id="an axis missing"),
        pytest.param(lambda m: m.product(np.ones((2, 3)), np.ones(3, int)), id="whole numbers"),
        pytest.param(lambda m: m.transposed(np.ones((2, 3))), id="a returned shape"),
        pytest.param(lambda m: m.Line(np.ones(2), np.ones(3)), id="fields of two sizes"),
        pytest.param(lambda m: m.Line(np.ones(2), offsets=[1.0, 2.0]), id="a field's type"),
        pytest.param(lambda m: m.Line(np.ones(2), np.ones(2)).joined(1), id="its own class"),
        pytest.param(lambda m: m.Line(np.ones(2), np.ones(2)).mean, id="a property's type"),
        pytest.param(lambda m: m.twice("2"), id="a type"),
    ],
)
def test_what_is_not_as_annotated_is_refused(module: ModuleType, call) -> None:
    with pytest.raises(BeartypeCallHintViolation):
        call(module)


def test_what_is_as_annotated_passes(module: ModuleType) -> None:
    for size in (3, 4):  # names of axes hold within one call
        assert module.product(np.ones((2, size)), np.ones(size)).tolist() == [size, size]
    assert module.transposed(np.eye(2)).shape == (2, 2)
    line = module.Line(np.ones(2), np.zeros(2))
    assert line.joined(line) is line
    assert module.twice(2, guest=object()) == 4
    assert module.lenient("text") == "text"


def test_the_package_is_checked() -> None:
    with pytest.raises(BeartypeCallHintViolation):
        ep.r2(truth=[1.0, 2.0], prediction=[1.0, 2.0])
