# Selection
from ep2sindy.selection.rule import selected as selected
from ep2sindy.selection.criteria import Stability as Stability  # for configs
