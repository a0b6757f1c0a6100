"""Reader of Zarr stores."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import xarray as xr

from ep2sindy.data.readers.source import FileSource, Reader, dataset_source
from ep2sindy.runtime.files import read_json

# Allowed compressors and filters, which turn bytes into bytes or numbers. Others may create objects
# that can run code (pickle), and a codec registered by name may do anything.
_NAMES = """
blosc zlib gzip zstd lz4 bz2 lzma shuffle delta fixedscaleoffset quantize bitround packbits astype
crc32 crc32c adler32 fletcher32 jenkins_lookup3
"""
CODECS = frozenset(_NAMES.split())
CODECS_V3 = frozenset({"bytes", "transpose", "sharding_indexed", "vlen-utf8"})
ATTRIBUTES = ".zattrs"
METADATA = (".zarray", "zarr.json")
LARGEST_METADATA = 10_000_000  # bytes


def read_zarr(path: Path) -> FileSource:
    """Open a Zarr store in a folder, with named dimensions as xarray writes it.

    Values are read when they are used. Raises ValueError, before anything is decoded, for an array
    of objects or an array with a codec that is not on the list of allowed ones.
    """
    check_store(path)
    return dataset_source(
        path, xr.open_dataset(path, engine="zarr", consolidated=False, decode_cf=False)
    )


def check_store(path: Path) -> None:
    """Raise ValueError unless a store consists of plain files and its arrays of numbers or text.

    Only the metadata are read.
    """
    for each in path.rglob("*"):
        if each.is_symlink() or not (each.is_file() or each.is_dir()):
            raise ValueError(f"{each.relative_to(path)} is a link, a pipe or a device, and no file")
    for place in (path / ATTRIBUTES, *path.glob(f"*/{ATTRIBUTES}")):
        if place.is_file():
            _metadata(place)
    for name in METADATA:
        for place in (path / name, *path.glob(f"*/{name}")):
            if place.is_file():
                _check_array(place.relative_to(path), _metadata(place))


def _metadata(place: Path) -> dict[str, Any]:
    if place.stat().st_size > LARGEST_METADATA:
        raise ValueError(f"{place.name} of {place.stat().st_size} bytes is no array's metadata")
    found = read_json(place.read_text("utf-8"))
    if not isinstance(found, dict):
        raise ValueError(f"{place.name} must hold an object: {type(found).__name__} came")
    return found


def _check_array(place: Path, metadata: dict[str, Any]) -> None:
    """Check the metadata of one array, or of a group, which has neither type nor codecs."""
    sizes, chunks = _list(metadata, "shape"), _list(metadata, "chunks")
    wrong = [n for n in (*sizes, *chunks) if n is not None and not (type(n) is int and n >= 0)]
    if wrong or 0 in chunks:
        raise ValueError(
            f"{place}: sizes must be whole numbers: {sizes} in chunks of {chunks} came"
        )
    kind = metadata.get("dtype", metadata.get("data_type", ""))
    if "O" in json.dumps(kind) or "object" in json.dumps(kind):
        raise ValueError(
            f"{place}: an array must be of numbers or of text of fixed length: dtype {kind!r} "
            "came, whose objects may run code when they are read; leave it out of the store"
        )
    for name in _codecs(metadata):
        if name.removeprefix("numcodecs.") not in CODECS and name not in CODECS_V3:
            raise ValueError(
                f"{place}: codecs must be among {sorted(CODECS | CODECS_V3)}: {name!r} came; "
                "write the store again with one of them"
            )


def _codecs(metadata: dict[str, Any]) -> Iterator[str]:
    """Names of all codecs of an array in either Zarr format, including those inside shards."""
    listed = [metadata.get("compressor"), *_list(metadata, "filters"), *_list(metadata, "codecs")]
    listed += [*_list(metadata, "index_codecs"), *_list(metadata, "storage_transformers")]
    for codec in listed:
        if isinstance(codec, dict):
            yield str(codec.get("id", codec.get("name")))
            inner = codec.get("configuration")
            yield from _codecs(inner if isinstance(inner, dict) else {})
        elif codec is not None:
            yield str(codec)


def _list(metadata: dict[str, Any], key: str) -> list[Any]:
    value = metadata.get(key)
    return value if isinstance(value, list) else [value]


ZARR = Reader("Zarr", read_zarr, form="folder", endings=(".zarr",))
