# Discover
from ep2sindy.estimation.estimate import Estimate as Estimate
from ep2sindy.discovery.pointwise import PointSearch as PointSearch
from ep2sindy.discovery.pointwise import Kept as Kept
from ep2sindy.discovery.regimes import find_regimes as find_regimes
from ep2sindy.discovery.regimes import Regimes as Regimes
