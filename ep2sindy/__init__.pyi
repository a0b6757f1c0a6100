# How to read and extend this file: ep2sindy/_stubs.py.
__version__: str

# Data
from ep2sindy.data.trajectory import Trajectory as Trajectory
from ep2sindy.data.open import open_field as open_field  # for configs
from ep2sindy.data.open import inspect_file as inspect_file
from ep2sindy.data.run_files import read_runs as read_runs
from ep2sindy.data.zones import zone_average as zone_average
from ep2sindy.data.zones import zone_averages as zone_averages
from ep2sindy.data.zones import Zone as Zone  # for configs

# Libraries
from ep2sindy.library.library import Library as Library
from ep2sindy.library.library import polynomial as polynomial
from ep2sindy.library.library import named_terms as named_terms
from ep2sindy.library.roles import Roles as Roles  # for configs

# Discover
from ep2sindy.discovery.discover import discover as discover
from ep2sindy.discovery.result import Discovery as Discovery
from ep2sindy.discovery.pointwise import pointwise as pointwise
from ep2sindy.estimation.estimate import estimate as estimate
from ep2sindy.signals.embedding import embed as embed

# Searches
from ep2sindy.discovery.method import TrajectorySearch as TrajectorySearch  # for configs
from ep2sindy.discovery.method import Regression as Regression  # for configs
from ep2sindy.regression.searches import BestSubset as BestSubset  # for configs
from ep2sindy.regression.searches import AdaptiveLasso as AdaptiveLasso  # for configs
from ep2sindy.regression.searches import STLSQ as STLSQ  # for configs
from ep2sindy.regression.bootstraps import Bootstraps as Bootstraps  # for configs

# Regressions
from ep2sindy.regression.formulations import Differential as Differential  # for configs
from ep2sindy.regression.formulations import Weak as Weak  # for configs
from ep2sindy.regression.formulations import WeightedWeak as WeightedWeak  # for configs

# Selection
from ep2sindy.selection.criteria import EBIC as EBIC  # for configs
from ep2sindy.selection.criteria import Knee as Knee  # for configs
from ep2sindy.selection.free_run import FreeRunScore as FreeRunScore  # for configs

# Models
from ep2sindy.model.model import SparseModel as SparseModel
from ep2sindy.forecasting.evaluation import evaluate as evaluate

# Forecasts
from ep2sindy.forecasting.forecast import forecast as forecast

# Refinement
from ep2sindy.refinement.refine import refine as refine

# Systems
from ep2sindy.systems.systems import lorenz as lorenz  # for configs
from ep2sindy.systems.systems import lotka_volterra as lotka_volterra  # for configs
from ep2sindy.systems.systems import pendulum as pendulum  # for configs

# Figures
from ep2sindy.figures.plots import plot as plot

# Your own code
from ep2sindy.library.functions import register_function as register_function
from ep2sindy.trust.user_code import for_configs as for_configs

# Rooms
from ep2sindy import data as data
from ep2sindy import library as library
from ep2sindy import discovery as discovery
from ep2sindy import regression as regression
from ep2sindy import model as model
from ep2sindy import refinement as refinement
from ep2sindy import signals as signals
from ep2sindy import operating as operating
from ep2sindy import thruster as thruster
from ep2sindy import systems as systems
from ep2sindy import parallel as parallel
