# Preparation
from ep2sindy.data.prepare import crop as crop  # for configs
from ep2sindy.data.prepare import decimate as decimate  # for configs
from ep2sindy.data.prepare import resample as resample  # for configs
from ep2sindy.data.prepare import interpolate as interpolate  # for configs
from ep2sindy.data.prepare import low_pass as low_pass  # for configs
from ep2sindy.data.prepare import detrend as detrend  # for configs
from ep2sindy.data.prepare import derivative as derivative  # for configs
from ep2sindy.data.prepare import delay as delay  # for configs
from ep2sindy.data.prepare import derive as derive  # for configs
from ep2sindy.data.prepare import gradient as gradient  # for configs
from ep2sindy.data.prepare import keep_where as keep_where  # for configs
from ep2sindy.data.prepare import radial_from_middle as radial_from_middle  # for configs
