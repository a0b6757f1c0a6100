# Models
from ep2sindy.forecasting.evaluation import Evaluation as Evaluation
from ep2sindy.model.comparison import Status as Status
from ep2sindy.model.comparison import FreeRunBounds as FreeRunBounds  # for configs
from ep2sindy.model.stability import limit_cycle as limit_cycle
from ep2sindy.model.stability import basin_stability as basin_stability
from ep2sindy.model.model import coef_matrix as coef_matrix

# Forecasts
from ep2sindy.forecasting.skill import forecast_skill as forecast_skill
from ep2sindy.forecasting.state_estimation import estimate_states as estimate_states
