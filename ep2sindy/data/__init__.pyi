# Data
from ep2sindy.data.sampling import ZoneAverage as ZoneAverage  # for configs
from ep2sindy.data.sampling import GridPoint as GridPoint  # for configs
