# Data
from ep2sindy.data.open import read_field as read_field  # for configs
from ep2sindy.data.open import write_field as write_field
from ep2sindy.data.mapping import Variable as Variable  # for configs
from ep2sindy.data.zones import ZoneAverage as ZoneAverage  # for configs
from ep2sindy.data.gaps import MissingSamples as MissingSamples

# Preparation
from ep2sindy.data.prepare import crop as crop  # for configs
from ep2sindy.data.prepare import decimate as decimate  # for configs
from ep2sindy.data.prepare import resample as resample  # for configs
from ep2sindy.data.prepare import interpolate as interpolate  # for configs
from ep2sindy.data.prepare import low_pass as low_pass  # for configs
from ep2sindy.data.prepare import detrend as detrend  # for configs
from ep2sindy.data.prepare import derivative as derivative  # for configs
from ep2sindy.data.prepare import derive as derive  # for configs
from ep2sindy.data.prepare import gradient as gradient  # for configs
from ep2sindy.data.prepare import keep_where as keep_where  # for configs
from ep2sindy.data.prepare import radial_from_middle as radial_from_middle  # for configs

# Measured records
from ep2sindy.datasets.records import pendulum_swing as pendulum_swing
from ep2sindy.datasets.records import hare_lynx as hare_lynx
from ep2sindy.datasets.records import gause as gause
