"""README and docs hold: their Python runs, prints what they say, and their commands compose."""

import ast
import doctest
import inspect
import re
import shlex
import sys
import tomllib
from collections.abc import Iterator
from enum import Enum
from importlib.util import find_spec
from pathlib import Path
from shutil import which

import numpy as np
import pandas as pd
import pytest
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig

import ep2sindy as ep
from benchmarks import thesis
from benchmarks.regions import three_regions
from ep2sindy._stubs import dotted_names
from ep2sindy.app.arguments import mend
from ep2sindy.app.runner import study_class
from ep2sindy.app.schema import study_of
from ep2sindy.data.open import write_field
from ep2sindy.studies.benchmark import published_cells
from tests.pages import (
    FENCE,
    PAGES,
    QUOTED,
    ROOT,
    arguments,
    blocks,
    commands,
    difference,
    is_alike,
    quoted,
)
from tests.programs import EXPERIMENTS, composed, computed
from tests.rerun import ran_blocks, summary_of

CONF = ROOT / "conf"
SHOWING = [
    page
    for page in PAGES
    if any(b.language in ("python", "console") for b in blocks(page))
    or QUOTED.search(page.read_text("utf-8"))
]
COMMANDS = ("bash", "console")
WITH_BASH = [page for page in PAGES if any(b.language in COMMANDS for b in blocks(page))]


def with_mapping(words: list[str], page: Path) -> list[str]:
    """`data=run` after `inspect run.h5 --write`: a mapping such as it writes."""
    written = re.findall(r"ep2sindy inspect (\w+)\.\w+ --write", page.read_text("utf-8"))
    known = {f"data={name}": ["data=file", f"data.path={name}"] for name in written}
    return [each for word in words for each in known.get(word, [word])]


@pytest.mark.slow
@pytest.mark.parametrize("page", SHOWING, ids=lambda page: page.name)
def test_a_page_runs_and_prints_what_it_says(page: Path, tmp_path: Path) -> None:
    text = page.read_text("utf-8")
    for block, came in ran_blocks(page, text, tmp_path):
        if block.printed is not None:
            assert not difference(block.printed, came), block.text
    for number, path, form in QUOTED.findall(text):
        assert is_alike(number, quoted(number, summary_of(text), path, form)), path


@pytest.mark.parametrize("page", WITH_BASH, ids=lambda page: page.name)
def test_a_command_is_one_that_can_be_given(page: Path) -> None:
    """The program's own are composed and built, but for the data; others are known by name."""
    for block in blocks(page):
        for words in commands(block) if block.language in COMMANDS else ():
            try:
                check_command(with_mapping(words, page))
            except Exception as error:
                error.add_note(f"{page.name}: {' '.join(words)}")
                raise


INLINE = re.compile(r"(?<!`)`(ep2sindy \+exp=[^`]*|ep2sindy -m [^`]*)`(?!`)")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
@pytest.mark.usefixtures("here")
def test_a_config_and_a_command_in_the_text_compose(page: Path) -> None:
    """Configs lie where the page says, in a folder that also holds the page's own modules."""
    text = page.read_text("utf-8")
    configs = [b.text for b in blocks(page) if b.language == "yaml"]
    names = [check_config(config, text) for config in configs]
    own = re.compile(r"thruster=mine|\+exp=(my_\w+)")
    for command in set(INLINE.findall(FENCE.sub("", text))):
        if (found := own.search(command)) is None:
            check_command(shlex.split(command.partition(" | ")[0].removesuffix(" --cfg job")))
        else:
            assert found[1] in names, command


def check_config(config: str, page: str) -> str:
    """Compose and build what a block of YAML holds, and return the name of its experiment."""
    header, _, rest = config.partition("\n")
    package = header.removeprefix("# @package ")
    if package == "_global_":
        name = re.search(r"^experiment: (\w+)$", rest, re.M)[1]
        write_modules(page)
        own = composed_with("exp", name, config, f"+exp={name}", *DATA.get(name, ()))
        study_of(study_class(own.study), own)
        return name
    name = package.rpartition(".")[2]
    Path("B.csv").write_text("z_mm,B_G\n0,50\n25,150\n50,40\n")
    own = composed_with(name, "mine", config, "+exp=breathing", f"{name}=mine")
    study_of(study_class(own.study), own)
    return "mine"


