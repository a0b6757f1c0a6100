# Discover
from ep2sindy.data.coerce import Task as Task
from ep2sindy.discovery.result import DiscoveryMethod as DiscoveryMethod
from ep2sindy.estimation.estimate import Estimate as Estimate
from ep2sindy.discovery.pointwise import PointSearch as PointSearch
from ep2sindy.discovery.regimes import find_regimes as find_regimes
from ep2sindy.discovery.regimes import Regimes as Regimes
