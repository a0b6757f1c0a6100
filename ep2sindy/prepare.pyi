# Preparation
from ep2sindy.data.in_time import crop as crop  # for configs
from ep2sindy.data.in_time import decimate as decimate  # for configs
from ep2sindy.data.in_time import resample as resample  # for configs
from ep2sindy.data.in_time import interpolate as interpolate  # for configs
from ep2sindy.data.in_time import low_pass as low_pass  # for configs
from ep2sindy.data.in_time import detrend as detrend  # for configs
from ep2sindy.data.in_time import derivative as derivative  # for configs
from ep2sindy.data.in_time import delay as delay  # for configs
from ep2sindy.data.prepare import derive as derive  # for configs
from ep2sindy.data.prepare import gradient as gradient  # for configs
from ep2sindy.data.prepare import keep_where as keep_where  # for configs
from ep2sindy.data.prepare import radial_from_middle as radial_from_middle  # for configs
