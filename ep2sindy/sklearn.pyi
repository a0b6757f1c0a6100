# For scikit-learn
from ep2sindy.discovery.estimator import SINDy as SINDy
