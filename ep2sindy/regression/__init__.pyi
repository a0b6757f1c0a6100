# Regressions
from ep2sindy.regression.rows import RegressionRows as RegressionRows
from ep2sindy.search.front import fit_support as fit_support
from ep2sindy.constraints.fit import constrained_fit as constrained_fit
from ep2sindy.constraints.relations import Relation as Relation
from ep2sindy.constraints.relations import relations_from_matrix as relations_from_matrix
from ep2sindy.search.front import pareto_front as pareto_front
from ep2sindy.search.front import ParetoFront as ParetoFront
from ep2sindy.search.front import Candidate as Candidate
from ep2sindy.search.bootstraps import pooled_supports as pooled_supports
