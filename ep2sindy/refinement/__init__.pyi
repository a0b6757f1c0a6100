# Refinement
from ep2sindy.refinement.methods.multiple_shooting import (
    MultipleShooting as MultipleShooting,
)  # for configs
from ep2sindy.refinement.methods.single_shooting import (
    SingleShooting as SingleShooting,
)  # for configs
from ep2sindy.refinement.methods.gradient_descent import (
    GradientDescent as GradientDescent,
)  # for configs
from ep2sindy.refinement.methods.nelder_mead import NelderMead as NelderMead  # for configs
from ep2sindy.refinement.ode import RungeKutta as RungeKutta  # for configs
from ep2sindy.refinement.ode import HermiteSimpson as HermiteSimpson  # for configs
from ep2sindy.refinement.ode import ODE as ODE
from ep2sindy.refinement.windows import cut_windows as cut_windows
from ep2sindy.refinement.windows import WindowBatch as WindowBatch
from ep2sindy.refinement.refine import refine_many as refine_many
from ep2sindy.refinement.refine import loss_against_window as loss_against_window
from ep2sindy.refinement.correction import Corrected as Corrected
from ep2sindy.refinement.law import refine_tied as refine_tied
from ep2sindy.refinement.law import TiedRefinement as TiedRefinement
