"""The noise that a fit leaves: its size, its correlation, and whether the model explains it.

Remarks are sentences on where samples and noise deviate from what the estimation assumes of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations_with_replacement, islice

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.estimation.likelihood import TrajectoryFit, fit_paths, innovations, observe
from ep2sindy.estimation.problem import BySample, ByState, EstimationProblem, StateMask
from ep2sindy.runtime.screen import joined

# A record in pieces of different lengths, by sample and state.
Pieces = Sequence[Float[np.ndarray, "_ d"]]
OtherPieces = Sequence[Float[np.ndarray, "_ _"]]  # of other states than those that are assessed

FLOOR = 1e-3  # least noise, as a fraction of the RMS: no model and no integration is exact
SIGNIFICANT = 3.5  # standard errors of an autocorrelation
MAX_LASTING = 0.98
SLOW, LARGE = 0.9, 0.3  # autocorrelation, and fraction of the spread, that no noise has together
ALIKE = 7.0  # tolerance of the log mean square of differences, which scatters by 2.15/sqrt(n)
LONGER = 6.0  # tolerance of autocorrelations, which scatter by up to 1.7/sqrt(n)
NOISE_FRACTIONS = 2.0 ** np.arange(-6.0, 1.1, 0.25)  # of the residuals' RMS, tried for limits
LAGS = (2, 3, 4, 5, 6)
CHANCE = 1e-5  # that noise holds a line as clean as one that is called the model's error
# A state that lasts about its rest has a law: x' = -k x under process noise is AR(1), too. So what
# is left of one that a model leaves at rest must be white, to a level of one record in 200: nobody
# measures what does not move. A path that explains less of the samples' variance leaves it there.
CHANCE_AT_REST, EXPLAINS = 5e-3, 0.1
# Samples before, from which the next is foretold: a turn shows in two of them, also in few samples.
BEFORE = (1, 2)
# Degrees above the library's, and number, of the products of states that residuals are compared
# with; and standard errors by which these may explain more of random residuals than their number.
MORE_DEGREES, MAX_POWERS, FOLLOWS = 2, 60, 6.0
TINY = float(np.finfo(np.float64).tiny)
# Of growing variance, tried in turn.
FRACTIONS = (0.1, 0.3, 0.5, 0.7, 0.9, 0.97, 0.99, 0.999, 0.9999)
GROWTH_SHOWS = 12.0  # least gain in 2 log likelihood for noise that grows
OUTLYING = 5.0  # standard deviations
ORDER = 3  # of differences, which remove most of a signal that the samples resolve
MODEL_ERRORS = (1e-3, 1e-2, 0.03, 0.1, 0.3)  # of the flow, as fractions of the noise
# Prior, worth this many samples: the noise is alike in all states. Without it, for few samples,
# the likeliest model follows one state exactly and ignores another.
ALIKE_SAMPLES = 5.0
HEAVY, STANDARD_ERRORS = 4.0, 5.0  # least kurtosis reported; least excess over 3
COLLINEAR = 5.0  # standard errors by which a variance may exceed that of noise
PART = 0.05  # fraction of the largest part: states with less are left out of a relation
ERROR_SHOWS = 2.0  # least gain in 2 log likelihood for a flow with error


@dataclass(frozen=True, eq=False)
class Noise:
    """Statistics of the residuals of a fit.

    std: (d,), RMS over all samples, scaled, no lower than the floor. shape: (samples, d), relative
    size of the noise at each sample in units of std: one, or growing with the state. memory: (d,),
    correlation from one sample to the next if the noise is correlated in time, else 0. unexplained:
    (d,), the same correlation if the samples themselves do not show such noise: then it is the
    model's error. patterned: (d,), True if the residuals hold a clean line or are a function of the
    states, which is the model's error too. growth: (d,), fraction of the
    variance that grows with the state. kurtosis: (d,), 3 for normal noise, NaN if all samples are
    limits. outliers: (d,), number of samples off by more than five standard deviations, estimated
    from the median. deviance: -2 log likelihood of the residuals.
    """

    std: ByState
    shape: BySample
    memory: ByState
    unexplained: ByState
    patterned: StateMask
    growth: ByState
    kurtosis: ByState
    outliers: Int[np.ndarray, " d"]
    deviance: float

    @property
    def is_error(self) -> StateMask:
        """Mask of the states whose residuals are the model's error rather than noise."""
        return (self.unexplained > 0.0) | self.patterned

    @property
    def white(self) -> BySample:
        """Standard deviations at all samples."""
        least = np.minimum(self.std, FLOOR)  # a hidden state may be smaller
        return np.maximum(self.std * self.shape, least)

    @property
    def effective(self) -> BySample:
        """Standard deviations of white noise that tells equally little about slow signals."""
        return self.white / np.sqrt(self.independent)

    @property
    def independent(self) -> ByState:
        """Effective fraction of independent samples."""
        return (1.0 - self.memory) / (1.0 + self.memory)


