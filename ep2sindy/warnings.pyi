# Warnings
from ep2sindy.data.gaps import MissingSamples as MissingSamples
from ep2sindy.data.quantities import DoubtfulUnit as DoubtfulUnit
from ep2sindy.estimation.problem import SlowSearch as SlowSearch
