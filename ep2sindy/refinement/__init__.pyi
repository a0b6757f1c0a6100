# Refinement
from ep2sindy.refinement.methods.multiple_shooting import (
    MultipleShooting as MultipleShooting,
)  # for configs
from ep2sindy.refinement.methods.gradient_descent import (
    GradientDescent as GradientDescent,
)  # for configs
from ep2sindy.refinement.steps import RungeKutta as RungeKutta  # for configs
from ep2sindy.refinement.steps import FusedRungeKutta as FusedRungeKutta  # for configs
from ep2sindy.refinement.problem import RefinementSettings as RefinementSettings
from ep2sindy.refinement.correction import refine_with_correction as refine_with_correction
