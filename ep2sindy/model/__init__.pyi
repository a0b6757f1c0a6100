# Models
from ep2sindy.model.rollout import Rollout as Rollout
from ep2sindy.model.scores import r2 as r2
