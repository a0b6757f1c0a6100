# Selection
from ep2sindy.selection.rule import selected as selected