@pytest.mark.slow
def test_the_config_of_a_study_of_ones_own_runs(here: Path) -> None:
    """That of docs/points.md, on short, coarse simulations."""
    (config,) = (b.text for b in blocks(ROOT / "docs" / "points.md") if b.language == "yaml")
    own = composed_with(
        "exp", "my_study", config, "+exp=my_study", "data.duration_s=2.0e-3",
        "data.warm_up_s=0.5e-3", "data.n_cells=30", "data.cache=simulated", "parallel=serial",
        "windows.n_windows=4", "map_points=2", "++keep=false", "output=.",
    )  # fmt: skip
    found = computed(own)
    assert [point["status"] for point in found.summary["points"]] == ["oscillating"] * 4
    assert found.summary["control_laws"]
    assert found.summary["law"]["fit"] in [trial["fit"] for trial in found.summary["trials"]]
    assert len(found.report.tables["map"]) == 2


def test_the_experiment_of_the_page_on_contributing_runs(here: Path) -> None:
    """On oscillations that decay and grow at known rates; the window is three of their periods."""
    t = 0.1 * np.arange(2000.0)
    turns = 2.0 * np.pi * t / 5.0
    record = {
        "t_s": t,
        "x": np.exp(-0.01 * t) * np.cos(turns),
        "y": np.exp(0.02 * t) * np.sin(turns),
    }
    pd.DataFrame(record).to_csv("run.csv", index=False)
    page = (ROOT / "docs" / "contributing.md").read_text("utf-8")
    (config,) = (b.text for b in blocks(ROOT / "docs" / "contributing.md") if b.language == "yaml")
    write_modules(page)
    given = [*DATA["my_growth"], "window_s=15.0", "output=outputs"]
    found = computed(composed_with("exp", "my_growth", config, "+exp=my_growth", *given))
    rates = {"x": pytest.approx(-0.01, abs=1e-5), "y": pytest.approx(0.02, abs=1e-5)}
    assert found.summary["growth"]["record"]["growth_per_s"] == rates
    assert found.summary["headline"]["record/y/growth_per_s"] == rates["y"]
    found.check_figures("sizes")


DATA = {"my_growth": ("data=recognised", "data.path=run.csv", "trajectory.states=[x,y]")}


def composed_with(group: str, name: str, config: str, *overrides: str) -> DictConfig:
    """As `composed`, with one more config below the current folder."""
    folder = Path("conf") / group
    folder.mkdir(parents=True)
    (folder / f"{name}.yaml").write_text(config)
    found = f"hydra.searchpath=[file://{folder.parent.resolve()}]"
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", overrides=[found, *overrides])


def write_modules(page: str) -> None:
    """The modules of which a page says that they lie in a folder of one's own."""
    for module, code in re.findall(
        r"`(my_\w+/\w+\.py)`.*?^```python\n(.*?)^```", page, re.M | re.S
    ):
        folder = Path(module).parent
        for name in [name for name in sys.modules if name.partition(".")[0] == folder.name]:
            del sys.modules[name]  # of a test before, in another folder
        folder.mkdir(exist_ok=True)
        Path(module).write_text(code)


def check_command(words: list[str]) -> None:
    given = arguments(words)
    if given is not None:
        check_program(given)
    elif words[:2] == ["python", "-m"]:
        assert find_spec(words[2]) is not None, words
    elif words[0] == "python":
        assert (ROOT / words[1]).is_file(), words
    elif words[0] == "make":
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), re.M), words
    elif "pip" in words:
        check_extras(words)
    else:
        assert which(words[0], path=str(Path(sys.executable).parent)), words