def noise_beside(fit: TrajectoryFit) -> Noise:
    """Size, shape and memory of the residuals of a fit; the memory is that of an AR(1) process."""
    problem, record = fit.problem, fit.problem.all_records
    hidden, limited = ~problem.measured, problem.limited
    left = np.where(record.missing, 0.0, record.samples - fit.path)
    n = np.where(hidden, problem.n_samples, problem.n_measured)
    per_state = fit.support.sum() / len(problem.states) + len(problem.records)
    freedom = np.sqrt(n / np.maximum(n - per_state, 1.0))
    std = freedom * np.sqrt(np.square(left).sum(axis=0) / n)
    # How freely hidden states may leave the flow: as others do, however small they have become.
    sizes = np.sqrt(np.mean([np.square(path).mean(axis=0) for path in fit.paths], axis=0))
    std[hidden] = std[~hidden].mean() * sizes[hidden]
    shape, growth = _shape(problem, fit.path, left)
    # The shape is determined by values at all samples.
    untold = limited | hidden | (n < problem.n_samples)
    shape, growth = np.where(untold, 1.0, shape), np.where(untold, 0.0, growth)
    if limited.any():
        likely, between = _likeliest_std(fit, std)
        std = np.where(limited, freedom * likely, std)
        left = _expected_residuals(fit, std)
    unit = problem.split(left / shape)
    memory = _memory(unit)
    shows = (memory > SIGNIFICANT / np.sqrt(n)) & (std > FLOOR)
    new = [np.concatenate([e[:1], e[1:] - memory * e[:-1]]) for e in unit]
    times = [each.times for each in problem.records]
    patterned = _hold_line(times, new, CHANCE) | _follow_states(fit, new) | _moves(fit, times, left)
    patterned &= std > FLOOR
    samples, off = (problem.split(each) for each in (record.values, record.values - fit.path))
    # Slow residuals of a signal's size tell that the model ignores the signal.
    ignored = (memory > SLOW) & (std > LARGE * record.samples.std(axis=0))
    shown = _shown_by_samples(samples, off, std, memory, float(problem.n_samples))
    lasts = _forgets_as_noise(unit, memory, float(problem.n_samples)) & shown
    believed = shows & lasts & ~ignored & ~patterned
    std = np.maximum(std, np.where(hidden, 0.0, FLOOR))
    lasting = np.where(believed, memory, 0.0)
    alike = np.square(std) + ALIKE_SAMPLES / n * np.square(std[~hidden]).mean()
    logs = n * np.log(alike) + np.log(np.square(shape)).sum(axis=0)
    if limited.any():
        logs = np.where(limited, between, logs)
    kurtosis, outliers = _tails(problem, new)
    return Noise(
        std=std,
        shape=shape,
        memory=lasting,
        unexplained=np.where(shows & ~believed, memory, 0.0),
        patterned=patterned,
        growth=growth,
        kurtosis=kurtosis,
        outliers=outliers,
        deviance=float((logs + n * np.log1p(-np.square(lasting)))[~hidden].sum()),
    )


