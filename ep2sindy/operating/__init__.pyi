# Operating points
from ep2sindy.discovery.operating_points import OperatingRecord as OperatingRecord
from ep2sindy.discovery.operating_points import branches_of as branches_of
from ep2sindy.discovery.operating_fit import operating_fit as operating_fit
from ep2sindy.discovery.operating_fit import OperatingFit as OperatingFit
from ep2sindy.discovery.operating_fit import left_out as left_out
from ep2sindy.discovery.operating_fit import LeftOut as LeftOut
from ep2sindy.discovery.operating_fit import Windows as Windows  # for configs
from ep2sindy.discovery.operating_law import OperatingLaw as OperatingLaw
from ep2sindy.discovery.coefficient_law import tied_fit as tied_fit
from ep2sindy.discovery.coefficient_law import TiedFit as TiedFit
from ep2sindy.discovery.control_law import control_law as control_law
from ep2sindy.discovery.control_law import ControlLaw as ControlLaw
from ep2sindy.discovery.operating_map import law_map as law_map
from ep2sindy.discovery.operating_map import MapPoint as MapPoint
from ep2sindy.studies.parametric.quantities import Quantity as Quantity  # for configs
from ep2sindy.studies.parametric.time_bootstrap import TimeBootstrap as TimeBootstrap  # for configs
from ep2sindy.studies.parametric.points import Refining as Refining  # for configs
