# Operating points
from ep2sindy.operating.law import OperatingLaw as OperatingLaw
from ep2sindy.operating.point_fits import PointFits as PointFits
from ep2sindy.operating.records import OperatingRecord as OperatingRecord
from ep2sindy.operating.records import branches_of as branches_of
from ep2sindy.operating.map import law_map as law_map
