"""The report that a study fills while it runs: models, tables, figures, and what was found."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from ep2sindy.library.relations import Constraint
from ep2sindy.library.units import SECONDS, Clock
from ep2sindy.model.model import SparseModel
from ep2sindy.report.document import Block, Captioned, Picture, Result, Section, Table, Text
from ep2sindy.report.folder import RunFolder
from ep2sindy.report.models import coefficients, equations, interval_table, model_facts
from ep2sindy.report.page import About, Drawn, by_places, draw, page_html, settings_used
from ep2sindy.report.results import TIMES, ResultTable, json_rows, on_clock
from ep2sindy.report.screen import PAGE, Screen, renderables
from ep2sindy.report.tensorboard import Board
from ep2sindy.runtime.files import replacing, write_json, write_text
from ep2sindy.runtime.progress import Bars, Progress, count_pieces

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(eq=False)
class Report:
    """What a run has found, and where it goes: its folder, screen, page and TensorBoard.

    A study adds models, tables, figures and texts in the order in which they are to be read. Models
    and tables are written at once; figures, page and summary by `finish`. Everything that is added
    goes into the section that was begun last.

    seed: of the run. settings: the whole config as plain values. provenance: version of the code,
    and the command. watch: receives the progress. models, tables, figures: by the names of their
    files. sections: of the page. summary: entries of summary.json. headline: the few numbers by
    which runs are compared, whose names do not depend on the findings. result: what was found, the
    beginning of the page and the end of the screen. clock: of the record's times, by which numbers
    are named in files.
    """

    title: str
    seed: int
    folder: RunFolder
    screen: Screen
    board: Board
    settings: Mapping[str, Any] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    watch: Progress = field(default_factory=Bars)
    models: dict[str, SparseModel] = field(default_factory=dict)
    tables: dict[str, pd.DataFrame] = field(default_factory=dict)
    figures: dict[str, Captioned] = field(default_factory=dict)
    sections: list[Section] = field(default_factory=list)
    summary: dict[str, Any] = field(default_factory=dict)
    headline: dict[str, float] = field(default_factory=dict)
    result: Result | None = None
    clock: Clock = SECONDS
    messages: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    ends: list[Callable[[], None]] = field(default_factory=list)

    def section(self, title: str, *blocks: Block | str, level: int = 2) -> None:
        """Begin a section of the page, and of the log; level 3 is a part of the one before."""
        self.sections.append(Section(title, [], level))
        self.add(*blocks)

    def add(self, *blocks: Block | str) -> None:
        """Add texts, equations and tables to the section; a table without rows is left out."""
        shown = [Text(each) if isinstance(each, str) else each for each in blocks]
        if blocks and not self.sections:
            self.section("Results")
        for block in shown:
            if not isinstance(block, Table) or len(block.rows):
                self.sections[-1].blocks.append(block)

    def model(
        self,
        name: str,
        model: SparseModel,
        *,
        clock: Clock | None = None,
        held: Constraint | None = None,
        shown: bool = True,
        words: str = "95 %",
        note: str = "",
    ) -> None:
        """Add a model: models/NAME.json, its coefficients, its equations here and in the summary.

        clock: in whose time unit it is shown, by default the model's own. held: what its
        coefficients obey, for equations by process. shown: False leaves it out of the page. words,
        note: on its intervals, see `interval_table`.
        """
        _once("model", name, self.models)
        model.save(self.folder.file(f"{name}.json", "models"))
        self.models[name] = model
        self.summary.setdefault("models", {})[name] = model_facts(model, held)
        if shown:
            clock = clock or model.clock
            self.add(*equations(model, clock, held=held))
            self.add(*interval_table(model, clock, words, note))

    def table(
        self,
        name: str,
        rows: ResultTable[Any] | pd.DataFrame,
        *,
        heading: str = "",
        by_state: bool = False,
        shown: bool | Table = True,
        title: str = "",
        note: str = "",
        bold: Sequence[int] = (),
        page_only: bool = False,
    ) -> None:
        """Add a table: tables/NAME.csv, an entry of the summary, and its place on the page.

        rows: records with their metrics, of which some are in the headline; or the table itself.
        heading, by_state: see `ResultTable.csv`. shown: False leaves it out of screen and page; or
        another form of it for these. title, note, bold, page_only: of the table as it is shown.
        """
        _once("table", name, [*self.tables, *self.summary])
        if isinstance(rows, ResultTable):
            rows = replace(rows, metrics=[metric.on(self.clock) for metric in rows.metrics])
            frame, self.summary[name] = rows.csv(heading, by_state=by_state), rows.json()
            self.headline |= rows.headline()
        else:
            frame, self.summary[name] = rows, json_rows(rows)
        self.samples(name, frame)
        if isinstance(shown, Table):
            self.add(shown)
        elif shown:
            if isinstance(rows, ResultTable):
                seen = rows.screen(heading, by_state=by_state)
            else:
                seen = rows.dropna(axis=1, how="all")  # published values, where there are none
            self.add(Table(seen, title=title, note=note, bold=bold, page_only=page_only))

    def samples(self, name: str, frame: pd.DataFrame) -> None:
        """Add samples, such as those that a figure draws: tables/NAME.csv alone."""
        _once("table", name, self.tables)
        frame = frame.rename(columns={time: self.clock.key(time)[0] for time in TIMES})
        write_text(self.folder.file(f"{name}.csv", "tables"), frame.to_csv(index=False))
        self.tables[name] = frame

    def figure(self, name: str, draw: Callable[[], Figure], caption: str) -> None:
        """Add a figure, figures/NAME.png, which is drawn once all else is written."""
        _once("figure", name, self.figures)
        self.figures[name] = Captioned(draw, caption)
        self.add(Picture(name))

    def found(self, result: Result) -> None:
        """Say what was found."""
        self.result = result

    def say(self, text: str) -> None:
        """Print a message at once, on the screen and in run.log, and repeat it on the page."""
        self.messages.append(text)
        self.screen.print(*renderables(Text(text)))

    def warn(self, text: str) -> None:
        """Print a warning at once, and repeat it on the page and in the summary."""
        self.warnings.append(text)
        self.screen.print(*renderables(Text(text, warning=True)))

    def when_written(self, end: Callable[[], None]) -> None:
        """Do something once all that was found is written, such as removing what is kept."""
        self.ends.append(end)

    def write(self, name: str, writer: Callable[[Path], None]) -> None:
        """Write a file of the study's own into the run folder, complete or not at all."""
        with replacing(self.folder.file(name)) as temporary:
            writer(temporary)

    def finish(
        self, *, purpose: str = "", keys: Collection[str] = (), formats: Sequence[str] = ("png",)
    ) -> None:
        """Draw the figures, write page, summary and TensorBoard, and print what was found.

        purpose: of the experiment, in a sentence. keys: of the settings that it uses. formats: of
        the files of figures, none of which is drawn without one.
        Raises ValueError if the study has not reported what it found.
        """
        if self.result is None:
            raise ValueError(f"a study must say what it found, report.found(...): {self.title}")
        if self.models:
            self.samples("coefficients", coefficients(self.models))
        self.screen.show(self.sections, on_terminal=bool(self.settings.get("verbose")))
        drawn = self._drawn(formats) if formats else {}
        self.board.equations({name: model.text() for name, model in self.models.items()})
        hparams = {"seed": self.seed} | by_places(self.settings, keys)
        self.board.settings(hparams, self.headline)
        about = About(
            purpose=purpose,
            asked=settings_used(self.settings, keys),
            messages=self.messages,
            warnings=self.warnings,
            provenance=self.provenance,
            config=(self.folder.path / "config.yaml").read_text("utf-8"),
        )
        page = page_html(self.title, self.sections, drawn, about, result=self.result)
        write_text(self.folder.file(PAGE), page)
        named = {"experiment": self.title, "seed": self.seed, "found": self.result.title}
        named |= {"warnings": self.warnings} if self.warnings else {}
        found = named | on_clock(self.summary, self.clock) | {"headline": self.headline}
        write_json(self.folder.file("summary.json"), found)
        for end in self.ends:
            end()
        self.screen.conclude(self.result, self.folder.path)

    def _drawn(self, formats: Sequence[str]) -> dict[str, Drawn]:
        """The figures for the page, as they are written."""
        drawn = {}
        for name, captioned in count_pieces(self.watch, self.figures.items(), "figure"):
            figure = captioned.draw()
            png = self.folder.write_figure(name, figure, formats)
            self.board.image(name, png)
            drawn[name] = draw(figure, png, captioned.caption)
        return drawn


def _once(kind: str, name: str, known: Collection[str]) -> None:
    """Raise ValueError if there is one of this name: the first would be overwritten."""
    if name in known:
        raise ValueError(f"every {kind} of a report needs a name of its own, got {name!r} twice")
