# Parallel work
from ep2sindy.machine.parallel import Serial as Serial  # for configs
from ep2sindy.machine.parallel import Loky as Loky  # for configs
from ep2sindy.machine.parallel import Dask as Dask  # for configs
from ep2sindy.machine.progress import Progress as Progress
