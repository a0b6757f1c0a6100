# Operating points
from ep2sindy.operating.law import OperatingLaw as OperatingLaw
from ep2sindy.operating.records import branches_of as branches_of
