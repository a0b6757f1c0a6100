# Systems
from ep2sindy.systems.systems import System as System
from ep2sindy.systems.systems import damped_oscillator as damped_oscillator  # for configs
from ep2sindy.systems.systems import van_der_pol as van_der_pol  # for configs
