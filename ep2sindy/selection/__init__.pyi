# Selection
from ep2sindy.selection.criteria import Stability as Stability  # for configs