def check_program(given: list[str]) -> None:
    if given[0] in ("compare", "inspect"):
        return
    is_whole = not any("..." in text for text in given)
    given = [text for text in given if text != "..."]
    overrides = [single(text) for text in given if not text.startswith(("-", "hydra"))]
    for text in given:
        if text.startswith("hydra/launcher="):
            name = text.partition("=")[2]
            assert name == "submitit_local" or (CONF / "hydra/launcher" / f"{name}.yaml").is_file()
    if not overrides:
        assert given[0] in ("--help", "--version"), given
        return
    config = composed(*overrides)
    study = study_class(config.study)
    if is_whole and not isinstance(config.get("points"), str):  # files that are not there
        study_of(study, config)


def single(text: str) -> str:
    """The first job of a sweep."""
    text = mend(text)
    (override,) = OverridesParser.create().parse_overrides([text])
    if not override.is_sweep_override():
        return text
    return f"{override.get_key_element()}={next(iter(override.sweep_string_iterator()))}"


def check_extras(words: list[str]) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for word in words:
        for extras in re.findall(r"\[(.*?)\]", word):
            assert set(extras.split(",")) <= set(project["optional-dependencies"]), words


def test_choices_and_modules_that_a_page_names_are_there() -> None:
    lost = [
        f"{page.name}: {name}" for page in PAGES for name in lost_names(page.read_text("utf-8"))
    ]
    assert not lost, "\n".join(lost)


def lost_names(text: str) -> Iterator[str]:
    """Experiments, choices of groups, benchmarks and files that a page names and nobody has."""
    groups = sorted(folder.name for folder in CONF.iterdir() if folder.is_dir())
    for name in set(re.findall(r"\+exp=(\w+)", text)) - {"my_study", "my_growth", *EXPERIMENTS}:
        yield f"+exp={name}"
    for group, name in re.findall(rf"`(?:[^`\n]* )?({'|'.join(groups)})=(\w+)(?=[` ])", text):
        if not (CONF / group / f"{name}.yaml").is_file() and name not in ("NAME", "mine"):
            yield f"{group}={name}"
    for name in re.findall(r"python -m (benchmarks\.\w+)", text):
        if find_spec(name) is None:
            yield name
    for name in re.findall(
        r"`(?:docs|conf/exp|ep2sindy|tests|benchmarks)/[\w/.]+\.(?:py|md|yaml)`", text
    ):
        if not (ROOT / name.strip("`")).is_file() and not re.search("NAME|my_", name):
            yield name


@pytest.mark.parametrize(
    ("title", "merit", "rounding"),
    [
        ("On the front", "on_front", 0.0),
        ("Selected", "selected", 0.51),
        ("Right terms", "mean_correct_terms", 0.0),
    ],
)
def test_the_thesiss_benchmark_stands_beside_ours(title: str, merit: str, rounding: float) -> None:
    """A dash stands where the thesis has no value."""
    page = (ROOT / "docs" / "benchmark.md").read_text("utf-8")
    section = page.partition(f"\n## {title}")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (\w+) \|.*\n\| \*thesis\* \|(.*)\|$", section, re.M)
    published = published_cells()
    assert [name for name, _ in rows] == [*published["variant"].unique()]
    for name, row in rows:
        shown = re.findall(r"[\d.]+|-", row)
        known = published.loc[published["variant"] == name, merit]  # by system and noise
        printed = [np.nan if each == "-" else float(each) for each in shown]
        np.testing.assert_allclose(printed, known, atol=rounding, err_msg=name)


