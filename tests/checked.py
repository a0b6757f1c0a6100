"""`make types`: shapes and types of every call in the package are checked, by jaxtyping's own hook.

A plugin of pytest (`-p tests.checked`), for the hook must stand before the package is imported.
"""

from importlib import import_module
from pathlib import Path

from beartype import BeartypeConf, beartype
from jaxtyping import install_import_hook

PACKAGE = Path(__file__).resolve().parents[1] / "ep2sindy"
# Compiled by numba, which cannot look inside a checking wrapper.
COMPILED = ("kernels", "gram_kernels")  # endings of names
MODULES = [
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    for path in sorted(PACKAGE.rglob("*.py"))
    if path.name != "__init__.py" and not path.stem.endswith(COMPILED)
]
# While a module runs, the hook marks the bytecode of all that it imports: those would be compiled
# anew, were they not there before.
GUESTS = [
    "h5py",
    "hydra",
    "jinja2",
    "matplotlib.pyplot",
    "numba",
    "pandas",
    "pint",
    "rich",
    "scipy.integrate",
    "scipy.signal",
    "sklearn.linear_model",
    "sympy",
    "tensorboard",
    "torch",
    "torchdiffeq",
    "xarray",
    "zarr",
]

for guest in GUESTS:
    import_module(guest)
# As for mypy, a whole number is a number (PEP 484).
check_types = beartype(conf=BeartypeConf(is_pep484_tower=True))
install_import_hook(MODULES, "tests.checked.check_types")
