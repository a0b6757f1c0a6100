# Signals
from ep2sindy.signals.smoothers import KalmanSmoother as KalmanSmoother  # for configs
from ep2sindy.signals.log_smoother import LogSmoother as LogSmoother  # for configs
from ep2sindy.signals.smoothers import SavitzkyGolay as SavitzkyGolay  # for configs
from ep2sindy.signals.smoothers import NoSmoothing as NoSmoothing  # for configs
from ep2sindy.signals.attractor import find_cycle as find_cycle
from ep2sindy.signals.attractor import mean_cycle as mean_cycle
from ep2sindy.signals.embedding import embed_alike as embed_alike
from ep2sindy.signals.driving import add_drive as add_drive
from ep2sindy.signals.signal import prepare_signal as prepare_signal
