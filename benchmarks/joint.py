"""Right supports by joint search and at single points, on a family of known systems.

    python -m benchmarks.joint
    python -m benchmarks.joint 20      # realizations per noise level

Prints, per noise level, the percentage of realizations in which the supports of all equations are
right, and the errors of the coefficients, free and tied by the law.
"""

import sys
import time

import pandas as pd

from ep2sindy.errors_in_variables import WeightedWeak
from ep2sindy.parallel import Loky
from ep2sindy.regression import RandomSplit
from ep2sindy.search import BestSubset
from ep2sindy.selection import EBIC
from ep2sindy.studies.joint_family import Method, rates, run_family
from ep2sindy.weak import Weak
from ep2sindy.windows import Bumps

NOISES = (0.0, 0.05, 0.1)
# The same for joint search and single points. A tenth of a record: the automatic width can leave
# fewer windows than terms in a record this short. Five candidates of each size: the rows are
# weighted under the whole library, where a wrong support can lead its size by a hair; the
# criterion weighs them again under the candidate.
METHOD = Method(
    WeightedWeak(Weak(test_functions=Bumps(half_width_s=1.5), split=RandomSplit(0.0))),
    BestSubset(n_best=5),
    EBIC(),
    depth=5,
)


def main() -> None:
    n_realizations = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    start = time.perf_counter()
    outcomes = run_family(METHOD, noises=NOISES, n_realizations=n_realizations, workers=Loky())
    errors = outcomes.groupby("noise")[["error_free", "error_tied"]].median()
    calm = outcomes.groupby("noise")["p_value"].agg(lambda p: (p > 0.05 / 2).mean())
    with pd.option_context(
        "display.width", 120, "display.max_columns", 20, "display.float_format", "{:.4g}".format
    ):
        print(f"right supports, % of {n_realizations} realizations")
        print(rates(outcomes))
        print("median relative error of the coefficients where the joint support is right")
        print(errors.assign(law_not_rejected=calm))
    print(f"{time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
