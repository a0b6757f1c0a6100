"""Numerical and recording settings of a run of the axial model."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, is_dataclass
from typing import Any

import numpy as np

from ep2sindy.thruster.axial.model import CFL
from ep2sindy.thruster.checks import check_not_negative, check_positive, check_range
from ep2sindy.trust.memory import check_memory

MIN_STEPS = 16  # fewer samples cannot show an oscillation


@dataclass(frozen=True)
class Settings:
    """Numerical and recording settings of a run; see `simulate`."""

    duration_s: float = 18e-3
    warm_up_s: float = 2e-3
    sample_s: float = 1.5e-6
    averaged: bool = True
    n_cells: int = 100
    stretch: float = 2.0
    reconstruct: bool = True
    cfl: float = CFL
    coldest_T_e_eV: float = 0.0

    def __post_init__(self) -> None:
        """Raise ValueError if a run could not start or could not be sampled."""
        check_positive(self, "sample_s")
        check_not_negative(self, "warm_up_s", "coldest_T_e_eV")
        if not (np.isfinite(self.duration_s) and self.duration_s >= MIN_STEPS * self.sample_s):
            raise ValueError(
                f"duration_s must hold at least {MIN_STEPS} sampling steps of "
                f"{self.sample_s!r} s, got {self.duration_s!r} s"
            )
        n_samples = self.duration_s / self.sample_s
        check_memory(
            32.0 * self.n_cells * (n_samples + MIN_STEPS),  # at least four profiles
            f"duration_s / sample_s = {n_samples:.3g} samples of n_cells = {self.n_cells}",
            hint="simulate less of each",
        )
        check_range(self, "above 0 and at most 1", lambda value: 0.0 < value <= 1.0, "cfl")


def to_json(parameters: dict[str, Any]) -> str:
    """Nested dataclasses as JSON with sorted keys; each holds the name of its class."""

    def plain(value: Any) -> Any:
        if is_dataclass(value) and not isinstance(value, type):
            members = {name: plain(getattr(value, name)) for name in asdict(value)}
            return {"class": type(value).__name__, **members}
        if isinstance(value, dict):
            return {name: plain(member) for name, member in value.items()}
        if callable(value):  # a user's; what holds it has a hash of its source besides
            return f"{value.__module__}.{value.__qualname__}"
        return [plain(each) for each in value] if isinstance(value, tuple) else value

    return json.dumps(plain(parameters), sort_keys=True)
