"""What back-flow adds to the law of the breathing mode: `python -m benchmarks.back_flow`.

On `thruster=lif`, whose ions flow back to the anode over much of the channel: structures of two
densities, each refined as it is on three quarters of the record of every operating point, and run
freely over the rest. `python -m benchmarks.sustained lif_law_back` has the one that is sustained on
all splits, `lif_zones` and `lif_several` other zones, `python -m benchmarks.linear_criteria lif`
the orders of each process. Prints a table of docs/living.md.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial

from benchmarks.sustained import (
    LAW,
    LAW_BACK,
    LAW_TOLD,
    balances,
    case,
    law,
    line,
    oscillating,
    parts,
    record,
)

IONIZED = LAW.exchange[0]
RETURNS = {f"the law, return by {term}": term for term in ("n_i", "n_i*n_n", "n_i^2")}
STRUCTURES = {
    "the law": LAW,
    **{
        name: replace(LAW, exchange=[IONIZED, ("n_i", "n_n", [term])])
        for name, term in RETURNS.items()
    },
    "stated return and neutrals": LAW_TOLD,
    "and ions out by n_i*n_n": replace(
        LAW_TOLD, outflow={"n_i": ["n_i", "n_i^2", "n_i*n_n"], "n_n": "known"}
    ),
    "and ions out by n_i*n_n^2": LAW_BACK,
    "and ions out by both": replace(
        LAW_BACK, outflow={**LAW_BACK.outflow, "n_i": [*LAW_BACK.outflow["n_i"], "n_i*n_n"]}
    ),
    "by n_i*n_n^2, neutrals free": replace(LAW_BACK, outflow={**LAW_BACK.outflow, "n_n": ["n_n"]}),
    "the same, nothing stated": replace(
        LAW,
        exchange=[IONIZED, ("n_i", "n_n", ["n_i"])],
        outflow={**LAW_BACK.outflow, "n_n": ["n_n"]},
    ),
}


def main() -> None:
    """Print every structure, at all points of the sets that are named, or of `lif`."""
    for name in sys.argv[1:] or ["lif"]:
        wholes = [record(label, name=name) for label in oscillating(name)]
        for words, roles in STRUCTURES.items():
            cases = [
                case(*parts(whole.run, "last"), whole, seed=0, search=partial(law, roles=roles))
                for whole in wholes
            ]
            print(line(words, cases), flush=True)
            print(balances(cases), flush=True)


if __name__ == "__main__":
    main()
