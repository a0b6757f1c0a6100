# Systems
from ep2sindy.synthetic.systems import System as System
from ep2sindy.synthetic.systems import damped_oscillator as damped_oscillator  # for configs
from ep2sindy.synthetic.systems import van_der_pol as van_der_pol  # for configs
from ep2sindy.synthetic.regions import three_regions as three_regions  # for configs
