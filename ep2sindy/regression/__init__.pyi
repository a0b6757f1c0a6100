# Regressions
from ep2sindy.regression.rows import RegressionRows as RegressionRows
from ep2sindy.regression.front import fit_support as fit_support
from ep2sindy.regression.constrained import constrained_fit as constrained_fit
from ep2sindy.library.relations import Relation as Relation
from ep2sindy.library.relations import relations_from_matrix as relations_from_matrix
from ep2sindy.regression.front import pareto_front as pareto_front
from ep2sindy.regression.front import ParetoFront as ParetoFront
from ep2sindy.regression.front import Candidate as Candidate
from ep2sindy.regression.bootstraps import pool_supports as pool_supports
from ep2sindy.regression.least_squares import LeastSquares as LeastSquares