@pytest.mark.slow
def test_the_thesiss_equations_are_judged_as_their_page_says(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of Tables I to III, at one point and at six."""
    monkeypatch.setattr(sys, "argv", ["thesis"])
    thesis.main()
    printed = capsys.readouterr().out.splitlines()
    rows = [line for line in printed if line.startswith("| I")]
    assert len(rows) == 13 + 6
    page = (ROOT / "docs" / "thesis.md").read_text("utf-8")
    assert [line for line in page.splitlines() if re.match(r"\| I+ \|", line)] == rows


def test_what_a_page_links_to_is_there() -> None:
    lost = [
        f"{page.name}: {target}"
        for page in PAGES
        for target in re.findall(r"\]\(([^)#]+)[^)]*\)", FENCE.sub("", page.read_text("utf-8")))
        if not target.startswith("http") and not (page.parent / target).is_file()
    ]
    assert not lost, "\n".join(lost)


def test_the_messages_that_the_faq_quotes_are_those_of_the_package() -> None:
    """`...` stands for what a message says of names and numbers."""
    quotes = re.findall(r'^### "(.*)"$', (ROOT / "docs" / "faq.md").read_text("utf-8"), re.M)
    assert len(quotes) > 15
    said = "\0".join(messages())
    lost = [quote for quote in quotes if not is_of(quote, said)]
    assert not lost, "\n".join(lost)


def messages() -> list[str]:
    """All texts in the package's code, with `...` for values."""
    found = []
    for path in (ROOT / "ep2sindy").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.JoinedStr):
                parts = [getattr(part, "value", None) for part in node.values]
                found.append("".join(p if isinstance(p, str) else "..." for p in parts))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return found


def is_of(quote: str, text: str) -> bool:
    pieces = [re.escape(piece.strip(" ")) for piece in quote.split("...")]
    return re.search(r"[^\0]*".join(pieces), text) is not None


def test_every_experiment_is_on_the_page_that_leads_to_one() -> None:
    page = (ROOT / "docs" / "index.md").read_text("utf-8")
    assert set(re.findall(r"\+exp=(\w+)", page)) == set(EXPERIMENTS)
    commands_given = re.findall(r"`(ep2sindy \+exp=[^`]*)`", page)
    options = re.findall(r"`('[a-z.]+=[^`]*')`", page)  # for the same command
    same = "ep2sindy +exp=discover data=recognised data.path=run.csv 'trajectory.states=[x,y]'"
    assert options
    for text in [*commands_given, *(f"{same} {option}" for option in options)]:
        check_command(shlex.split(text))


def has_example(name: str) -> bool:
    """Read from the source: importing all of the face takes long."""
    entry = dotted_names()[name]
    source = (ROOT / f"{entry.module.replace('.', '/')}.py").read_text("utf-8")
    if ">>> " not in source:
        return False
    nodes = [node for node in ast.parse(source).body if getattr(node, "name", None) == entry.name]
    return any(">>> " in (ast.get_docstring(node) or "") for node in nodes)


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in dotted_names() if has_example(n)])
def test_the_example_of_a_docstring_runs(name: str, here: Path) -> None:
    """In a folder that holds run.nc."""
    write_field(three_regions(n_z=6, n_r=5, n_samples=300).field, here / "run.nc")
    text = dotted_names()[name].load().__doc__
    example = doctest.DocTestParser().get_doctest(text, {"ep": ep, "np": np}, name, None, None)
    failures: list[str] = []
    doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example, out=failures.append)
    assert not failures, "".join(failures)


@pytest.mark.slow
def test_a_docstring_describes_every_parameter() -> None:
    """In its section `Parameters`, in any order; exceptions and enumerations have none."""
    lost = []
    for name, entry in dotted_names().items():
        value = entry.load()
        if not callable(value) or (isinstance(value, type) and issubclass(value, NO_PARAMETERS)):
            continue
        section = re.search(
            r"^Parameters\n-+\n(.*?)(?=^\w+\n-+\n|\Z)", inspect.getdoc(value), SECTION
        )
        heads = re.findall(r"^(\S.*?) : ", section[1], re.MULTILINE) if section else []
        described = {each.lstrip("*") for head in heads for each in head.split(", ")}
        if missing := set(inspect.signature(value).parameters) - described:
            lost.append(f"{name}: {sorted(missing)}")
    assert not lost, "\n".join(lost)


SECTION = re.MULTILINE | re.DOTALL
NO_PARAMETERS = (Exception, Enum)