def _moves(
    fit: TrajectoryFit, times: Sequence[Float[np.ndarray, " _"]], left: BySample
) -> StateMask:
    """True for measured states that a path leaves at rest, or drifting, though they are not white.

    The path says next to no more of them than a steady drift does.
    """
    problem, record = fit.problem, fit.problem.all_records
    line = np.column_stack([np.ones(len(left)), record.times])
    beside_line = record.samples - line @ np.linalg.lstsq(line, record.samples, rcond=None)[0]
    squares = np.square(beside_line).sum(axis=0)
    rests: StateMask = np.square(left).sum(axis=0) > (1.0 - EXPLAINS) * squares
    samples = problem.split(record.samples[:, problem.measured])
    return rests & problem.measured & ~are_white(times, samples, problem.split(left))


def are_white(
    times: Sequence[Float[np.ndarray, " _"]], samples: OtherPieces, left: Pieces
) -> StateMask:
    """True for states of which what a model leaves is white; false for one in a hundred that is.

    It holds no line, and the samples of all states, one or two steps before, do not foretell it
    (F tests). times: of the pieces of records, in mean steps.
    """
    found = _hold_line(times, left, CHANCE_AT_REST)
    for n_before in BEFORE:
        chance = _chance_foretold(samples, left, n_before)
        found |= chance < CHANCE_AT_REST / len(BEFORE)
    return ~found


def _chance_foretold(samples: OtherPieces, left: Pieces, n_before: int) -> ByState:
    """Chance that samples before foretell white residuals as well as these; 1 for too few."""
    from scipy.special import fdtrc  # imported only where it is needed

    before = np.concatenate(
        [np.hstack([e[k : len(e) - n_before + k] for k in range(n_before)]) for e in samples]
    )
    own = np.concatenate([each[n_before:] for each in left])
    n, p = before.shape
    if n < p + 3:
        return np.ones(own.shape[1])
    own = own - own.mean(axis=0)
    basis = np.linalg.qr(before - before.mean(axis=0))[0]
    fraction = np.square(basis.T @ own).sum(axis=0) / np.maximum(np.square(own).sum(axis=0), TINY)
    ratio = fraction / p / np.maximum(1.0 - fraction, TINY) * (n - p - 1)
    return np.asarray(fdtrc(p, n - p - 1, ratio))


def are_noise(samples: Pieces, left: Pieces, n: float) -> StateMask:
    """True for states of which a model leaves no more than noise, so that intervals tell something.

    What it leaves is less than any model's error, or white, or lasts as noise does that the samples
    themselves show. samples, left: pieces of records, scaled, and what is left of them. n: how many
    of these samples are independent.
    """
    std, memory = np.sqrt(np.mean(np.square(np.concatenate(left)), axis=0)), _memory(left)
    shown = _shown_by_samples(samples, left, std, memory, n)
    lasts = _forgets_as_noise(left, memory, n) & shown
    return lasts | (memory <= SIGNIFICANT / np.sqrt(n)) | (std <= FLOOR)


def _likeliest_std(fit: TrajectoryFit, std: ByState) -> tuple[ByState, ByState]:
    """For sensors with limits: the likeliest noise, and -2 log of the likelihood under it.

    The second value replaces that of `noise_beside` for states with limits.
    """
    record, path = fit.problem.all_records, fit.path
    n_values = np.isfinite(record.values).sum(axis=0)
    tried = np.maximum(NOISE_FRACTIONS[:, None] * std, FLOOR)
    variances = (np.broadcast_to(np.square(each), path.shape) for each in tried)
    squares = [observe(record, path, variance).squares.sum(axis=0) for variance in variances]
    deviance = n_values * (np.log(np.square(tried)) - 1.0) + np.array(squares)
    return tried[deviance.argmin(axis=0), np.arange(len(std))], deviance.min(axis=0)


