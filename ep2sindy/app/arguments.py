"""Arguments of the command line: mended before Hydra reads them, its errors in our words.

Only Hydra is imported here: a command must not wait for the numerics.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf

from ep2sindy.app.targets import target_of
from ep2sindy.runtime.screen import listed, near_words
from ep2sindy.trust.user_code import nodes_of

JOBS = "jobs"  # folder of a sweep with a record of each job
# Commands, which stand first, without +exp=NAME; and the modules of this package that run them.
COMMANDS = {"compare": "compare", "inspect": "inspection", "precompile": "precompile"}
# Options of Hydra with a value, and those without one. A run always begins with the package's own
# config.yaml, so the options that would replace it are not among them.
VALUED = ("--cfg", "-c", "--package", "-p", "--config-dir")
FLAGS = (
    "--help", "-h", "--hydra-help", "--version", "--resolve", "--run", "-r", "--multirun", "-m",
    "--shell-completion", "-sc",
)  # fmt: skip
QUOTED_KEY = re.compile(r"""(?<=[{,])\s*(?P<quote>["'])(?P<name>\w+)(?P=quote)\s*(?=:)""")
# `points.files=PATTERN`, whose braces would be a mapping to Hydra; or the same as `points=PATTERN`.
FILES = re.compile(r"points(?:\.files=|=(?=[^\[{]*\{\w+\}))['\"]?(?P<value>.+?)['\"]?", re.DOTALL)
# Names of files, folders, signals and groups, which Hydra takes unquoted if they are plain.
NAMES = re.compile(
    r"""(?P<key>\+{0,2}(?:data|data\.path|output|signal))="""
    r"""(?P<value>(?!["']|\[.*\]$|.*\$\{)(?=.*[^A-Za-z0-9_/.*?-]).+)"""
)
# What is quoted, or a word with ^ or letters beyond ASCII; but not a name of a mapping.
LETTERS = re.compile(
    r"""("(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*')|([^\s,[\]{}:=()"']*[\^\x80-\U0010ffff][^\s,[\]{}:=()"']*)(?!\s*:)"""
)


def options_first(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """The options, each value after its name, and the settings, mended.

    Hydra takes the options first. Raises ValueError for an unknown option, naming the nearest one.
    """
    options, settings = [], []
    words = iter(arguments)
    for text in words:
        name, sign, value = text.partition("=")
        if not text.startswith("-"):
            settings.append(mend(text))
        elif name in VALUED:
            options += [name, value if sign else next(words, "")]
        elif text in FLAGS:
            options.append(text)
        else:
            near = near_words(name, [*VALUED, *FLAGS])
            raise ValueError(f"unknown option {name!r}{near}; see --help")
    return options, settings


def mend(text: str) -> str:
    """A setting as Hydra's grammar takes it.

    Names of a mapping may come in quotes, names of files, folders and columns as they are, and the
    files or axes of points in any form.
    """
    text = re.sub(r"^points\.files=(?=\[.*\]$)", "points=", text)
    text = re.sub(r"^points\.axes=(\[.*\])$", r"points=[{axes: \1}]", text)
    if pattern := FILES.fullmatch(text):
        text = f"points={_quoted(pattern['value'])}"
    elif name := NAMES.fullmatch(text):
        is_sweep = "," in name["value"] and not Path(name["value"]).exists()
        text = text if is_sweep else f"{name['key']}={_quoted(name['value'])}"
    key, sign, value = QUOTED_KEY.sub(lambda found: found["name"], text).partition("=")
    return key + sign + LETTERS.sub(lambda found: found[1] or _quoted(found[2]), value)


def _quoted(text: str) -> str:
    """Text in double quotes. To Hydra a backslash is itself, but for those before a quote."""
    escaped = re.sub(r'(\\*)("|$)', lambda m: 2 * m[1] + m[2].replace('"', r"\""), text)
    return f'"{escaped}"'


def explain(
    error: HydraException, settings: Sequence[str], compose: Callable[[list[str]], DictConfig]
) -> str:
    """Words for settings that cannot be composed, with the nearest names.

    compose: makes a config of other settings, here of those that are right.
    """
    if isinstance(error, OverrideParseException):
        return _unreadable(error.override, error.message.strip().partition("\n")[0])
    if isinstance(error, MissingConfigException):
        return _no_choice(error)
    message = str(error).partition("\nSee https")[0]
    found = re.match(
        r"Could not (override|delete from config\.) '?([^'\s]+?)'(?:\.| does)", message
    )
    if found is None:
        cause = str(error.__cause__ or "").strip().partition("\n")[0]
        return ": ".join(filter(None, [message, cause])) + "; --cfg job shows what a config has"
    key = found[2]
    if "No match in the defaults list" in message:
        typed = next((text for text in settings if _key(text) == key), key)
        return f"{typed!r} adds to the config, which needs a plus: write +{typed}"
    try:
        # Values with commas, which may be those of a sweep, are left out: only keys are needed.
        return _no_key(key, compose([s for s in settings if _key(s) != key and "," not in s]))
    except HydraException:  # another setting cannot be composed either
        return f"unknown key {key!r}; --cfg job shows those that there are"


def _key(setting: str) -> str:
    return setting.lstrip("+~").partition("=")[0]


def _unreadable(text: str, reason: str) -> str:
    """Words for an argument that is no setting."""
    if "=" in text or text.startswith("~"):
        return (
            f"{text!r} cannot be read as KEY=VALUE ({reason}); text that holds signs such as "
            """( { : , must stand in double quotes inside single ones: 'KEY="TEXT"', """
            """'KEY={NAME: ["TEXT"]}'"""
        )
    return (
        f"an argument must be KEY=VALUE, such as +exp=discover or seed=1, got {text!r}"
        f"{near_words(text, COMMANDS, form='the command {}, which stands first')}; "
        f"+exp={text} is the form for an experiment"
    )


def _no_choice(error: MissingConfigException) -> str:
    """Words for a choice of a group, or an experiment, that there is not."""
    group, _, name = str(error.missing_cfg_file or "").rpartition("/")
    if name.startswith("submitit"):
        return f"the launcher {name} comes with an extra: pip install 'ep2sindy[cluster]'"
    options = sorted(error.options or ())
    if not group or not options:
        return str(error).partition("\nConfig search path")[0]
    what = "experiment" if group == "exp" else f"alternative of {group}"
    near = near_words(name, options, form="+exp={}" if group == "exp" else f"{group}={{}}")
    return f"unknown {what} {name!r}{near}; choose from {listed(options)}"


def _no_key(key: str, config: DictConfig) -> str:
    """Words for a key that a config does not have, with the names at its place."""
    node: Any = OmegaConf.to_container(config)
    near = near_words(key, (each for each, _ in nodes_of(node) if "[" not in each))
    place = ""
    *outer, name = key.split(".")
    for each in outer:
        if not isinstance(node, dict) or each not in node:
            break
        node, place = node[each], f"{place}.{each}".lstrip(".")
    if not isinstance(node, dict):
        return f"unknown key {key!r}: {place} is {node!r}, and has no keys"
    names = {*map(str, node)}
    if "_target_" in names:  # what the target takes, though the config leaves it to its default
        taken = {*inspect.signature(target_of(node, place)).parameters}
        if name in taken - names:
            return f"{key!r} is left to its default here: a plus sets it, +{key}=VALUE"
        names |= taken
    whose = f"{place} has" if place else "keys are"
    free = f"; a new one, where any is allowed, takes a plus: +{key}" if place else ""
    return f"unknown key {key!r}{near}; {whose} {listed(sorted(names - {'_target_'}))}{free}"
