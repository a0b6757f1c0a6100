"""The study protocol: what an experiment is, from its settings to what people read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import pandas as pd

from ep2sindy.model.model import SparseModel
from ep2sindy.report.document import Captioned, Section
from ep2sindy.report.run import Run


@runtime_checkable
class Outcome(Protocol):
    """All that a study leaves. The runner writes it: models and tables first, then the views.

    figures: by name, drawn when they are written. sections: what the terminal and the page show.
    summary: the findings, for `summary.json`; experiment and seed are added to it. headline: the
    few numbers by which runs are compared, in TensorBoard and in the index of a sweep; their
    names do not depend on what was found.
    """

    def models(self) -> Mapping[str, SparseModel]: ...

    def tables(self) -> Mapping[str, pd.DataFrame]: ...

    def figures(self) -> Mapping[str, Captioned]: ...

    def sections(self) -> Sequence[Section]: ...

    def summary(self) -> dict[str, Any]: ...

    def headline(self) -> Mapping[str, float]: ...


@runtime_checkable
class Experiment(Protocol):
    """A frozen dataclass whose fields are the keys of the config that it takes.

    A field of type AnyMethod or Source stands for the groups that it is made of: formulation,
    search, ...; data, prepare, trajectory. Everything but the data is built before
    `compute` is called, so that a misspelt key costs no simulation.
    """

    def compute(self, run: Run) -> Outcome: ...
