# Parallel work
from ep2sindy.runtime.parallel import Serial as Serial  # for configs
from ep2sindy.runtime.parallel import Loky as Loky  # for configs
from ep2sindy.runtime.parallel import Dask as Dask  # for configs
from ep2sindy.runtime.parallel import Ray as Ray  # for configs
