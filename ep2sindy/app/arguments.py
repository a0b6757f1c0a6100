"""Arguments of the command line: mended before Hydra reads them, its errors in our words.

Hydra itself calls what stands in `callbacks` and in the settings of its loggers. These must stay as
they are, since a config may name only what is marked for configs.

Only Hydra is imported here: a command must not wait for the numerics.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from shutil import which
from typing import Any

import hydra._internal.hydra as program
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import ConfigCompositionException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf

from ep2sindy.app.targets import nodes_of, target_of
from ep2sindy.runtime.screen import listed, near_words

JOBS = "jobs"  # folder of a sweep with a record of each job
COMMANDS = ("compare", "inspect", "warm")  # that stand first, without +exp=NAME
QUOTED_KEY = re.compile(r"""(?<=[{,])\s*(?P<quote>["'])(?P<name>\w+)(?P=quote)\s*(?=:)""")
# `points.files=PATTERN`, whose braces would be a mapping to Hydra; or the same as `points=PATTERN`.
FILES = re.compile(r"points(?:\.files=|=(?=[^\[{]*\{\w+\}))(?P<value>.+)", re.DOTALL)
QUOTES = "'\""
BEFORE_QUOTE = re.compile(r'(\\*)("|$)')
# Names of files, folders, signals and groups, which Hydra takes unquoted if they are plain.
NAMES = re.compile(
    r"""(?P<key>\+{0,2}(?:data|data\.path|output|signal))="""
    r"""(?P<value>(?!["']|\[.*\]$|.*\$\{)(?=.*[^A-Za-z0-9_/.*?-]).+)"""
)
# What is quoted, or a word with letters beyond ASCII; but not a name of a mapping.
LETTERS = re.compile(
    r"""("(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*')|([^\s,[\]{}:=()"']*[^\x00-\x7f][^\s,[\]{}:=()"']*)(?!\s*:)"""
)

SILENT = {"version": 1, "root": {"level": "ERROR"}, "disable_existing_loggers": True}
FIXED: Mapping[str, Any] = {"callbacks": {}, "job_logging": SILENT, "hydra_logging": SILENT}

PLUGINS = ("hydra._internal.core_plugins.", "hydra_plugins.")  # where parts may come from

Compose = Callable[[list[str]], DictConfig]


def options_first(arguments: Sequence[str]) -> list[str]:
    """The arguments with options before settings, as Hydra takes them, each mended.

    Raises ValueError for an option that there is not, naming the nearest one, and as `mend` does.
    """
    parser = get_args_parser()
    known = [name for action in parser._actions for name in action.option_strings]
    for text in arguments:
        name = text.partition("=")[0]
        if name.startswith("--") and not any(each.startswith(name) for each in known):
            raise ValueError(f"unknown option {name!r}{near_words(name, known)}; see --help")

    def refuse(message: str) -> None:
        raise ValueError(f"options must be those of --help: {message}")

    parser.error = refuse  # type: ignore[assignment,method-assign]
    settings = list(parser.parse_intermixed_args(list(arguments)).overrides)
    options = [text for text in arguments if text not in settings]
    return [*options, *map(mend, settings)]


def mend(text: str) -> str:
    """A setting as Hydra's grammar takes it.

    Names of a mapping may come in quotes, names of files, folders and columns as they are, and the
    files of points in any form.

    Raises ValueError for an argument that is no setting.
    """
    if pattern := FILES.fullmatch(text):
        text = f"points={_quoted(pattern['value'].strip(QUOTES))}"
    elif (name := NAMES.fullmatch(text)) and not _is_sweep(name["value"]):
        text = f"{name['key']}={_quoted(name['value'])}"
    without = QUOTED_KEY.sub(lambda found: found["name"], text)
    key, sign, value = without.partition("=")
    without = key + sign + LETTERS.sub(lambda found: found[1] or _quoted(found[2]), value)
    try:
        OverridesParser.create().parse_overrides([without])
    except OverrideParseException as error:
        raise ValueError(_unreadable(text, error.message.strip().partition("\n")[0])) from error
    return without


def _quoted(text: str) -> str:
    """Text in double quotes. To Hydra a backslash is itself, but for those before a quote."""
    return f'"{re.sub(BEFORE_QUOTE, _escaped, text)}"'


def _escaped(found: re.Match[str]) -> str:
    return 2 * found[1] + ("\\" + found[2] if found[2] else "")


def _is_sweep(value: str) -> bool:
    """True for several values between commas, unless that is the name of a file."""
    return "," in value and not Path(value).exists()


class Loader(ConfigLoaderImpl):
    """Hydra's loader of configs, with errors in our words; it calls nothing that a config names."""

    def load_configuration(
        self, config_name: str | None, overrides: list[str], *how: Any, **more: Any
    ) -> DictConfig:
        def compose(overrides: list[str]) -> DictConfig:
            return ConfigLoaderImpl.load_configuration(self, config_name, overrides, *how, **more)

        try:
            found = compose(overrides)
        except MissingConfigException as error:
            raise ValueError(_no_choice(error)) from error
        except ConfigCompositionException as error:
            raise ValueError(_not_set(error, overrides, compose)) from error
        for name, value in FIXED.items():
            if (came := OmegaConf.to_container(found.hydra[name], resolve=True)) != value:
                raise ValueError(
                    f"hydra.{name} must stay as it is, for it names what is called: {came!r} came; "
                    "leave it out"
                )
        check_plugins(found.hydra)
        return found


def check_plugins(hydra: DictConfig) -> None:
    """Raise ValueError for a launcher or sweeper that cannot start jobs, before Hydra fails."""
    for part in ("launcher", "sweeper"):
        target = str(hydra[part].get("_target_"))
        if not target.startswith(PLUGINS):
            raise ValueError(
                f"hydra.{part} must be one of Hydra's plugins: {target!r} came; leave it out"
            )
        if target.endswith("SlurmLauncher") and which("srun") is None:
            raise ValueError(
                "hydra/launcher=slurm needs the command srun of SLURM, and there is none here: "
                "start the sweep on a node of the cluster, or take hydra/launcher=submitit_local"
            )


@contextmanager
def our_loader() -> Iterator[None]:
    """A context in which Hydra composes configs by `Loader`."""
    program.ConfigLoaderImpl = Loader  # type: ignore[misc]
    try:
        yield
    finally:
        program.ConfigLoaderImpl = ConfigLoaderImpl  # type: ignore[misc]


def _no_choice(error: MissingConfigException) -> str:
    """Words for a choice of a group, or an experiment, that there is not."""
    group, _, name = str(error.missing_cfg_file or "").rpartition("/")
    if group == "hydra/launcher" and name.startswith("submitit"):
        return f"the launcher {name} comes with an extra: pip install 'ep2sindy[cluster]'"
    options = sorted(error.options or ())
    if not group or not options:
        return str(error).partition("\nConfig search path")[0]
    what = "experiment" if group == "exp" else f"choice of {group}"
    form = "+exp={}" if group == "exp" else f"{group}={{}}"
    near = near_words(name, options, form=form)
    return f"there is no {what} {name!r}{near}; there are {listed(options)}"


def _unreadable(text: str, reason: str) -> str:
    """Words for an argument that is no setting."""
    if "=" in text or text.startswith("~"):
        return (
            f"{text!r} cannot be read as KEY=VALUE ({reason}); text that holds signs such as "
            """^ ( { : , must stand in double quotes inside single ones: 'KEY="TEXT"', """
            """'KEY={NAME: ["TEXT"]}'"""
        )
    return (
        f"an argument must be KEY=VALUE, such as +exp=discover or seed=1: {text!r} came"
        f"{near_words(text, COMMANDS, form='the command {}, which stands first')}; "
        f"+exp={text} is the form for an experiment"
    )


def _not_set(error: ConfigCompositionException, overrides: Sequence[str], compose: Compose) -> str:
    """Words for a setting that does not fit the config."""
    said = str(error)
    found = re.match(r"Could not (override|delete from config\.) '?([^'\s]+?)'(?:\.| does)", said)
    if found is None:
        cause = str(error.__cause__ or "").strip().partition("\n")[0]
        merged = re.match(r"Error merging override (.*)", said, re.DOTALL)
        if merged and cause:
            return (
                f"{merged[1]!r} cannot be set, for the config has another kind of value there: "
                f"{cause}; --cfg job shows what it has"
            )
        said = said or f"a config cannot be read: {cause}"
        return said.partition("\nSee https")[0]
    key = found[2]
    typed = next((text for text in overrides if _key(text) == key), key)
    if "No match in the defaults list" in said:
        return f"{typed!r} adds to the config, which needs a plus: write +{typed}"
    others = [text for text in overrides if _key(text) != key]
    try:
        return _no_key(key, compose(others))
    except Exception:  # another setting cannot be composed either: no names to compare with
        return f"unknown key {key!r}; --cfg job shows those that there are"


def _key(override: str) -> str:
    return override.lstrip("+~").partition("=")[0]


def _no_key(key: str, config: DictConfig) -> str:
    """Words for a key that a config does not have, with the names at its place."""
    node: Any = config
    place = ""
    for name in key.split("."):
        if not isinstance(node, DictConfig) or name not in set(map(str, node)):
            break
        node, place = node[name], f"{place}.{name}" if place else name
    if not isinstance(node, DictConfig):
        return f"unknown key {key!r}: {place} is {node!r}, and has no keys"
    names = sorted(set(map(str, node)) - {"_target_", "hydra"})
    arguments: Any = {}
    if "_target_" in node:  # what the target takes, though the config leaves it to its default
        arguments = inspect.signature(target_of(node, place)).parameters
    taken = set(arguments)
    prefix = f"{place}." if place else ""
    if name in taken:
        return f"{key!r} is left to its default here: a plus sets it, +{key}=VALUE"
    near = near_words(name, {*names, *taken}, form=f"{prefix}{{}}")
    if not near:
        plain: Any = OmegaConf.to_container(config)
        elsewhere = [each for each, _ in nodes_of(plain | {"hydra": None}) if "[" not in each]
        lasts = {each: each.rpartition(".")[2] for each in sorted(elsewhere, key=_depth)}
        alike = get_close_matches(name, {*lasts.values()}, n=1)
        found = [each for each, last in lasts.items() if last in alike]
        near = f"; near it is {' or '.join(found)}" if found else ""
    whose = f"{place} has" if place else "there are"
    free = "" if taken or not place else f"; a new one, where any may stand, takes a plus: +{key}"
    return f"unknown key {key!r}{near}; {whose} {listed(sorted({*names, *taken}))}{free}"


def _depth(place: str) -> int:
    return place.count(".")
