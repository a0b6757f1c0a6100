# Regressions
from ep2sindy.regression.windows import Bumps as Bumps  # for configs
from ep2sindy.regression.windows import Boxes as Boxes  # for configs
from ep2sindy.regression.formulations import RandomSplit as RandomSplit  # for configs
from ep2sindy.regression.formulations import BlockSplit as BlockSplit  # for configs
