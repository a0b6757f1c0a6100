# Discover
from ep2sindy.discovery.pointwise import PointSearch as PointSearch
from ep2sindy.discovery.estimator import SINDy as SINDy
from ep2sindy.discovery.several_points import LawSearch as LawSearch
from ep2sindy.estimation.cost import SlowSearch as SlowSearch

# Selection
from ep2sindy.selection.criteria import Evidence as Evidence  # for configs
