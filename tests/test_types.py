"""Under `make types`: what is not as annotated is refused, in every room, and kernels run bare."""

import sys
from importlib import import_module

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.model.scores import r2

pytestmark = pytest.mark.skipif(
    "tests.checked" not in sys.modules, reason="types are checked by `make types`"
)


@pytest.mark.parametrize(
    "call",
    [
        pytest.param(lambda: r2(truth=[1.0], prediction=[1.0]), id="lists"),
        pytest.param(lambda: r2(truth=np.ones(5), prediction=np.ones(5)), id="an axis missing"),
        pytest.param(lambda: ep.polynomial(3, degree=2), id="a type"),
    ],
)
def test_what_is_not_as_annotated_is_refused(call) -> None:
    from jaxtyping import TypeCheckError

    with pytest.raises(TypeCheckError):
        call()


def test_every_module_is_checked_but_what_is_compiled() -> None:
    from tests.checked import MODULES

    wrapped = [name for name in MODULES if "jaxtyping" in vars(import_module(name))]
    assert wrapped == MODULES
    kernels = import_module("ep2sindy.regression.search_kernels")
    assert "jaxtyping" not in vars(kernels)
