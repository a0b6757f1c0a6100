"""Models of a driven discharge: `python -m benchmarks.driven`.

The supply's voltage is modulated by 5 % at half and at twice the breathing frequency. The search
is given both records, averaged over the channel, with the voltage as an input and without. Each
quarter of the records is held out in turn, and the model of the others follows it from its first
sample.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import ep2sindy as ep
from ep2sindy.forecasting.evaluation import evaluate

POINT = ep.thruster.OPERATING_POINTS[3]  # 300 V, 5 mg/s
BREATHING_HZ = 19.15e3
SHARE = 0.05
N_PARTS = 4
STATES = ("n_i", "n_n")


def driven(frequency_Hz: float, *, duration_s: float = 6e-3) -> ep.Trajectory:
    """Channel averages of a discharge whose voltage is modulated, the voltage as an input."""
    supply = ep.thruster.ModulatedVoltage(SHARE, frequency_Hz)
    thruster, point = ep.thruster.Thruster(), replace(POINT, supply=supply)
    field = ep.thruster.simulate(thruster, point, duration_s=duration_s, cache=True, progress=False)
    inside = field.sel(z=slice(0.0, thruster.channel_length))
    weight = inside["dz"] / inside["dz"].sum()
    states = [(inside[name] * weight).sum("z").values.astype(float) for name in STATES]
    voltage = field["V_supply"].values[:, None]
    return ep.Trajectory(field["time"].values, np.column_stack(states), STATES, voltage, ["V"])


def without(run: ep.Trajectory, quarter: int) -> tuple[list[ep.Trajectory], ep.Trajectory]:
    """The parts of a record before and after one of its quarters, and that quarter."""
    edges = [run.n_samples * k // N_PARTS for k in range(N_PARTS + 1)]
    begin, end = edges[quarter : quarter + 2]
    parts = [(0, begin), (end, run.n_samples)]
    return [run.window(a, b) for a, b in parts if a < b], run.window(begin, end)


def main() -> None:
    runs = {text: driven(factor * BREATHING_HZ) for text, factor in (("half", 0.5), ("twice", 2.0))}
    for variables in ((*STATES, "V"), STATES):
        for quarter in range(N_PARTS):
            parts = {text: without(run, quarter) for text, run in runs.items()}
            fitted = [part for kept, _ in parts.values() for part in kept]
            library = ep.polynomial(list(variables), degree=2)
            model = ep.discover(fitted, library, seed=0).model
            print(f"{', '.join(variables)}, quarter {quarter + 1} held out:")
            for text, (_, held) in parts.items():
                found = evaluate(model, held)
                print(
                    f"  {text} the breathing frequency: {found.text}, nrmse {found.nrmse:.3f}, "
                    f"frequency {100.0 * found.f_error:+.2f} %, amplitude of n_i "
                    f"{found.amplitude_ratio['n_i']:.3f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
