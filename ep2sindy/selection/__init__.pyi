# Selection
from ep2sindy.selection.rule import selected as selected
from ep2sindy.selection.criteria import BIC as BIC  # for configs
from ep2sindy.selection.knees import LogKnee as LogKnee  # for configs
from ep2sindy.selection.integral import IntegralScore as IntegralScore  # for configs
from ep2sindy.selection.resampled import CrossValidation as CrossValidation  # for configs
from ep2sindy.selection.resampled import Stability as Stability  # for configs
