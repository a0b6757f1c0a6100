# Warnings
from ep2sindy.data.gaps import MissingSamples as MissingSamples
from ep2sindy.data.quantities import DoubtfulUnit as DoubtfulUnit
from ep2sindy.estimation.cost import SlowSearch as SlowSearch
from ep2sindy.regression.searches import Unproven as Unproven
