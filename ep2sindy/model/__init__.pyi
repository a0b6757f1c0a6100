# Models
from ep2sindy.model.rollout import Rollout as Rollout
from ep2sindy.model.scores import r2 as r2
from ep2sindy.model.stability import LimitCycle as LimitCycle
from ep2sindy.model.stability import limit_cycle as limit_cycle
from ep2sindy.model.stability import share_reaching as share_reaching
