"""Names of version 0.2 that have moved, have another name, or are gone.

All are written without `ep2sindy.` in front. Those that have moved are found in version 0.3 too,
with a warning; then this table goes.
"""

from __future__ import annotations

# Room -> names that stood in the package itself.
MOVED = {
    "benchmark": (
        "PySINDyVariant PySINDyStlsq PySINDySsr PySINDyEnsemble PySINDyWeakForm PySINDySmoothing"
    ),
    "data": "Inspection ZoneAverage GridPoint",
    "discovery": "Estimate PointSearch Kept Regimes",
    "library": "equation_text",
    "model": "Rollout r2",
    "operating": """
        OperatingRecord branches_of operating_fit OperatingFit OperatingLaw control_law
        ControlLaw law_map MapPoint Quantity TimeBootstrap Refining
    """,
    "parallel": "Serial Loky Dask Progress",
    "prepare": """
        crop decimate resample interpolate low_pass detrend derivative delay derive keep_where
        radial_from_middle
    """,
    "refinement": """
        MultipleShooting GradientDescent NelderMead RungeKutta HermiteSimpson ODE
        cut_windows WindowBatch Corrected
    """,
    "regression": """
        fit_support constrained_fit Relation relations_from_matrix
        pareto_front ParetoFront Candidate pooled_supports
    """,
    "selection": "Stability",
    "signals": """
        KalmanSmoother LogSmoother SavitzkyGolay NoSmoothing power_spectrum dominant_frequency
        Cycle find_cycle Trace Rate LogRate Delays embed Embedded
    """,
    "systems": "System damped_oscillator van_der_pol three_regions",
    "thruster": """
        Thruster OperatingPoint OPERATING_POINTS simulate simulate_2d THRUSTER_2D
        OPERATING_POINT_2D ColdStart GuessedStart Restart SoftStart
        zone_balance propellant read_propellant PropellantTable TabulatedRates XenonFits
        ionization_rate MagneticField MagneticFieldTable read_magnetic_field AnomalousTransport
        GaussianTransport MultiLogTransport ExponentialWall SheathWall wall_material AnodeSheath
        FixedAnode HallThrusterInput read_hallthruster_input simulate_hallthruster_input
    """,
    "warnings": "MissingSamples DoubtfulUnit SlowSearch",
}
# Old name -> the name in the stubs that means the same.
RENAMED = {
    "Bounds": "FreeRunBounds",
    "LeftOut": "operating.LeaveOneOut",
    "TiedFit": "operating.LawFit",
    "inspect": "inspect_file",
    "left_out": "operating.leave_one_out",
    "point": "point_samples",
    "regimes": "discovery.find_regimes",
    "tied_fit": "operating.fit_law",
    "trace": "signals.prepare_signal",
    "Joint": "TrajectorySearch",
    "JointDiscovery": "SharedDiscovery",
    "discover_jointly": "discover_shared",
    "refine_many": "refine",
    "refine_tied": "refinement.refine_law",
    "TiedRefinement": "refinement.LawRefinement",
    "simulate_cached": "thruster.simulate",
    "simulate_2d_cached": "thruster.simulate_2d",
} | {name: f"{room}.{name}" for room, names in MOVED.items() for name in names.split()}
# Old name -> what to write besides, where the new name is not called as the old one was.
NOTES: dict[str, str] = {
    "refine_many": "which takes a list of models as well",
    "refine_tied": "which takes RefinementSettings(window=..., n_windows=20, n_reweights=0) in "
    "place of those keywords",
    "operating_fit": "which takes settings=RefinementSettings(...) in place of windows=...",
    "OperatingFit": "with settings in place of windows",
    "OperatingRecord": "which is made by OperatingRecord.of(parameters, run) and finds its cycle",
    "PointSearch": "which takes method=... in place of recipe=...",
    "Joint": "for discover(method=...); estimate takes max_terms=... and align=... itself",
    "simulate_cached": "with cache=folder as before",
    "simulate_2d_cached": "with cache=folder as before",
    "TiedFit": "with law, an OperatingLaw: law.model_at(point, extrapolate=True) in place of "
    "model_at(point), law.functions in place of law, tests in place of equations",
    "tied_fit": "called fit_law(shared, functions, parameters=...); it gives a LawFit with law, an "
    "OperatingLaw: law.model_at(point, extrapolate=True) in place of model_at(point), "
    "law.functions in place of law, tests in place of equations",
}
# Old name -> what to use instead, where nothing does the same.
GONE: dict[str, str] = {
    "BIC": "write ep2sindy.EBIC(gamma=0.0, coarsening=None), which is the same",
    "LogKnee": 'write ep2sindy.Knee(scale="log"), which is the same',
    "IntegralScore": "take ep2sindy.RefinedScore(), which selects the truth more often",
    "CrossValidation": "take ep2sindy.EBIC() or ep2sindy.RefinedScore()",
    "STLSQRegressor": "take pysindy.STLSQ, or ep2sindy.STLSQ() as the search of a Regression",
    "SingleShooting": "take ep2sindy.refinement.MultipleShooting()",
    "loss_against_window": "call ep2sindy.refine in a loop over the lengths of windows",
    "selected": "write front.with_scores(scores).best, which is the same",
    "Windows": "take ep2sindy.RefinementSettings(n_windows=20, periods=2.0, n_reweights=0), "
    "passed to operating_fit as settings=...",
    "LANDMARK_POINT": "see benchmarks/landmark.py",
    "landmark_thruster": "see benchmarks/landmark.py",
}


def new_name(old: str) -> str | None:
    """What a dotted name of version 0.2 is called today; None for all others."""
    new = RENAMED.get(_bare(old))
    return None if new is None else f"ep2sindy.{new}"


def moved_text(old: str) -> str:
    """What users of a name are told that `new_name` knows."""
    note = NOTES.get(_bare(old), "")
    return (
        f"{old} is now {new_name(old)}{note and f', {note}'}; "
        "the old name is understood until version 0.4"
    )


def gone_text(old: str) -> str:
    """What users of a name are told that is gone; nothing for all others."""
    instead = GONE.get(_bare(old))
    return "" if instead is None else f"{old} is gone; {instead}"


def _bare(name: str) -> str:
    package, _, bare = name.partition(".")
    return bare if package == "ep2sindy" else ""
