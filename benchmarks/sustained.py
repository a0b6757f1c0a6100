"""Models selected by free run on the package's own source: `python -m benchmarks.sustained`.

Equations that conserve what ions and neutrals of the whole channel exchange, as `+exp=breathing`
finds them: over operating points, splits of the record and seeds, on the default source, on the
former one, and on `thruster=lif`, whose ions flow back (`lif_law`, `lif_law_back`, and with 200
cells `lif_law_back_fine`); in two zones at once (`several`), in noise, and from the (z, r)
simulator. Every model called self-sustained is run again by another solver, ten times as long; its
processes are compared with the balance of the zone. `growth`: how far equal models of one record
differ where they rest. Prints the tables of docs/living.md, or those that are named.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from dataclasses import field as field_of
from functools import cache, partial
from itertools import product

import numpy as np
import xarray as xr
from scipy.integrate import solve_ivp

import ep2sindy as ep
from benchmarks.source import measured_sets, named_set
from ep2sindy.data.zones import ZoneAverage, side_by_side
from ep2sindy.library.relations import Constraint
from ep2sindy.model.fixed_point import RestPoint
from ep2sindy.regression.searches import Search
from ep2sindy.studies.processes import ComparedProcess, Zones, compared_processes, fit_roles
from ep2sindy.studies.sustained import start_of

POINTS = {point.label: point for point in ep.thruster.OPERATING_POINTS}
CHANNEL, DOWNSTREAM = "channel", "downstream"
SPLITS = {"last": (0.0, 0.75), "first": (0.25, 1.0), "second half": (0.0, 0.5)}  # what is fitted
DRAWS = [(split, seed) for split in SPLITS for seed in range(3)] + [("last", 3)]
ONCE = [(split, 0) for split in SPLITS]
NOISES = ((0.2, 6.0), (0.4, 50.0))  # fraction of each state's RMS, periods
N_NOISE_DRAWS = 3
LONGER = 10.0  # times the held-out part, for the other solver
STATES = ("n_i", "n_n")

FORMER = named_set("pulses")  # the source until version 0.2: sharp pulses
FORMER_SPEED = {"300V_2mgs": 190.0}  # m/s; 280 at the other points
MASS_ACTION = ep.Roles(
    exchange=[("n_n", "n_i")], outflow=STATES, inflow={"n_n": "known or free"}, nonnegative=True
)
# One structure for every point: every term a process, five free coefficients. Nothing but the mass
# flow is known of the law; of the other one, what leaves as neutrals and comes back, too.
LAW = replace(
    MASS_ACTION,
    exchange=[("n_n", "n_i", ["n_i^2*n_n", "n_i*n_n^2"])],
    outflow={"n_i": ["n_i", "n_i^2"], "n_n": ["n_n"]},
)
LAW_STATED = replace(
    LAW,
    exchange=[("n_n", "n_i", ["n_i*n_n", "n_i^2*n_n", "n_i*n_n^2"]), ("n_i", "n_n", "known")],
    outflow={"n_i": ["n_i", "n_i^2"], "n_n": "known"},
)
# Where ions flow back, those that leave go with the neutrals, too.
LAW_BACK = replace(LAW_STATED, outflow={"n_i": ["n_i", "n_i^2", "n_i*n_n^2"], "n_n": "known"})
LIF, LIF_SPEED = measured_sets()["lif"]
SETS = {"default": ep.thruster.Thruster(), "former": FORMER, "lif": LIF, "lif_fine": LIF}
N_CELLS = {"lif_fine": 200}  # at 200 V, 100 cells are too few for cycles of lif that repeat


@dataclass(frozen=True)
class Record:
    """Averages over zones, the balance of each, and their lengths if there are several.

    balances: by zone; a single one is called "".
    """

    run: ep.Trajectory
    balances: dict[str, xr.Dataset]
    sizes: dict[str, float] = field_of(default_factory=dict)

    def processes(self, model: ep.SparseModel, held: Constraint | None) -> list[ComparedProcess]:
        """What zones exchange, in the record and by a model; nothing if its terms are free."""
        if held is None or not held.processes:
            return []
        return compared_processes(model, held, self.run, Zones(self.balances, self.sizes))


@dataclass(frozen=True)
class Case:
    """One selection: the model on held-out time, what it cost, and what another solver says.

    fraction: of starts around the cycle that reach it. processes: name -> ratio to the record and
    R2.
    """

    run: ep.model.Evaluation
    n_free: int
    multiplier: float
    fraction: float
    cpu_s: float
    confirmed: bool
    processes: dict[str, tuple[float, float]]

    @property
    def structure(self) -> str:
        """Terms of every equation."""
        model = self.run.model
        return "; ".join(f"{state}': {', '.join(model.terms(state))}" for state in model.states)

    @property
    def amplitude(self) -> float:
        """Of the state that is farthest off, less one."""
        ratios = np.array(list(self.run.amplitude_ratio.values()))
        return float(np.abs(ratios - 1.0).max())

    @property
    def waveform(self) -> float:
        return max(self.run.waveform_error.values())


@cache
def field(label: str, name: str = "default") -> xr.Dataset:
    """The simulation of one operating point by one set of parameters."""
    point = POINTS[label]
    if name == "former":
        point = replace(point, neutral_speed=FORMER_SPEED.get(label, 280.0))
    if SETS[name] is LIF:
        point = replace(point, neutral_speed=LIF_SPEED)
    n_cells = N_CELLS.get(name, 100)
    return ep.thruster.simulate(SETS[name], point, n_cells=n_cells, cache=True, progress=False)


def oscillating(name: str) -> list[str]:
    """The operating points at which a set oscillates."""
    steady = [label for label in POINTS if field(label, name).attrs["status"] == "steady"]
    if steady:
        print(f"steady: {', '.join(steady)}")
    return [label for label in POINTS if label not in steady]


@cache
def record(label: str, z: str | tuple[float, float] = CHANNEL, name: str = "default") -> Record:
    """Zone averages of a simulation."""
    zone = ep.Zone(z=z)
    run = ep.zone_average(field(label, name), zone, states=STATES, label=label)
    return Record(run, {"": ep.thruster.zone_balance(field(label, name), zone)})


@cache
def zones_record(label: str, n_zones: int, name: str = "default") -> Record:
    """Averages over zones of equal length that make up the channel."""
    run = field(label, name)
    edges = np.linspace(0.0, ep.thruster.Thruster().channel_length, n_zones + 1)
    zones = {f"z{k + 1}": tuple(edges[k : k + 2]) for k in range(n_zones)}
    settings = ZoneAverage(STATES, zones=zones)
    parts = side_by_side(zones, run)
    return Record(
        settings.trajectory(run, inputs=[], label=label),
        {name: ep.thruster.zone_balance(run, zone) for name, zone in parts.items()},
        settings.sizes(run),
    )


def conserving(fitted: ep.Trajectory, whole: Record, *, seed: int) -> ep.Discovery:
    """Under the roles of `+exp=breathing`: up to six free coefficients of degree 3."""
    return under(MASS_ACTION, fitted, whole, seed=seed)


class AllTerms:
    """A search that proposes all terms."""

    def supports(self, xx: np.ndarray, xy: np.ndarray, yy: float) -> np.ndarray:
        return np.ones((1, len(xy)), dtype=np.bool_)


def law(fitted: ep.Trajectory, whole: Record, *, seed: int, roles: ep.Roles = LAW) -> ep.Discovery:
    """The terms that roles name, with nothing selected."""
    return under(roles, fitted, whole, seed=seed, search=AllTerms())


def under(
    roles: ep.Roles,
    fitted: ep.Trajectory,
    whole: Record,
    *,
    seed: int,
    search: Search | None = None,
) -> ep.Discovery:
    """A search over the whole channel under roles, whose known parts are those of the record."""
    method = ep.Regression(
        ep.Differential(),
        search or ep.BestSubset(max_terms=6, n_best=2000),
        ep.FreeRunScore(seed=seed, window_periods=4.0, n_confirmed=16),
        depth=16,
    )
    roles = roles.with_known(known_of(fitted, whole))
    library = ep.polynomial(STATES, degree=3).with_roles(roles)
    return ep.discover([fitted], library, method, seed=seed)


def known_of(fitted: ep.Trajectory, whole: Record) -> dict[str, dict[str, float]]:
    """What the record tells of the roles of a zone, by least squares over what is fitted."""
    found = fit_roles(whole.balances, fitted)
    return {name: dict(role.terms) for name, role in found.items()}


def by_neighbourhood(fitted: ep.Trajectory, whole: Record, *, seed: int) -> ep.Discovery:
    """Two zones under the roles of `+exp=zones`: up to 14 free coefficients."""
    roles = ep.Roles(exchange=[("n_n", "n_i")], outflow=STATES, inflow={"n_n": "known"})
    roles = roles.in_zones(whole.sizes).with_known(known_of(fitted, whole))
    library = ep.polynomial(fitted.state_names, degree=3).with_roles(roles)
    method = ep.Regression(
        ep.Differential(),
        ep.BestSubset(max_terms=14, n_best=200),
        ep.FreeRunScore(seed=seed, window_periods=8.0),
        depth=6,
    )
    return ep.discover([fitted], library, method, seed=seed)


def free(fitted: ep.Trajectory, whole: Record, *, seed: int) -> ep.Discovery:
    """Every term free in its own equation, degree 2, up to 4 + 4 terms."""
    method = ep.Regression(
        ep.Differential(),
        ep.BestSubset(max_terms=4, n_best=2),
        ep.FreeRunScore(seed=seed),
        depth=2,
    )
    return ep.discover([fitted], ep.polynomial(STATES, degree=2), method, seed=seed)


NOISY = ((CHANNEL, conserving), (DOWNSTREAM, free))  # zones and searches of the table of noise


def case(
    fitted: ep.Trajectory,
    assessed: ep.Trajectory,
    whole: Record,
    *,
    seed: int,
    search: Callable[..., ep.Discovery] = conserving,
) -> Case:
    """Select on one record, run freely over another from its first sample."""
    begun = time.process_time()
    found = search(fitted, whole, seed=seed)
    cpu_s, model = time.process_time() - begun, found.model
    run = ep.evaluate(model, assessed, initial=start_of(assessed, model))
    multiplier = fraction = float("nan")
    if run.holds and (cycle := run.cycle) is not None:
        multiplier = float(np.abs(cycle.multipliers[1:]).max())
        fraction = ep.model.basin_stability(model, cycle)
    confirmed = not run.holds or lives_on(model, assessed)
    held = found.constraint
    n_free = int(np.count_nonzero(model.coef)) if held is None else len(held.free)
    processes = {p.name: (p.ratio, p.r2) for p in whole.processes(model, held)}
    return Case(run, n_free, multiplier, fraction, cpu_s, confirmed, processes)


def lives_on(model: ep.SparseModel, run: ep.Trajectory) -> bool:
    """Whether LSODA with tight tolerances keeps the amplitudes, ten times as long, to 20 %."""
    std, start = run.states.std(axis=0), start_of(run, model)
    length_s = LONGER * float(run.t[-1] - run.t[0])
    t = np.linspace(0.9 * length_s, length_s, 4000)

    def slope(_: float, y: np.ndarray) -> np.ndarray:
        return model.predict(y * std) / std

    path = solve_ivp(
        slope, (0.0, length_s), start / std, method="LSODA", t_eval=t, rtol=1e-9, atol=1e-10
    )
    if not path.success or path.y.shape[1] < len(t):
        return False
    return bool((np.abs(path.y.std(axis=1) - 1.0) < 0.2).all())


def parts(run: ep.Trajectory, split: str) -> tuple[ep.Trajectory, ep.Trajectory]:
    """What is fitted, and the rest."""
    first, last = (round(fraction * run.n_samples) for fraction in SPLITS[split])
    held = (last, run.n_samples) if first == 0 else (0, first)
    return run.window(first, last), run.window(*held)


def line(name: str, cases: Sequence[Case]) -> str:
    """How many live, and the median and the worst of each figure of those that have it."""
    sustained = [each for each in cases if each.run.holds]
    wrong = sum(not each.confirmed for each in cases)
    if not sustained:
        return f"{name:24s} 0 of {len(cases)} live: {[c.run.text for c in cases][:3]}"
    figures = (
        (100.0 * abs(c.run.f_error), 100.0 * c.amplitude, c.waveform, c.n_free, c.multiplier)
        for c in sustained
    )
    f, amplitude, waveform, n_free, multiplier = (
        f"{np.nanmedian(v):.3g} / {np.nanmax(v):.3g}" for v in zip(*figures, strict=True)
    )
    fractions = [c.fraction for c in sustained]
    cpu_s = np.median([c.cpu_s for c in cases])
    lost = Counter(each.run.text for each in cases if not each.run.holds)
    return (
        f"{name:24s} {len(sustained)} of {len(cases)} live ({wrong} refuted); f {f} %; amplitude "
        f"{amplitude} %; waveform {waveform}; free coefficients {n_free}; multiplier {multiplier}; "
        f"starts that reach it {np.nanmin(fractions):.2f} to {np.nanmax(fractions):.2f}; "
        f"{cpu_s:.1f} CPU-s{f'; {dict(lost)}' if lost else ''}"
    )


def balances(cases: Sequence[Case]) -> str:
    """For every process, the ratio to the record and R2: medians over the cases."""
    sustained = [each.processes for each in cases]
    names = dict.fromkeys(name for each in sustained for name in each)
    rows = []
    for name in names:
        ratios, scores = np.transpose([each[name] for each in sustained if name in each])
        text = f"ratio {np.median(ratios):.2f} ({ratios.min():.2f} to {ratios.max():.2f})"
        score = "" if np.isnan(scores).all() else f", R2 {np.median(scores):.3f}"
        rows.append(f"    {name}: {text}{score}")
    return "\n".join(rows)


def structures(cases: Sequence[Case]) -> str:
    found = Counter(each.structure for each in cases)
    return "\n".join(f"    {n} x {terms}" for terms, n in found.most_common())


def print_points(name: str = "default", draws: Sequence[tuple[str, int]] = DRAWS) -> None:
    """Six operating points, the whole channel."""
    print(f"\n{name} source, whole channel: median / worst of {len(draws)} draws")
    print_cases([record(label, CHANNEL, name) for label in oscillating(name)], draws, conserving)


def print_cases(
    wholes: Sequence[Record], draws: Sequence[tuple[str, int]], search: Callable[..., ep.Discovery]
) -> None:
    """Every point, and all of them."""
    everything = []
    for whole in wholes:
        cases = [case(*parts(whole.run, s), whole, seed=seed, search=search) for s, seed in draws]
        everything += cases
        words = line(whole.run.label, cases)
        print("\n".join([words, balances(cases), structures(cases)]), flush=True)
    print(line("all", everything))


def print_law(roles: ep.Roles, name: str = "default") -> None:
    """Six operating points, terms that are given: the worst of three splits, and coefficients."""
    print(f"\n{roles.exchange}, {roles.outflow}; coefficients over the record's: medians of splits")
    search = partial(law, roles=roles)
    for label in oscillating(name):
        whole, ratios, cases = record(label, CHANNEL, name), [], []
        for split, seed in ONCE:
            cases.append(case(*parts(whole.run, split), whole, seed=seed, search=search))
            found = search(parts(whole.run, split)[0], whole, seed=seed)
            compared = whole.processes(found.model, found.constraint)
            ratios.append([p.coef[term] / p.counterpart[term] for p in compared for term in p.coef])
        medians = ", ".join(f"{ratio:.2f}" for ratio in np.median(ratios, axis=0))
        print("\n".join([line(label, cases), balances(cases), f"    {medians}"]), flush=True)
        for each in (c for c in cases if not c.run.holds):
            off = f"f {each.run.f_error:+.2%}, amplitude {each.amplitude:.1%}"
            print(f"    {each.run.text}: {off}, waveform {each.waveform:.3f}")


def models_of_its_size(whole: Record) -> list[ep.model.Evaluation]:
    """Free runs of every sustained model that has as many free coefficients as the selected one.

    The others are refined as the selected one is, on the first three quarters of the record.
    """
    fitted, assessed = parts(whole.run, "last")
    found = conserving(fitted, whole, seed=0)
    models = [found.model]
    for other in found.others:
        exchange, outflow = [], {}
        for role, terms in other.terms.items():
            giver, _, taker = role.partition(" to ")
            if taker:
                exchange.append((giver, taker, list(terms)))
            else:
                outflow[giver.removesuffix(" out")] = list(terms)
        roles = replace(MASS_ACTION, exchange=exchange, outflow=outflow)
        models.append(law(fitted, whole, seed=0, roles=roles).model)
    runs = [ep.evaluate(each, assessed, initial=start_of(assessed, each)) for each in models]
    return [run for run in runs if run.holds]


def rest_of(run: ep.model.Evaluation) -> RestPoint | None:
    """The rest point of a model where neither density is zero."""
    return next((rest for rest in run.rest_points if (rest.state > 0.0).all()), None)


def print_growth() -> None:
    """Six operating points: where the models of one size rest, and what they say of growth."""
    print("\nsustained models of the selected one's size: growth and frequency where they rest")
    for label in POINTS:
        rests = [rest_of(run) for run in models_of_its_size(record(label))]
        growth, f_kHz = np.transpose(
            [(rest.growth_per_s, 1e-3 * rest.frequency_Hz) for rest in rests if rest is not None]
        )
        print(
            f"{label}: {len(growth)} of {len(rests)} rest; growth {growth.min():.0f} to "
            f"{growth.max():.0f} 1/s, small oscillation {f_kHz.min():.1f} to {f_kHz.max():.1f} kHz",
            flush=True,
        )


def print_several(draws: Sequence[tuple[str, int]], name: str = "default") -> None:
    """Six operating points, the channel cut into two zones of equal length."""
    print(f"\n{name} source, two zones: median / worst of {len(draws)} draws")
    wholes = [zones_record(label, 2, name) for label in oscillating(name)]
    print_cases(wholes, draws, by_neighbourhood)


def noisy(run: ep.Trajectory, fraction: float, n_periods: float, *, seed: int) -> ep.Trajectory:
    """The first periods of a record with white noise, a fraction of each state's RMS."""
    cycle = ep.signals.find_cycle(run.t, run.states)
    assert cycle is not None
    n = round(n_periods / (cycle.frequency_Hz * run.dt_s)) + 1
    rms = np.sqrt(np.square(run.states).mean(axis=0))
    noise = np.random.default_rng(seed).normal(size=(n, run.states.shape[1])) * fraction * rms
    return ep.Trajectory(
        t=run.t[:n], states=run.states[:n] + noise, state_names=run.state_names,
        units=run.units, label=run.label,
    )  # fmt: skip


