# Operating points
from ep2sindy.operating.records import OperatingRecord as OperatingRecord
from ep2sindy.operating.records import branches_of as branches_of
from ep2sindy.operating.fit import operating_fit as operating_fit
from ep2sindy.operating.fit import OperatingFit as OperatingFit
from ep2sindy.operating.fit import left_out as left_out
from ep2sindy.operating.fit import LeftOut as LeftOut
from ep2sindy.operating.fit import Windows as Windows  # for configs
from ep2sindy.operating.law import OperatingLaw as OperatingLaw
from ep2sindy.operating.law import tied_fit as tied_fit
from ep2sindy.operating.law import TiedFit as TiedFit
from ep2sindy.operating.quantity_law import control_law as control_law
from ep2sindy.operating.quantity_law import ControlLaw as ControlLaw
from ep2sindy.operating.map import law_map as law_map
from ep2sindy.operating.map import MapPoint as MapPoint
from ep2sindy.operating.quantities import Quantity as Quantity  # for configs
from ep2sindy.operating.point_fits import TimeBootstrap as TimeBootstrap  # for configs
from ep2sindy.operating.point_fits import Refining as Refining  # for configs