def _expected_residuals(fit: TrajectoryFit, std: ByState) -> BySample:
    """Residuals of values; for limits, the expected noise."""
    variance = np.broadcast_to(np.square(std), fit.path.shape)
    seen = observe(fit.problem.all_records, fit.path, variance)
    pull = seen.residuals / seen.variance * np.square(std)
    return np.where(np.isfinite(pull), pull, 0.0)


def _memory(left: Pieces) -> ByState:
    """Correlation of residuals from one sample to the next."""
    return np.clip(autocorrelations(left, [1])[0], 0.0, MAX_LASTING)


def autocorrelations(pieces: Pieces, lags: Sequence[int]) -> Float[np.ndarray, "lags d"]:
    """Correlations of pieces of a record with themselves some samples later."""
    squares = sum(np.square(e).sum(axis=0) for e in pieces)
    products = [sum((e[lag:] * e[:-lag]).sum(axis=0) for e in pieces) for lag in lags]
    return np.array(products) / np.maximum(squares, TINY)


def _shape(problem: EstimationProblem, path: BySample, left: BySample) -> tuple[BySample, ByState]:
    """Growth of the noise with the state: variance 1 - w + w x^2 / mean of x^2, w by likelihood.

    Returns the root of this variance, and w.
    """
    x2, e2 = np.square(path), np.square(left)
    relative = x2 / np.maximum(x2.mean(axis=0), TINY)
    # Squares of correlated noise are correlated too: fewer of them are independent.
    square = np.square(_memory(problem.split(left)))
    shows = GROWTH_SHOWS * (1.0 + square) / (1.0 - square)
    fractions = np.array([0.0, *FRACTIONS])
    deviance = np.array([_growth_deviance(1.0 - w + w * relative, e2) for w in fractions])
    deviance[0] -= shows
    growth = fractions[deviance.argmin(axis=0)]
    return np.sqrt(1.0 - growth + growth * relative), growth


def _growth_deviance(variance: BySample, e2: BySample) -> ByState:
    """-2 log likelihood of noise with these variances, scaled to its best size."""
    ratio = (e2 / variance).mean(axis=0)
    return np.log(variance).sum(axis=0) + len(e2) * np.log(np.maximum(ratio, TINY))


def _tails(problem: EstimationProblem, new: Pieces) -> tuple[ByState, Int[np.ndarray, " d"]]:
    """Kurtosis of the AR(1) innovations of the residuals of values, and the number of outliers."""
    d = len(problem.states)
    kurtosis, outliers = np.full(d, np.nan), np.zeros(d, dtype=np.int64)
    values = [np.isfinite(record.values) for record in problem.records]
    later = np.concatenate([each[1:] for each in new])
    known = np.concatenate([each[1:] & each[:-1] for each in values])
    for k in np.flatnonzero(known.any(axis=0)):
        squares = np.square(later[known[:, k], k])
        kurtosis[k] = np.square(squares).mean() / max(np.square(squares.mean()), TINY)
        # The median of squares of a normal variable is 0.455 of its variance.
        outliers[k] = (squares > OUTLYING**2 * np.median(squares) / 0.455).sum()
    return kurtosis, outliers


def flow_error(fit: TrajectoryFit, noise: Noise) -> float:
    """The model error under which the fit's support is most likely; 0 if an exact flow is.

    The exact flow is weighed with correlated noise if the noise is correlated; a flow with error is
    weighed with white noise.
    Source of the likelihood by innovations: Schweppe 1965, doi:10.1109/TIT.1965.1053737.
    """
    fit = replace(fit, noise=noise.white)
    by_memory = float((fit.problem.n_measured * np.log1p(-np.square(noise.memory))).sum())
    best, found = _deviance(fit) + by_memory - ERROR_SHOWS, 0.0
    for model_error in MODEL_ERRORS:
        fit = fit_paths(replace(fit, model_error=model_error))
        deviance = _deviance(fit)
        if deviance < best:
            best, found = deviance, model_error
    return found


