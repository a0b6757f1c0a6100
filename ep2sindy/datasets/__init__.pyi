# Measured records
from ep2sindy.datasets.records import pendulum_swing as pendulum_swing
from ep2sindy.datasets.records import hare_lynx as hare_lynx
from ep2sindy.datasets.records import gause as gause
