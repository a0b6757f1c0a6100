# PySINDy
from ep2sindy.studies.pysindy_variants import PySINDyVariant as PySINDyVariant  # for configs
from ep2sindy.studies.pysindy_variants import PySINDyStlsq as PySINDyStlsq  # for configs
from ep2sindy.studies.pysindy_variants import PySINDySsr as PySINDySsr  # for configs
from ep2sindy.studies.pysindy_variants import PySINDySubsets as PySINDySubsets  # for configs
from ep2sindy.studies.pysindy_variants import PySINDyEnsemble as PySINDyEnsemble  # for configs
from ep2sindy.studies.pysindy_variants import PySINDyWeakForm as PySINDyWeakForm  # for configs
from ep2sindy.studies.pysindy_variants import PySINDySmoothing as PySINDySmoothing  # for configs
from ep2sindy.studies.pysindy_variants import PySINDyAsItComes as PySINDyAsItComes  # for configs