def _deviance(fit: TrajectoryFit) -> float:
    """-2 log likelihood of the samples by their innovations, all noise scaled to its best size.

    With limits it uses Laplace's approximation and does not rescale the noise, which is then no
    mere scale factor.
    """
    (about, least, spread), problem = innovations(fit), fit.problem
    if problem.limited.any():
        known = problem.all_records.limits.at & np.isfinite(about.residuals)
        return spread - float(np.log(about.variance[known]).sum() - fit.squares.sum())
    n = problem.n_squares
    return spread + n * np.log(max(least, TINY) / n)


def _hold_line(times: Sequence[Float[np.ndarray, " _"]], new: Pieces, chance: float) -> StateMask:
    """True if whitened residuals hold a cleaner line than noise: the model ignores an oscillation.

    chance: that noise holds one in any of the pieces. Of white residuals the m
    ordinates of a periodogram are alike: the largest has more than a fraction g of their sum with a
    probability of at most m (1 - g)^(m - 1).
    Source: Fisher 1929, doi:10.1098/rspa.1929.0151.
    """
    held = np.zeros(new[0].shape[1], dtype=np.bool_)
    for t, each in zip(times, new, strict=True):
        # Samples at unequal steps go to the nearest of equal ones.
        place = np.rint(t - t[0]).astype(np.int64)
        placed = np.zeros((place[-1] + 1, each.shape[1]))
        np.add.at(placed, place, each)
        power = np.square(np.abs(np.fft.rfft(placed, axis=0)[1 : (len(placed) + 1) // 2]))
        fraction = power.max(axis=0, initial=0.0) / np.maximum(power.sum(axis=0), TINY)
        held |= len(power) * (1.0 - fraction) ** (len(power) - 1) < chance / len(new)
    return held


def _follow_states(fit: TrajectoryFit, new: Pieces) -> StateMask:
    """True if products of the states explain more of the residuals than they would of noise.

    What a library lacks is a function of the states, also where it lasts as noise does.
    """
    degree = int(fit.problem.candidates.library.degrees.max()) + MORE_DEGREES
    powers = powers_of(np.column_stack([fit.path, fit.problem.all_records.inputs]), degree)
    return excess_explained(powers, np.concatenate(new)) > FOLLOWS


def excess_explained(columns: Float[np.ndarray, "samples columns"], residuals: BySample) -> ByState:
    """How much more columns explain of residuals than of random ones, in standard errors.

    The squares that random residuals share with the columns are expected from the squares of
    each sample alone, so neither outliers nor noise that grows with the state pass for a function.
    """
    basis = np.linalg.qr(columns)[0]
    shared = np.square(basis.T @ residuals).sum(axis=0)
    expected = np.maximum(np.square(basis).sum(axis=1) @ np.square(residuals), TINY)
    return (shared / expected - 1.0) * np.sqrt(basis.shape[1] / 2.0)


def powers_of(states: BySample, degree: int) -> np.ndarray:
    """Products of standardised states up to a degree, lowest first, at most MAX_POWERS columns."""
    scaled = (states - states.mean(axis=0)) / zero_to_one(states.std(axis=0))
    most = max(1, min(MAX_POWERS, len(states) // 5))
    factors = chain.from_iterable(
        combinations_with_replacement(range(scaled.shape[1]), k) for k in range(degree + 1)
    )
    return np.stack([scaled[:, list(each)].prod(axis=1) for each in islice(factors, most)], axis=1)


def _forgets_as_noise(unit: Pieces, memory: ByState, n: float) -> StateMask:
    """True where the autocorrelation of residuals falls as fast as that of AR(1) noise.

    The error of a model on a signal with white noise stays correlated over longer lags. unit: the
    residuals, over the shape of the noise.
    """
    excess = autocorrelations(unit, LAGS) - memory ** np.array(LAGS)[:, None]
    return np.all(excess < LONGER / np.sqrt(n), axis=0)


def _shown_by_samples(
    samples: Pieces, left: Pieces, std: ByState, memory: ByState, n: float
) -> StateMask:
    """True if noise of this size and memory would leave differences as large as the samples'.

    The error of a model on a signal is smooth: it would make the differences smaller than they are.
    A signal that the samples do not resolve makes them larger; then the differences of the
    residuals count.
    """
    measured = np.minimum(_squared_differences(samples), _squared_differences(left))
    weights = (np.poly1d([1.0, -1.0]) ** ORDER).coeffs
    own, lags = np.convolve(weights, weights[::-1]), np.abs(np.arange(-ORDER, ORDER + 1))
    expected = np.square(std) * (own * memory[:, None] ** lags).sum(axis=1)
    # The ratio itself may fall to zero: of samples without differences, expected to be large.
    far = np.abs(np.log(np.maximum(measured, TINY)) - np.log(np.maximum(expected, TINY)))
    return far < ALIKE / np.sqrt(n)


def _squared_differences(values: Pieces) -> ByState:
    """Mean squares of the third differences, NaN left out; zero where there are none."""
    differences = np.concatenate([np.diff(each, ORDER, axis=0) for each in values])
    count = np.maximum(np.isfinite(differences).sum(axis=0), 1)
    return np.nansum(np.square(differences), axis=0) / count


def data_warning(problem: EstimationProblem, noise: Noise) -> tuple[str, ...]:
    """Remarks on sensor limits, on noise that is not white and normal, and on collinear states."""
    limits = [words for record in problem.records for words in record.limits.words]
    return (
        *(f"{words}: read as limits, not as values" for words in dict.fromkeys(limits)),
        *(
            f"{state} was measured at {count} of {problem.n_samples} samples"
            for state, count in zip(problem.states, problem.n_measured.tolist(), strict=True)
            if 0 < count < problem.n_samples
        ),
        *_of_noise(problem, noise),
        *_of_collinear_states(problem, noise),
    )


def _of_noise(problem: EstimationProblem, noise: Noise) -> list[str]:
    words = []
    error = np.sqrt(24.0 / problem.n_samples)
    for k, state in enumerate(problem.states):
        if noise.std[k] <= FLOOR or noise.is_error[k] or not problem.measured[k]:
            continue  # rounding, integration or model error, not noise
        if noise.memory[k]:
            words.append(f"noise of {state} lasts: {noise.memory[k]:.2f} from sample to sample")
        if noise.kurtosis[k] > max(HEAVY, 3.0 + STANDARD_ERRORS * error):
            words.append(
                f"noise of {state} has {noise.outliers[k]} outliers beyond five standard "
                f"deviations, kurtosis {noise.kurtosis[k]:.3g} (normal: 3)"
            )
        elif noise.growth[k]:
            words.append(f"noise of {state} grows with {state}")
    return words


def _of_collinear_states(problem: EstimationProblem, noise: Noise) -> list[str]:
    """Remark on measured states of which a linear combination varies no more than their noise."""
    own, n = np.flatnonzero(problem.measured), problem.n_samples
    if len(own) < 2 or noise.is_error.any():
        return []  # the residuals then hold model error, perhaps as large as the states
    samples = np.concatenate([record.samples for record in problem.records])[:, own]
    std, scale = noise.std[own], problem.scale[own]
    variance, directions = np.linalg.eigh(np.cov(samples / std, rowvar=False))
    if variance[0] > 1.0 + COLLINEAR * np.sqrt(2.0 / n):
        return []
    # Weights in SI, and each state's part in the sum by its spread.
    weights = directions[:, 0] / std / scale
    parts = np.abs(weights) * samples.std(axis=0) * scale
    held = [k for k in range(len(own)) if parts[k] > PART * parts.max()]
    if len(held) < 2:
        return []
    states = {k: problem.states[own[k]] for k in held}
    total = " ".join(f"{weights[k] / weights[held[0]]:+.3g} {name}" for k, name in states.items())
    return [
        f"{joined(list(states.values()))} hang together: {total.removeprefix('+')} varies no "
        "more than their noise, so terms in one may stand for terms in the others"
    ]
