# Forecasts
from ep2sindy.forecasting.tracking import track as track
from ep2sindy.forecasting.tracking import Tracker as Tracker
from ep2sindy.forecasting.baselines import Autoregression as Autoregression
from ep2sindy.forecasting.baselines import Harmonics as Harmonics
from ep2sindy.forecasting.baselines import Persistence as Persistence
