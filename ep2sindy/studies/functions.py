"""Functions of a user's own module, named in a config."""

from __future__ import annotations

import re
from collections.abc import Sequence

from ep2sindy.library.functions import function_names
from ep2sindy.trust.user_code import load_user_module

_FROM_MODULE = re.compile(r"(?P<module>[^\W\d][\w.]*)\.(?P<name>[^\W\d]\w*)(?P<argument>\(.*\))?")


def registered(names: Sequence[str]) -> list[str]:
    """Names as a library takes them: `my_module.tanh(2*x)` imports my_module and is `tanh(2*x)`.

    Raises ValueError for a module that cannot be imported or does not register the name.
    """
    return [_registered(str(name)) for name in names]


def _registered(text: str) -> str:
    found = _FROM_MODULE.fullmatch(text.strip())
    if found is None:
        return text
    module, name = found["module"], found["name"]
    try:
        load_user_module(module)
    except ImportError as error:
        raise ValueError(
            f"functions may name one of your own as MODULE.NAME: {text!r} came, and {error}; the "
            "module must lie below the folder that you start in"
        ) from error
    if name not in function_names():
        raise ValueError(
            f"{module} must register {name!r} when it is imported, by "
            f"ep.register_function({name!r}, value, derivative): it has not"
        )
    return name + (found["argument"] or "")
