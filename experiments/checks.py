"""Settings that cannot work are refused before anything is computed."""

from math import isfinite

from omegaconf import DictConfig, ListConfig


def check_counts(config: DictConfig, *keys: str) -> None:
    """Raise ValueError unless each is a whole number, one or more."""
    for key in keys:
        if type(config[key]) is not int or config[key] < 1:
            raise ValueError(f"{key} must be a whole number, one or more: {config[key]!r} came")


def check_share(config: DictConfig, key: str) -> None:
    """Raise ValueError unless it is a number between zero and one."""
    if type(config[key]) not in (int, float) or not 0 < config[key] < 1:
        raise ValueError(f"{key} must be a number between 0 and 1: {config[key]!r} came")


def check_lists(config: DictConfig, *keys: str) -> None:
    """Raise ValueError unless each is a list with something in it, everything once."""
    for key in keys:
        values = config[key]
        if not isinstance(values, ListConfig) or not values or len(set(values)) < len(values):
            raise ValueError(f"{key} must be a list such as [a,b], each once: {values!r} came")


def check_numbers(config: DictConfig, *keys: str, whole: bool = False, zero: bool = False) -> None:
    """Raise ValueError unless each is a list of positive numbers; `zero` may be among them."""
    check_lists(config, *keys)
    kinds: tuple[type, ...] = (int,) if whole else (int, float)
    what = f"{'whole ' if whole else ''}numbers, {'zero or more' if zero else 'above zero'}"
    for key in keys:
        for value in config[key]:
            fits = type(value) in kinds and isfinite(value) and (value > 0 or (zero and value == 0))
            if not fits:
                raise ValueError(f"{key} must be {what}: {value!r} came")
