# Libraries
from ep2sindy.library.units import Clock as Clock
from ep2sindy.library.relations import constraint as constraint
