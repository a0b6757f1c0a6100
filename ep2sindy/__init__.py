"""EP2-SINDy: governing equations of oscillations, found in data; `import ep2sindy as ep`.

Every name of the package's face stands here and is loaded when it is first used, so that the
import itself costs nothing and PyTorch is loaded by those alone who refine.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # for editors and type checkers; a test holds it to the table below
    from ep2sindy.constraints.fit import constrained_fit as constrained_fit
    from ep2sindy.constraints.relations import Constraint as Constraint
    from ep2sindy.constraints.relations import Relation as Relation
    from ep2sindy.constraints.relations import constraint as constraint
    from ep2sindy.constraints.relations import relations_from_matrix as relations_from_matrix
    from ep2sindy.data.extent import Zone as Zone
    from ep2sindy.data.gaps import MissingSamples as MissingSamples
    from ep2sindy.data.in_time import crop as crop
    from ep2sindy.data.in_time import decimate as decimate
    from ep2sindy.data.in_time import delay as delay
    from ep2sindy.data.in_time import derivative as derivative
    from ep2sindy.data.in_time import detrend as detrend
    from ep2sindy.data.in_time import interpolate as interpolate
    from ep2sindy.data.in_time import low_pass as low_pass
    from ep2sindy.data.in_time import resample as resample
    from ep2sindy.data.inspection import Inspection as Inspection
    from ep2sindy.data.inspection import inspect as inspect
    from ep2sindy.data.mapping import Variable as Variable
    from ep2sindy.data.open import open_field as open_field
    from ep2sindy.data.open import read_field as read_field
    from ep2sindy.data.open import write_field as write_field
    from ep2sindy.data.prepare import derive as derive
    from ep2sindy.data.prepare import keep_where as keep_where
    from ep2sindy.data.prepare import radial_from_middle as radial_from_middle
    from ep2sindy.data.quantities import DoubtfulUnit as DoubtfulUnit
    from ep2sindy.data.trajectory import Trajectory as Trajectory
    from ep2sindy.data.zones import GridPoint as GridPoint
    from ep2sindy.data.zones import ZoneAverage as ZoneAverage
    from ep2sindy.data.zones import point as point
    from ep2sindy.data.zones import zone_average as zone_average
    from ep2sindy.discovery.blocks import Kept as Kept
    from ep2sindy.discovery.coefficient_law import TiedFit as TiedFit
    from ep2sindy.discovery.coefficient_law import tied_fit as tied_fit
    from ep2sindy.discovery.control_law import ControlLaw as ControlLaw
    from ep2sindy.discovery.control_law import control_law as control_law
    from ep2sindy.discovery.discover import Discovery as Discovery
    from ep2sindy.discovery.discover import discover as discover
    from ep2sindy.discovery.operating_fit import LeftOut as LeftOut
    from ep2sindy.discovery.operating_fit import OperatingFit as OperatingFit
    from ep2sindy.discovery.operating_fit import Windows as Windows
    from ep2sindy.discovery.operating_fit import left_out as left_out
    from ep2sindy.discovery.operating_fit import operating_fit as operating_fit
    from ep2sindy.discovery.operating_law import OperatingLaw as OperatingLaw
    from ep2sindy.discovery.operating_map import MapPoint as MapPoint
    from ep2sindy.discovery.operating_map import law_map as law_map
    from ep2sindy.discovery.operating_points import OperatingRecord as OperatingRecord
    from ep2sindy.discovery.operating_points import branches_of as branches_of
    from ep2sindy.discovery.pointwise import PointSearch as PointSearch
    from ep2sindy.discovery.pointwise import pointwise as pointwise
    from ep2sindy.discovery.recipe import Recipe as Recipe
    from ep2sindy.discovery.regimes import Regimes as Regimes
    from ep2sindy.discovery.regimes import regimes as regimes
    from ep2sindy.discovery.shared_support import JointDiscovery as JointDiscovery
    from ep2sindy.discovery.shared_support import discover_jointly as discover_jointly
    from ep2sindy.estimation.estimate import Estimate as Estimate
    from ep2sindy.estimation.estimate import estimate as estimate
    from ep2sindy.estimation.joint import Joint as Joint
    from ep2sindy.estimation.size import SlowSearch as SlowSearch
    from ep2sindy.library.equations import equation_text as equation_text
    from ep2sindy.library.functions import register_function as register_function
    from ep2sindy.library.library import Library as Library
    from ep2sindy.library.library import named_terms as named_terms
    from ep2sindy.library.library import polynomial as polynomial
    from ep2sindy.library.units import Clock as Clock
    from ep2sindy.machine.own import for_configs as for_configs
    from ep2sindy.machine.parallel import Dask as Dask
    from ep2sindy.machine.parallel import Loky as Loky
    from ep2sindy.machine.parallel import Serial as Serial
    from ep2sindy.machine.progress import Progress as Progress
    from ep2sindy.model.free_run import FreeRun as FreeRun
    from ep2sindy.model.free_run import free_run as free_run
    from ep2sindy.model.likeness import Bounds as Bounds
    from ep2sindy.model.likeness import Verdict as Verdict
    from ep2sindy.model.model import SparseModel as SparseModel
    from ep2sindy.model.model import coef_matrix as coef_matrix
    from ep2sindy.model.rollout import Rollout as Rollout
    from ep2sindy.model.scores import r2 as r2
    from ep2sindy.model.stability import LimitCycle as LimitCycle
    from ep2sindy.model.stability import limit_cycle as limit_cycle
    from ep2sindy.model.stability import share_reaching as share_reaching
    from ep2sindy.refinement.correction import Corrected as Corrected
    from ep2sindy.refinement.correction import refine_with_correction as refine_with_correction
    from ep2sindy.refinement.law import LawRefinement as LawRefinement
    from ep2sindy.refinement.law import refine_law as refine_law
    from ep2sindy.refinement.methods.gradient_descent import GradientDescent as GradientDescent
    from ep2sindy.refinement.methods.multiple_shooting import MultipleShooting as MultipleShooting
    from ep2sindy.refinement.methods.nelder_mead import NelderMead as NelderMead
    from ep2sindy.refinement.methods.single_shooting import SingleShooting as SingleShooting
    from ep2sindy.refinement.ode import ODE as ODE
    from ep2sindy.refinement.ode import HermiteSimpson as HermiteSimpson
    from ep2sindy.refinement.ode import RungeKutta as RungeKutta
    from ep2sindy.refinement.problem import RefinementSettings as RefinementSettings
    from ep2sindy.refinement.refine import Refinement as Refinement
    from ep2sindy.refinement.refine import refine as refine
    from ep2sindy.refinement.windows import WindowBatch as WindowBatch
    from ep2sindy.refinement.windows import cut_windows as cut_windows
    from ep2sindy.regression.differential import Differential as Differential
    from ep2sindy.regression.rows import Regression as Regression
    from ep2sindy.regression.splits import BlockSplit as BlockSplit
    from ep2sindy.regression.splits import RandomSplit as RandomSplit
    from ep2sindy.regression.test_functions import Boxes as Boxes
    from ep2sindy.regression.test_functions import Bumps as Bumps
    from ep2sindy.regression.weak import Weak as Weak
    from ep2sindy.regression.weighted_weak import WeightedWeak as WeightedWeak
    from ep2sindy.search.bootstraps import Bootstraps as Bootstraps
    from ep2sindy.search.bootstraps import pooled_supports as pooled_supports
    from ep2sindy.search.estimators import AdaptiveLassoRegressor as AdaptiveLassoRegressor
    from ep2sindy.search.estimators import STLSQRegressor as STLSQRegressor
    from ep2sindy.search.front import Candidate as Candidate
    from ep2sindy.search.front import ParetoFront as ParetoFront
    from ep2sindy.search.front import fit_support as fit_support
    from ep2sindy.search.front import pareto_front as pareto_front
    from ep2sindy.search.searches import STLSQ as STLSQ
    from ep2sindy.search.searches import AdaptiveLasso as AdaptiveLasso
    from ep2sindy.search.searches import BestSubset as BestSubset
    from ep2sindy.selection.criteria import BIC as BIC
    from ep2sindy.selection.criteria import EBIC as EBIC
    from ep2sindy.selection.criteria import AICc as AICc
    from ep2sindy.selection.evidence import Evidence as Evidence
    from ep2sindy.selection.free_run import FreeRunScore as FreeRunScore
    from ep2sindy.selection.integral import IntegralScore as IntegralScore
    from ep2sindy.selection.knees import Knee as Knee
    from ep2sindy.selection.knees import LogKnee as LogKnee
    from ep2sindy.selection.refined import RefinedScore as RefinedScore
    from ep2sindy.selection.resampled import CrossValidation as CrossValidation
    from ep2sindy.selection.resampled import Stability as Stability
    from ep2sindy.selection.rule import selected as selected
    from ep2sindy.signals.attractor import Cycle as Cycle
    from ep2sindy.signals.attractor import find_cycle as find_cycle
    from ep2sindy.signals.embedding import Delays as Delays
    from ep2sindy.signals.embedding import Embedded as Embedded
    from ep2sindy.signals.embedding import LogRate as LogRate
    from ep2sindy.signals.embedding import Rate as Rate
    from ep2sindy.signals.embedding import embed as embed
    from ep2sindy.signals.kalman import KalmanSmoother as KalmanSmoother
    from ep2sindy.signals.log_smoother import LogSmoother as LogSmoother
    from ep2sindy.signals.smoothers import NoSmoothing as NoSmoothing
    from ep2sindy.signals.smoothers import SavitzkyGolay as SavitzkyGolay
    from ep2sindy.signals.spectrum import dominant_frequency as dominant_frequency
    from ep2sindy.signals.spectrum import power_spectrum as power_spectrum
    from ep2sindy.signals.trace import Trace as Trace
    from ep2sindy.signals.trace import trace as trace
    from ep2sindy.studies.parametric.points import Refining as Refining
    from ep2sindy.studies.parametric.quantities import Quantity as Quantity
    from ep2sindy.studies.parametric.time_bootstrap import TimeBootstrap as TimeBootstrap
    from ep2sindy.studies.pysindy_variants import PySINDyEnsemble as PySINDyEnsemble
    from ep2sindy.studies.pysindy_variants import PySINDySmoothing as PySINDySmoothing
    from ep2sindy.studies.pysindy_variants import PySINDySsr as PySINDySsr
    from ep2sindy.studies.pysindy_variants import PySINDyStlsq as PySINDyStlsq
    from ep2sindy.studies.pysindy_variants import PySINDyVariant as PySINDyVariant
    from ep2sindy.studies.pysindy_variants import PySINDyWeakForm as PySINDyWeakForm
    from ep2sindy.synthetic.regions import three_regions as three_regions
    from ep2sindy.synthetic.systems import System as System
    from ep2sindy.synthetic.systems import damped_oscillator as damped_oscillator
    from ep2sindy.synthetic.systems import lorenz as lorenz
    from ep2sindy.synthetic.systems import lotka_volterra as lotka_volterra
    from ep2sindy.synthetic.systems import pendulum as pendulum
    from ep2sindy.synthetic.systems import van_der_pol as van_der_pol
    from ep2sindy.thruster.anode import AnodeSheath as AnodeSheath
    from ep2sindy.thruster.anode import FixedAnode as FixedAnode
    from ep2sindy.thruster.axial.balance import zone_balance as zone_balance
    from ep2sindy.thruster.axial.simulate import simulate as simulate
    from ep2sindy.thruster.axial.starts import ColdStart as ColdStart
    from ep2sindy.thruster.axial.starts import GuessedStart as GuessedStart
    from ep2sindy.thruster.axial.starts import Restart as Restart
    from ep2sindy.thruster.axial.starts import SoftStart as SoftStart
    from ep2sindy.thruster.cache import simulate_cached as simulate_cached
    from ep2sindy.thruster.hallthruster_input import HallThrusterInput as HallThrusterInput
    from ep2sindy.thruster.hallthruster_input import (
        read_hallthruster_input as read_hallthruster_input,
    )
    from ep2sindy.thruster.hallthruster_run import (
        simulate_hallthruster_input as simulate_hallthruster_input,
    )
    from ep2sindy.thruster.ionization import ionization_rate as ionization_rate
    from ep2sindy.thruster.landmark import LANDMARK_POINT as LANDMARK_POINT
    from ep2sindy.thruster.landmark import landmark_thruster as landmark_thruster
    from ep2sindy.thruster.magnetic_field import MagneticField as MagneticField
    from ep2sindy.thruster.magnetic_field import MagneticFieldTable as MagneticFieldTable
    from ep2sindy.thruster.magnetic_field import read_magnetic_field as read_magnetic_field
    from ep2sindy.thruster.parameters import OPERATING_POINTS as OPERATING_POINTS
    from ep2sindy.thruster.parameters import OperatingPoint as OperatingPoint
    from ep2sindy.thruster.parameters import Thruster as Thruster
    from ep2sindy.thruster.plane.cache import simulate_2d_cached as simulate_2d_cached
    from ep2sindy.thruster.plane.simulate import OPERATING_POINT_2D as OPERATING_POINT_2D
    from ep2sindy.thruster.plane.simulate import THRUSTER_2D as THRUSTER_2D
    from ep2sindy.thruster.plane.simulate import simulate_2d as simulate_2d
    from ep2sindy.thruster.propellant_files import propellant as propellant
    from ep2sindy.thruster.propellant_files import read_propellant as read_propellant
    from ep2sindy.thruster.propellants import PropellantTable as PropellantTable
    from ep2sindy.thruster.propellants import TabulatedRates as TabulatedRates
    from ep2sindy.thruster.propellants import XenonFits as XenonFits
    from ep2sindy.thruster.transport import AnomalousTransport as AnomalousTransport
    from ep2sindy.thruster.transport import GaussianTransport as GaussianTransport
    from ep2sindy.thruster.transport import MultiLogTransport as MultiLogTransport
    from ep2sindy.thruster.walls import ExponentialWall as ExponentialWall
    from ep2sindy.thruster.walls import SheathWall as SheathWall
    from ep2sindy.thruster.walls import wall_material as wall_material

    __version__: str

# Module -> its names that users and configs see. Configs name `ep2sindy.EBIC`, never a module.
_FACE = {
    "constraints.fit": "constrained_fit",
    "constraints.relations": "Relation Constraint constraint relations_from_matrix",
    "data.extent": "Zone",
    "data.gaps": "MissingSamples",
    "data.in_time": "crop decimate delay derivative detrend interpolate low_pass resample",
    "data.inspection": "Inspection inspect",
    "data.mapping": "Variable",
    "data.open": "open_field write_field read_field",
    "data.prepare": "derive radial_from_middle keep_where",
    "data.quantities": "DoubtfulUnit",
    "data.trajectory": "Trajectory",
    "data.zones": "ZoneAverage GridPoint zone_average point",
    "discovery.blocks": "Kept",
    "discovery.coefficient_law": "TiedFit tied_fit",
    "discovery.control_law": "ControlLaw control_law",
    "discovery.discover": "Discovery discover",
    "discovery.operating_fit": "LeftOut OperatingFit Windows left_out operating_fit",
    "discovery.operating_law": "OperatingLaw",
    "discovery.operating_map": "MapPoint law_map",
    "discovery.operating_points": "OperatingRecord branches_of",
    "discovery.pointwise": "PointSearch pointwise",
    "discovery.recipe": "Recipe",
    "discovery.regimes": "Regimes regimes",
    "discovery.shared_support": "JointDiscovery discover_jointly",
    "estimation.estimate": "Estimate estimate",
    "estimation.joint": "Joint",
    "estimation.size": "SlowSearch",
    "library.equations": "equation_text",
    "library.functions": "register_function",
    "library.library": "Library polynomial named_terms",
    "machine.own": "for_configs",
    "machine.parallel": "Serial Loky Dask",
    "machine.progress": "Progress",
    "library.units": "Clock",
    "model.free_run": "FreeRun free_run",
    "model.likeness": "Bounds Verdict",
    "model.model": "SparseModel coef_matrix",
    "model.rollout": "Rollout",
    "model.scores": "r2",
    "model.stability": "LimitCycle limit_cycle share_reaching",
    "refinement.correction": "Corrected refine_with_correction",
    "refinement.law": "LawRefinement refine_law",
    "refinement.methods.gradient_descent": "GradientDescent",
    "refinement.methods.multiple_shooting": "MultipleShooting",
    "refinement.methods.nelder_mead": "NelderMead",
    "refinement.methods.single_shooting": "SingleShooting",
    "refinement.ode": "ODE RungeKutta HermiteSimpson",
    "refinement.problem": "RefinementSettings",
    "refinement.refine": "Refinement refine",
    "refinement.windows": "WindowBatch cut_windows",
    "regression.differential": "Differential",
    "regression.rows": "Regression",
    "regression.splits": "RandomSplit BlockSplit",
    "regression.test_functions": "Boxes Bumps",
    "regression.weak": "Weak",
    "regression.weighted_weak": "WeightedWeak",
    "search.bootstraps": "Bootstraps pooled_supports",
    "search.estimators": "AdaptiveLassoRegressor STLSQRegressor",
    "search.front": "Candidate ParetoFront fit_support pareto_front",
    "search.searches": "AdaptiveLasso STLSQ BestSubset",
    "selection.criteria": "AICc BIC EBIC",
    "selection.evidence": "Evidence",
    "selection.free_run": "FreeRunScore",
    "selection.integral": "IntegralScore",
    "selection.knees": "Knee LogKnee",
    "selection.refined": "RefinedScore",
    "selection.resampled": "Stability CrossValidation",
    "selection.rule": "selected",
    "signals.attractor": "Cycle find_cycle",
    "signals.embedding": "LogRate Rate Delays Embedded embed",
    "signals.kalman": "KalmanSmoother",
    "signals.log_smoother": "LogSmoother",
    "signals.smoothers": "SavitzkyGolay NoSmoothing",
    "signals.spectrum": "power_spectrum dominant_frequency",
    "signals.trace": "Trace trace",
    "studies.parametric.points": "Refining",
    "studies.parametric.quantities": "Quantity",
    "studies.parametric.time_bootstrap": "TimeBootstrap",
    "studies.pysindy_variants": (
        "PySINDyVariant PySINDyStlsq PySINDySsr PySINDyEnsemble PySINDyWeakForm PySINDySmoothing"
    ),
    "synthetic.regions": "three_regions",
    "synthetic.systems": "System damped_oscillator lotka_volterra van_der_pol lorenz pendulum",
    "thruster.anode": "AnodeSheath FixedAnode",
    "thruster.axial.balance": "zone_balance",
    "thruster.axial.simulate": "simulate",
    "thruster.axial.starts": "ColdStart GuessedStart Restart SoftStart",
    "thruster.cache": "simulate_cached",
    "thruster.hallthruster_input": "HallThrusterInput read_hallthruster_input",
    "thruster.hallthruster_run": "simulate_hallthruster_input",
    "thruster.ionization": "ionization_rate",
    "thruster.landmark": "LANDMARK_POINT landmark_thruster",
    "thruster.magnetic_field": "MagneticField MagneticFieldTable read_magnetic_field",
    "thruster.parameters": "OPERATING_POINTS OperatingPoint Thruster",
    "thruster.plane.cache": "simulate_2d_cached",
    "thruster.plane.simulate": "simulate_2d THRUSTER_2D OPERATING_POINT_2D",
    "thruster.propellant_files": "propellant read_propellant",
    "thruster.propellants": "PropellantTable TabulatedRates XenonFits",
    "thruster.transport": "AnomalousTransport GaussianTransport MultiLogTransport",
    "thruster.walls": "ExponentialWall SheathWall wall_material",
}
_MODULES = {name: module for module, names in _FACE.items() for name in names.split()}
__all__ = ["__version__", *_MODULES]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("ep2sindy")
    if name not in _MODULES:
        raise AttributeError(f"module 'ep2sindy' has no attribute {name!r}; see dir(ep2sindy)")
    value = getattr(import_module(f"ep2sindy.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