def print_noise() -> None:
    """White noise on both densities, the mean cycle searched; assessed on the clean record."""
    for (fraction, n_periods), (z, search) in product(NOISES, NOISY):
        words = f"{100 * fraction:.0f} % noise, {n_periods:.0f} periods, {z}, {search.__name__}"
        print(f"\n{words}: {N_NOISE_DRAWS} draws; noise in standard deviations of n_n")
        for label in POINTS:
            whole = record(label, z)
            clean = whole.run.window(round(0.75 * whole.run.n_samples), whole.run.n_samples)
            cases = [
                case(
                    ep.signals.mean_cycle(noisy(whole.run, fraction, n_periods, seed=k)),
                    clean, whole, seed=k, search=search,
                )
                for k in range(N_NOISE_DRAWS)
            ]  # fmt: skip
            n_n = whole.run.states[:, 1]
            spread = fraction * np.sqrt(np.square(n_n).mean()) / n_n.std()
            print(line(f"{label}, {spread:.1f} std", cases), flush=True)


def print_plane() -> None:
    """The (z, r) simulator: averages over the channel's volume, and their balance."""
    print("\n(z, r) simulator, whole channel, by what is held out; ends of free runs if not alive")
    run = ep.thruster.simulate_2d(duration_s=12e-3, cache=True, progress=False)
    zone = ep.Zone(z=CHANNEL)
    whole = Record(
        ep.zone_average(run, zone, states=STATES, label="plane"),
        {"": ep.thruster.zone_balance(run, zone)},
    )
    for split, seed in ONCE:
        cases = [case(*parts(whole.run, split), whole, seed=seed)]
        print("\n".join([line(split, cases), balances(cases), structures(cases)]), flush=True)


def main() -> None:
    """Print every table, or those that are named."""
    tables: dict[str, Callable[[], None]] = {
        "points": print_points,
        "law": lambda: print_law(LAW),
        "law_stated": lambda: print_law(LAW_STATED),
        "growth": print_growth,
        "former": lambda: print_points("former", ONCE),
        "lif_law": lambda: print_law(LAW, "lif"),
        "lif_law_back": lambda: print_law(LAW_BACK, "lif"),
        "lif_law_back_fine": lambda: print_law(LAW_BACK, "lif_fine"),
        "lif_several": lambda: print_several([("last", 0)], "lif"),
        "several": lambda: print_several(ONCE),
        "noise": print_noise,
        "plane": print_plane,
    }
    for name in sys.argv[1:] or tables:
        tables[name]()


if __name__ == "__main__":
    main()
