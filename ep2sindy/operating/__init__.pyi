# Operating points
from ep2sindy.operating.records import OperatingRecord as OperatingRecord
from ep2sindy.operating.records import branches_of as branches_of
from ep2sindy.operating.fit import operating_fit as operating_fit
from ep2sindy.operating.fit import OperatingFit as OperatingFit
from ep2sindy.operating.fit import leave_one_out as leave_one_out
from ep2sindy.operating.fit import LeaveOneOut as LeaveOneOut
from ep2sindy.operating.law import OperatingLaw as OperatingLaw
from ep2sindy.operating.fit_rows import fit_law as fit_law
from ep2sindy.operating.map import law_map as law_map
