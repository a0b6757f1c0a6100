# Operating points
from ep2sindy.operating.records import OperatingRecord as OperatingRecord
from ep2sindy.operating.records import branches_of as branches_of
from ep2sindy.operating.fit import operating_fit as operating_fit
from ep2sindy.operating.fit import OperatingFit as OperatingFit
from ep2sindy.operating.fit import leave_one_out as leave_one_out
from ep2sindy.operating.fit import LeaveOneOut as LeaveOneOut
from ep2sindy.operating.law import OperatingLaw as OperatingLaw
from ep2sindy.operating.law import fit_law as fit_law
from ep2sindy.operating.law import LawFit as LawFit
from ep2sindy.operating.quantity_law import control_law as control_law
from ep2sindy.operating.quantity_law import ControlLaw as ControlLaw
from ep2sindy.operating.map import law_map as law_map
from ep2sindy.operating.map import MapPoint as MapPoint
from ep2sindy.operating.quantities import Quantity as Quantity  # for configs
from ep2sindy.operating.point_fits import TimeBootstrap as TimeBootstrap  # for configs
from ep2sindy.operating.point_fits import Refining as Refining  # for configs
