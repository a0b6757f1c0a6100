"""From `variants` and `definitions` to complete methods."""

from importlib.util import find_spec

from hydra.utils import instantiate
from omegaconf import DictConfig

from ep2sindy.studies.benchmark import Variant
from experiments.checks import check_lists


def chosen_variants(config: DictConfig) -> dict[str, Variant]:
    """The methods that `variants` names, built as `definitions` says.

    Raises ValueError for an unknown name, or one whose package is not installed.
    """
    check_lists(config, "variants")
    unknown = [name for name in config.variants if name not in config.definitions]
    if unknown:
        raise ValueError(f"unknown variants {unknown}; there are {list(config.definitions)}")
    return {name: _variant(name, config.definitions[name]) for name in config.variants}


def _variant(name: str, definition: DictConfig) -> Variant:
    if "pysindy" in str(definition.get("_target_")) and find_spec("pysindy") is None:
        raise ValueError(
            f'variants {name!r} needs PySINDy: pip install "ep2sindy[benchmark]", or leave it out, '
            "such as variants=[ours,STLSQ]"
        )
    variant = instantiate(definition)
    if not isinstance(variant, Variant):
        raise ValueError(f"definitions.{name} must name a _target_ that has `find`: {variant} came")
    return variant
