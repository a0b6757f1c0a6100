"""Checksums of stored results, which verify parameters and all values when they are read back."""

from __future__ import annotations

import hashlib
from numbers import Real
from typing import Any

import numpy as np
import xarray as xr

CHECKSUM, MADE_OF = "checksum", "kept_for"


def with_checksum(field: xr.Dataset, parameters: str) -> xr.Dataset:
    """Add to a result the parameters it was computed from, and a checksum of all its content."""
    marked = field.assign_attrs({MADE_OF: parameters})
    return marked.assign_attrs({CHECKSUM: checksum(marked)})


def verified(stored: xr.Dataset, parameters: str) -> xr.Dataset:
    """Return a stored result without its marks.

    Raises ValueError if it was computed from other parameters, or has changed since.
    """
    if stored.attrs.get(MADE_OF) != parameters:
        raise ValueError("it is of other parameters")
    if stored.attrs.get(CHECKSUM) != checksum(stored):
        raise ValueError("its checksum does not fit: it has changed since it was written")
    attributes = {name: v for name, v in stored.attrs.items() if name not in (CHECKSUM, MADE_OF)}
    return stored.drop_attrs(deep=False).assign_attrs(attributes)


def checksum(field: xr.Dataset) -> str:
    """SHA-256 of all values, names and attributes.

    Numbers in attributes are hashed as float64, since a file may change their type.
    """
    digest = hashlib.sha256()
    for name in sorted(map(str, field.variables)):
        variable = field[name]
        values = np.ascontiguousarray(variable.values)
        digest.update(f"{name} {variable.dims} {values.dtype.str} {values.shape}".encode())
        digest.update(values.tobytes())
        digest.update(_text(variable.attrs))
    digest.update(_text({name: v for name, v in field.attrs.items() if name != CHECKSUM}))
    return digest.hexdigest()


def _text(attributes: dict[Any, Any]) -> bytes:
    """Attributes sorted by name, as bytes; numbers are converted to float64."""
    plain = {
        str(name): float(value).hex() if isinstance(value, Real | np.number) else str(value)
        for name, value in attributes.items()
    }
    return repr(sorted(plain.items())).encode()
